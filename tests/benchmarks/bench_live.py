"""Is it live?  Streams whose pupil and focus change with every frame, eye by eye.

    python -m tests.benchmarks.bench_live [--quick] [--json] [--gl]
        [--eyes NAME ...] [--sizes WxH ...] [--threads N ...] [--frames N] [--errors]

The demo's walk through *Courtyard*, colour and depth as a client sends them, 8-bit
sRGB in and out, over the whole visual field ("dynamic"): every frame has another view,
pupil and focus, so that its kernels are blended anew.  Rendering the scene is not in
the times.

The error is that of one frame of the walk, in linear light, against the dense
reference: the exact PSF of every pixel, in bins of 0.2 degrees and 0.005 dpt.  Of large
frames three windows of 256 x 256 are judged (middle, left edge, corner), as a reference
of the whole takes tens of minutes.  References are kept under out/dense_references;
without ``--errors`` only what lies there is used.

``--gl`` measures the OpenGL engine in the same run, in few frames, and draws the times
of the stages of both, results/live.png.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from clients.pyrender_stream import parse_size, path_settings
from clients.scenes.paths import PATHS, path_moments
from filter_service.psfs.build_store import build_psf_store
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.dense_reference import (
    EyeState,
    Window,
    dense_reference,
    has_reference,
)
from tests.benchmarks.engines import open_renderer
from tests.benchmarks.harness import (
    OUT,
    RESULTS,
    Row,
    machine_info,
    memory_mb,
    print_rows,
    report,
    write_report,
)
from tests.benchmarks.live_picture import plot_stages
from tests.benchmarks.published_figures import CONDITIONS
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.numerical.scene_frames import scene_views
from tests.numerical.synthetic import psnr_db

SCENE = "courtyard"
JUDGED = 0.5
"""Part of the walk after which the frame stands whose error is measured."""

WARM_UP_COUNT = 2

WHOLE_PIXELS = 640 * 360
"""Largest frame that is judged as a whole."""

WINDOW_PX = 256

GL_FRAMES = 3
"""Of the walk, for a software OpenGL."""


@dataclass(frozen=True)
class Walk:
    """Frames of one size, with the state of the eye in each."""

    size_px: tuple[int, int]
    views: tuple
    states: tuple

    @classmethod
    def of(cls, size_px: tuple[int, int], count: int) -> "Walk":
        """Return the demo's walk in so many frames."""
        views = scene_views(
            SCENE, width_px=size_px[0], height_px=size_px[1], count=count
        )
        states = tuple(
            {"pupil_diameter_mm": m.pupil_diameter_mm, "focus_dpt": m.focus_dpt}
            for m in path_moments(PATHS[SCENE], count)
        )
        return cls(size_px, views, states)

    def shortened(self, count: int) -> "Walk":
        """Only the first frames, for what is slow."""
        return replace(self, views=self.views[:count], states=self.states[:count])

    @property
    def judged(self) -> int:
        """Number of the frame whose error is measured."""
        return int(JUDGED * len(self.views))

    @property
    def camera(self) -> dict:
        """Size and tangents, as specs take them."""
        view = self.views[0]
        return {
            "width_px": view.width_px,
            "height_px": view.height_px,
            "tangents": view.tangents,
        }


def walk_times(renderer, handle, walk: Walk) -> tuple[list[float], dict[str, float]]:
    """Times of all frames, ms, and the median of each stage."""
    times_ms, stages_ms = [], []
    for view, state in [*zip(walk.views, walk.states, strict=True)][:WARM_UP_COUNT]:
        renderer.render(view, handle, **state, output="srgb8")
    for view, state in zip(walk.views, walk.states, strict=True):
        start_s = time.perf_counter()
        frame = renderer.render(view, handle, **state, output="srgb8")
        times_ms.append(1e3 * (time.perf_counter() - start_s))
        stages_ms.append(frame.stage_times_ms)
    names = {name for stages in stages_ms for name in stages}
    medians = {
        name: float(np.median([stages.get(name, 0.0) for stages in stages_ms]))
        for name in sorted(names)
    }
    return times_ms, medians


def frame_error_db(
    renderer, handle, walk: Walk, eye: str, *, compute: bool
) -> float | None:
    """PSNR of the judged frame; None where its reference is not there."""
    view, state = walk.views[walk.judged], walk.states[walk.judged]
    spec = grid_spec(
        **walk.camera,
        mode="quality",
        pupil_range_mm=(state["pupil_diameter_mm"],) * 2,
        focus_range_dpt=(state["focus_dpt"],) * 2,
        object_range_dpt=path_settings(SCENE)["object_range_dpt"],
    )
    exact = EyeState(traced_eye(eye, spec), spec, *state.values())
    windows = judged_windows(walk.size_px)
    if not compute and not all(
        has_reference(view, exact, bins=True, window=window) for window in windows
    ):
        return None
    seen = renderer.render(view, handle, **state).color
    pairs = [
        (
            seen if window is None else window.of(seen),
            dense_reference(view, exact, bins=True, window=window),
        )
        for window in windows
    ]
    return psnr_db(
        *(
            np.concatenate([part.reshape(-1, 3) for part in parts])
            for parts in zip(*pairs, strict=True)
        )
    )


