"""Planned and published grids of PSFs, in states on and between published nodes.

The published grid has nodes at whole millimeters of pupil: a benchmark at 5 mm reads it
where its error of interpolation is zero.  Here both grids filter the courtyard at
640x360 over the whole visual field, in that state and in another one.  Error: PSNR of
linear light in two windows of 120x120 pixels against the dense reference.  Time: median
of frames whose pupil and focus change.
"""

import sys

import numpy as np

from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.field_methods import EyeBench, Ours, State
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.benchmarks.view_sources import Window
from tests.numerical.scene_frames import scene_view

MINUTES = 2
STATES = (State(5.0, 0.5), State(4.55, 0.8))
"""The first has the pupil of a published node."""

WINDOWS = (Window(40, 60, 120, 120), Window(260, 120, 120, 120))
METHODS = (
    Ours("planned, dynamic, normal", False, True),
    Ours("published grid, dynamic", False, True, grid="paper"),
)
REPEATS = 5


def state_rows(bench: EyeBench, eye: str, view, state: State, methods, windows):
    """Yield the rows of one eye in one state."""
    exact = bench.exact_state(state, on_axis=False)
    wanted = [dense_reference(view, exact, bins=True, window=w) for w in windows]
    for method in methods:
        handle, _ = bench.store(method, state)
        times_ms = []
        for k in range(REPEATS, -1, -1):  # the last is the state itself
            found = bench.renderer.render(
                view,
                handle,
                pupil_diameter_mm=state.pupil_mm + 0.01 * k,
                focus_dpt=state.focus_dpt + 0.01 * k,
            )
            stages_ms = dict(found.stage_times_ms)
            stages_ms.pop("psf_compute_ms", None)  # of the cache, filled once
            times_ms.append(sum(stages_ms.values()))
        parts = [w.of(found.color) for w in windows]
        error_db = np.mean(
            [
                channel_psnr_db(part.astype(np.float64), reference)
                for part, reference in zip(parts, wanted, strict=True)
            ]
        )
        yield row_of(
            *("states", method.name, eye, f"{state}, tolerance 1"),
            *(times_ms[1:], "psnr_db", error_db, "dense, two windows"),
            used_mb=handle.store.memory_mb,
        )


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes and states, or of one eye in one window."""
    eyes, states, methods, windows = CONDITIONS, STATES, METHODS, WINDOWS
    view = scene_view("courtyard", width_px=640, height_px=360)
    if run.is_quick:
        eyes, states, methods = ("myopia",), STATES[1:2], METHODS[:1]
        view = scene_view("courtyard", width_px=96, height_px=54)
        windows = (Window(0, 0, 96, 54),)
    renderer, rows = NativeRenderer(), []
    for eye in eyes:
        bench = EyeBench(renderer, eye, [view])
        for state in states:
            print(f"{eye}, {state}", file=sys.stderr)
            rows += state_rows(bench, eye, view, state, methods, windows)
        bench.release()
    return rows
