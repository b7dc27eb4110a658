"""Streams whose pupil and focus change in every frame: frame time and image error.

The demo's walk through the courtyard, color and depth as a client sends them, 8-bit
sRGB in and out, over the whole visual field ("dynamic"): every frame has another view,
pupil and focus, so that its kernels are blended anew.  Rendering the scene is not in
the times.  The OpenGL engine is measured in the same run, in few frames where it has no
GPU, and live.png shows the times of the stages of both.

The error is that of one frame of the walk, in linear light, against the dense
reference: the exact PSF of every pixel, in bins of 0.2 degrees and 0.005 dpt.  Of large
frames three windows of 256 x 256 are judged (middle, left edge, corner), as a reference
of the whole takes tens of minutes.  References are kept under out/dense_references.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from clients.pyrender_stream import path_settings
from filter_service.gl_device import is_software_renderer
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.engines import open_renderer
from tests.benchmarks.harness import RESULTS, Row, Run
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
from tests.benchmarks.rows import row_of
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye

MINUTES = 90
SIZES = ((480, 270), (1280, 720))
SOFTWARE_GL_FRAMES = 3
"""Of the walk, where OpenGL is the processor's work."""


STAGES = {  # of the picture: those of the engines
    "plan of kernels": ("psf_plan",),
    "kernels": ("psf_blend", "upload"),
    "fragments": ("prepare", "fragments"),
    "merging": ("merge",),
    "lists and order": ("bin", "sort"),
    "splat (native: and lists)": ("splat", "encode", "readback"),
}


@dataclass(frozen=True)
class Way:
    """One way to filter a walk."""

    name: str
    renderer: object
    tolerance: float = 1.0
    frame_count: int | None = None


def ways_of(gl) -> Iterator[Way]:
    """Yield OpenGL, if it is there, and the native engine on one and two cores."""
    if gl is not None:
        few = SOFTWARE_GL_FRAMES if is_software_renderer(gl.name) else None
        yield Way("GL", gl, frame_count=few)
    for n_threads in (1, 2):
        cores = f"{n_threads} core" + "s" * (n_threads > 1)
        renderer = NativeRenderer(n_threads=n_threads)
        yield Way(cores, renderer)
        if n_threads == 2:
            for tolerance in (1.4, 2.0):
                yield Way(f"{cores}, tolerance {tolerance:g}", renderer, tolerance)
        renderer.close()


def eye_rows(eye: str, walk: Walk, gl) -> list[Row]:
    """Return the rows of one eye and size, each way and its stages."""
    judge = Judge.of(walk, eye, compute=True)
    spec = grid_spec(**walk.camera, mode="dynamic", **path_settings(SCENE))
    store = build_psf_store(traced_eye(eye, spec), spec)
    reference = "dense, over the field, bins of 0.2 deg and 0.005 dpt"
    if judged_windows(walk.size_px) != [None]:
        reference += f", three windows of {WINDOW_PX} x {WINDOW_PX} px"
    rows: list[Row] = []
    for way in ways_of(gl):
        handle = way.renderer.load(store)
        error_db = judge.error_db(way.renderer, handle, way.tolerance)
        of_way = walk.shortened(way.frame_count)
        times_ms, stages_ms = walk_times(way.renderer, handle, of_way, way.tolerance)
        parts = {f"  {k.removesuffix('_ms')}": [v] for k, v in stages_ms.items()}
        rows += [
            row_of(
                *(
                    "live",
                    method,
                    eye,
                    f"{walk.size_px[0]}x{walk.size_px[1]} {way.name}",
                ),
                *(own_ms, "psnr_db", error_db, reference),
                n=len(times_ms),
            )
            for method, own_ms in {"frame": times_ms, **parts}.items()
        ]
    return rows


def plot_stages(rows: Sequence[Row], path: Path) -> None:
    """A panel for each frame size and engine, eyes side by side."""
    from matplotlib.figure import Figure

    sizes = sorted({row.setting.split()[0] for row in rows}, key=len)
    figure = Figure(figsize=(11.0, 4.2 * len(sizes)), layout="constrained")
    panels = figure.subplots(len(sizes), 2, squeeze=False)
    for line, size in zip(panels, sizes, strict=True):
        for axes, way in zip(line, ("GL", "2 cores"), strict=True):
            _plot_way(axes, [r for r in rows if r.setting == f"{size} {way}"])
            engine = "OpenGL in software" if way == "GL" else "native, two cores"
            axes.set_title(f"{size}, {engine}", fontsize=10)
    figure.legend(
        *panels[0][1].get_legend_handles_labels(), loc="outside lower center", ncols=6
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _plot_way(axes, rows: Sequence[Row]) -> None:
    eyes = list(dict.fromkeys(row.case for row in rows))
    below_ms = [0.0] * len(eyes)
    for stage, parts in STAGES.items():
        times_ms = [
            sum(
                r.median_ms for r in rows if r.case == eye and r.method.strip() in parts
            )
            for eye in eyes
        ]
        axes.bar(eyes, times_ms, bottom=below_ms, label=stage, width=0.7)
        below_ms = [a + b for a, b in zip(below_ms, times_ms, strict=True)]
    for place, eye in enumerate(eyes):
        (frame,) = (r for r in rows if r.case == eye and r.method == "frame")
        axes.annotate(
            f"{frame.median_ms:.0f} ms\n{frame.error:.1f} dB",
            (place, below_ms[place]),
            ha="center",
            va="bottom",
            fontsize=8,
        )
    axes.set_ylim(0.0, 1.25 * max(below_ms, default=1.0))
    axes.set_ylabel("ms a frame")
    axes.tick_params(axis="x", labelsize=8)


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes and sizes, or of a small one."""
    rows: list[Row] = []
    gl = None if run.is_quick else open_renderer("gl")
    for size_px in ((96, 54),) if run.is_quick else SIZES:
        count = 24 if size_px[0] * size_px[1] <= WHOLE_PIXELS else 12
        walk = Walk.of(size_px, count)
        for eye in CONDITIONS[: 1 if run.is_quick else None]:
            rows += eye_rows(eye, walk, gl)
            print(f"{size_px} {eye}", file=sys.stderr, flush=True)
    if gl is not None:
        plot_stages(rows, RESULTS / "live.png")
    return rows