def judged_windows(size_px: tuple[int, int]) -> list[Window | None]:
    """Parts of a frame whose error is measured; None is the whole."""
    width_px, height_px = size_px
    if width_px * height_px <= WHOLE_PIXELS:
        return [None]
    middle_y = (height_px - WINDOW_PX) // 2
    corners = [
        ((width_px - WINDOW_PX) // 2, middle_y),
        (0, middle_y),
        (width_px - WINDOW_PX, height_px - WINDOW_PX),
    ]
    return [Window(x, y, WINDOW_PX, WINDOW_PX) for x, y in corners]


@dataclass(frozen=True)
class Case:
    """What rows of one eye, size and number of cores have in common."""

    eye: str
    setting: str
    n: int
    error_db: float | None
    reference: str

    def row(self, method: str, times_ms: list[float]) -> Row:
        """Return a row of a method or stage."""
        return Row(
            bench="live",
            method=method,
            case=self.eye,
            setting=self.setting,
            n=self.n,
            median_ms=float(np.median(times_ms)),
            p95_ms=float(np.percentile(times_ms, 95)),
            memory_mb=memory_mb(),
            error_name="psnr_db",
            error=float("nan") if self.error_db is None else self.error_db,
            reference=self.reference,
        )


def eye_rows(
    eye: str, walk: Walk, threads: list[int], *, errors: bool, gl=None
) -> list[Row]:
    """Rows of one eye and size, one for each number of threads, and its stages.

    ``gl`` is an OpenGL renderer to measure too.
    """
    spec = grid_spec(**walk.camera, mode="dynamic", **path_settings(SCENE))
    store = build_psf_store(traced_eye(eye, spec), spec)
    rows: list[Row] = []
    error_db = None
    reference = "dense, over the field, bins of 0.2 deg and 0.005 dpt"
    if judged_windows(walk.size_px) != [None]:
        reference += f", three windows of {WINDOW_PX} x {WINDOW_PX} px"
    for name, renderer, of_walk in measured_engines(walk, threads, gl=gl):
        handle = renderer.load(store)
        if error_db is None or renderer is gl:
            error_db = frame_error_db(renderer, handle, walk, eye, compute=errors)
        times_ms, stages_ms = walk_times(renderer, handle, of_walk)
        setting = f"{walk.size_px[0]}x{walk.size_px[1]} {name}"
        case = Case(eye, setting, len(times_ms), error_db, reference)
        rows.append(case.row("frame", times_ms))
        rows += [
            case.row(f"  {stage.removesuffix('_ms')}", [median_ms])
            for stage, median_ms in stages_ms.items()
        ]
        if renderer is not gl:
            renderer.close()
        else:
            handle.release()
    return rows


def measured_engines(walk: Walk, threads: list[int], *, gl) -> Iterator[tuple]:
    """Name, renderer and walk of each way to filter."""
    if gl is not None:
        yield "GL", gl, walk.shortened(GL_FRAMES)
    for n_threads in threads:
        cores = f"{n_threads} core" + "s" * (n_threads > 1)
        yield cores, NativeRenderer(n_threads=n_threads), walk


def main(argv: list[str] | None = None) -> None:
    """Run, print, and write tests/benchmarks/results/live.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one eye, 192x108")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--eyes", nargs="+", default=CONDITIONS, choices=CONDITIONS)
    parser.add_argument("--sizes", nargs="+", type=parse_size, metavar="WxH")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2], metavar="N")
    parser.add_argument(
        "--frames", type=int, metavar="N", help="24, of large frames 12"
    )
    parser.add_argument("--gl", action="store_true", help="the OpenGL engine too")
    parser.add_argument(
        "--errors", action="store_true", help="compute references that lack"
    )
    options = parser.parse_args(argv)
    sizes = options.sizes or [(480, 270), (1280, 720)]
    eyes = options.eyes
    if options.quick:
        sizes, eyes = [(192, 108)], eyes[:1]
    rows: list[Row] = []
    gl = open_renderer("gl") if options.gl else None
    for size_px in sizes:
        usual = 24 if size_px[0] * size_px[1] <= WHOLE_PIXELS else 12
        walk = Walk.of(size_px, options.frames or usual)
        for eye in eyes:
            errors = options.errors or options.quick
            rows += eye_rows(eye, walk, options.threads, errors=errors, gl=gl)
            print(f"{size_px} {eye}", file=sys.stderr, flush=True)
    content = report(rows, machine=machine_info())
    for row in content["rows"]:
        row["error"] = None if np.isnan(row["error"]) else row["error"]
    if options.json:
        print(json.dumps(content))
        return
    print_rows(rows)
    if not options.quick:
        print(write_report("live", content).relative_to(RESULTS.parents[2]))
    if gl is not None:
        plot_stages(rows, (OUT if options.quick else RESULTS) / "live.png")


if __name__ == "__main__":
    main()
