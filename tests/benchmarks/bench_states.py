"""Planned and published grids of PSFs, in states on and between published nodes.

    python -m tests.benchmarks.bench_states [--quick] [--json] [--eyes NAME ...]

The published grid has nodes at whole millimeters of pupil: a benchmark at 5 mm reads it
where its error of interpolation is zero.  Here both grids filter *Courtyard* at 640x360
over the whole visual field, in that state and in two others.  Error: PSNR of linear
light in two windows of 120x120 pixels against the dense reference, with the usual
tolerance of rendering and with 0, which leaves the error of the PSFs.  Time: median of
frames whose pupil and focus change.  Writes results/states.json.
"""

import argparse
import sys

import numpy as np

from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.field_methods import EyeBench, Ours, State
from tests.benchmarks.harness import Row, publish
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.view_sources import Window
from tests.numerical.scene_frames import scene_view

EYES = (
    *("emmetropia", "myopia", "astigmatism"),
    *("keratoconus", "cataract", "post_lasik"),
)
STATES = (State(5.0, 0.5), State(4.55, 0.8), State(3.4, 0.2))
"""The first has the pupil of a published node."""

SIZE = {"width_px": 640, "height_px": 360}
WINDOWS = (Window(40, 60, 120, 120), Window(260, 120, 120, 120))
METHODS = (
    Ours("planned, dynamic, normal", False, True),
    Ours("planned, dynamic, fine", False, True, tolerance="fine"),
    Ours("published grid, dynamic", False, True, grid="paper"),
    Ours("planned, quality, fine", False, True, mode="quality", tolerance="fine"),
    Ours("published grid, quality", False, True, mode="quality", grid="paper"),
)
REPEATS = 5


def state_rows(bench: EyeBench, eye: str, view, state: State, methods):
    """Rows of one eye in one state."""
    exact = bench.exact_state(state, on_axis=False)
    wanted = [dense_reference(view, exact, bins=True, window=w) for w in WINDOWS]
    for method in methods:
        handle, _ = bench.store(method, state)
        for tolerance in (1.0, 0.0):
            times_ms = []
            for k in range(REPEATS, -1, -1):  # the last is the state itself
                found = bench.renderer.render(
                    view,
                    handle,
                    pupil_diameter_mm=state.pupil_mm + 0.01 * k,
                    focus_dpt=state.focus_dpt + 0.01 * k,
                    render_tolerance=tolerance,
                )
                stages_ms = dict(found.stage_times_ms)
                stages_ms.pop("psf_compute_ms", None)  # of the cache, filled once
                times_ms.append(sum(stages_ms.values()))
            parts = [
                found.color[w.y : w.y + w.height_px, w.x : w.x + w.width_px]
                for w in WINDOWS
            ]
            error_db = np.mean(
                [
                    channel_psnr_db(part.astype(np.float64), reference)
                    for part, reference in zip(parts, wanted, strict=True)
                ]
            )
            yield Row(
                bench="states",
                method=method.name,
                case=eye,
                setting=f"{state}, tolerance {tolerance:g}",
                n=REPEATS,
                median_ms=float(np.median(times_ms[1:])),
                p95_ms=float(np.max(times_ms[1:])),
                memory_mb=handle.store.memory_mb,
                error_name="psnr_db",
                error=float(error_db),
                reference="dense, two windows",
            )


def main() -> None:
    """Run, print, and write results/states.json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one eye, two states")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--eyes", nargs="+", choices=EYES, default=EYES)
    options = parser.parse_args()
    eyes = ("myopia",) if options.quick else options.eyes
    states = STATES[:2] if options.quick else STATES
    methods = METHODS[:3] if options.quick else METHODS
    view = scene_view("courtyard", **SIZE)
    renderer = NativeRenderer()
    rows = []
    for eye in eyes:
        bench = EyeBench(renderer, eye, [view])
        for state in states:
            rows += state_rows(bench, eye, view, state, methods)
            print(f"{eye}, {state}", file=sys.stderr)
    is_whole = not options.quick and len(eyes) == len(EYES)
    publish("states", rows, as_json=options.json, is_whole=is_whole)


if __name__ == "__main__":
    main()
