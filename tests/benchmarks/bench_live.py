"""Streams whose pupil and focus change in every frame: frame time and image error.

    python -m tests.benchmarks.bench_live [--quick] [--json] [--gl]
        [--eyes NAME ...] [--sizes WxH ...] [--threads N ...] [--tolerances X ...]
        [--frames N] [--errors]

The demo's walk through *Courtyard*, colour and depth as a client sends them, 8-bit
sRGB in and out, over the whole visual field ("dynamic"): every frame has another view,
pupil and focus, so that its kernels are blended anew.  Rendering the scene is not in
the times.

The error is that of one frame of the walk, in linear light, against the dense
reference: the exact PSF of every pixel, in bins of 0.2 degrees and 0.005 dpt.  Of large
frames three windows of 256 x 256 are judged (middle, left edge, corner), as a reference
of the whole takes tens of minutes.  References are kept under out/dense_references;
without ``--errors`` only what lies there is used.

``--gl`` measures the OpenGL engine in the same run, in few frames where it has no GPU,
and draws the times of the stages of both, results/live.png.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from clients.commands.options import read_size_px
from clients.pyrender_stream import path_settings
from filter_service.gl_device import is_software_renderer
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.native import NativeRenderer
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
from tests.benchmarks.live_walk import (
    SCENE,
    WHOLE_PIXELS,
    WINDOW_PX,
    Judge,
    Walk,
    judged_windows,
    walk_times,
)
from tests.benchmarks.published_figures import CONDITIONS
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye

SOFTWARE_GL_FRAMES = 3
"""Of the walk, where OpenGL is the processor's work."""


@dataclass(frozen=True)
class Case:
    """What rows of one eye, size and way have in common."""

    eye: str
    setting: str
    n: int
    error_db: float
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
            error=self.error_db,
            reference=self.reference,
        )


@dataclass(frozen=True)
class Way:
    """One way to filter a walk."""

    name: str
    renderer: object
    tolerance: float = 1.0
    frame_count: int | None = None


def ways_of(options: argparse.Namespace, gl) -> Iterator[Way]:
    """OpenGL, if it is there; the native engine on cores, and at tolerances."""
    if gl is not None:
        few = SOFTWARE_GL_FRAMES if is_software_renderer(gl.name) else None
        yield Way("GL", gl, frame_count=few)
    for n_threads in options.threads:
        cores = f"{n_threads} core" + "s" * (n_threads > 1)
        renderer = NativeRenderer(n_threads=n_threads)
        yield Way(cores, renderer)
        if n_threads == max(options.threads):
            for tolerance in options.tolerances:
                name = f"{cores}, tolerance {tolerance:g}"
                yield Way(name, renderer, tolerance)
        renderer.close()


def eye_rows(eye: str, walk: Walk, ways: Iterator[Way], judge: Judge) -> list[Row]:
    """Rows of one eye and size, each way and its stages."""
    spec = grid_spec(**walk.camera, mode="dynamic", **path_settings(SCENE))
    store = build_psf_store(traced_eye(eye, spec), spec)
    reference = "dense, over the field, bins of 0.2 deg and 0.005 dpt"
    if judged_windows(walk.size_px) != [None]:
        reference += f", three windows of {WINDOW_PX} x {WINDOW_PX} px"
    rows: list[Row] = []
    for way in ways:
        handle = way.renderer.load(store)
        error_db = judge.error_db(way.renderer, handle, way.tolerance)
        of_way = walk.shortened(way.frame_count)
        times_ms, stages_ms = walk_times(way.renderer, handle, of_way, way.tolerance)
        setting = f"{walk.size_px[0]}x{walk.size_px[1]} {way.name}"
        case = Case(eye, setting, len(times_ms), error_db, reference)
        rows.append(case.row("frame", times_ms))
        rows += [
            case.row(f"  {stage.removesuffix('_ms')}", [median_ms])
            for stage, median_ms in stages_ms.items()
        ]
    return rows


def main(argv: list[str] | None = None) -> None:
    """Run, print, and write tests/benchmarks/results/live.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one eye, 192x108")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--eyes", nargs="+", default=CONDITIONS, choices=CONDITIONS)
    parser.add_argument("--sizes", nargs="+", type=read_size_px, metavar="WxH")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2], metavar="N")
    parser.add_argument(
        "--frames", type=int, metavar="N", help="24, of large frames 12"
    )
    parser.add_argument(
        "--tolerances",
        nargs="*",
        type=float,
        default=[1.4, 2.0],
        metavar="X",
        help="others than the usual 1, on most cores",
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
            judge = Judge.of(walk, eye, compute=errors)
            rows += eye_rows(eye, walk, ways_of(options, gl), judge)
            print(f"{size_px} {eye}", file=sys.stderr, flush=True)
    renderers = {} if gl is None else {"gl": gl.name}
    content = report(rows, machine={**machine_info(), "renderers": renderers})
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
