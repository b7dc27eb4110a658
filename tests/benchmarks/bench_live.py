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
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.pyrender_stream import path_settings
from filter_service.gl.gpu import Gpu
from filter_service.gl_device import is_software_renderer
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.harness import Row, Run, written_path
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.benchmarks.stream_walks import Moment, courtyard_walk
from tests.benchmarks.view_sources import EyeState, Window
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.numerical.synthetic import psnr_db

MINUTES = 6
SIZES = ((480, 270), (1280, 720))
PATH = path_settings("courtyard")
WARM_UPS = 2
SOFTWARE_GL_FRAMES = 3
"""Of the walk, where OpenGL is the processor's work."""

WHOLE_PIXELS = 640 * 360
"""Largest frame that is judged as a whole."""

WINDOW_PX = 256
STAGES = {  # of the picture: those of the engines
    "plan of kernels": ("psf_plan",),
    "kernels": ("psf_blend", "upload"),
    "fragments": ("prepare", "fragments"),
    "merging": ("merge",),
    "lists and order": ("bin", "sort"),
    "splat (native: and lists)": ("splat", "encode", "readback"),
}


def judged_windows(width_px: int, height_px: int) -> list[Window]:
    """Return the parts of a frame whose error is measured."""
    if width_px * height_px <= WHOLE_PIXELS:
        return [Window(0, 0, width_px, height_px)]
    right, bottom = width_px - WINDOW_PX, height_px - WINDOW_PX
    places = ((right // 2, bottom // 2), (0, bottom // 2), (right, bottom))
    return [Window(*place, WINDOW_PX, WINDOW_PX) for place in places]


def exact_pixels(moment: Moment, eye: str, windows: Sequence[Window]) -> NDArray:
    """Return the pixels (n, 3) of windows through the exact PSF of each."""
    camera = moment.view.camera
    spec = grid_spec(
        camera,
        mode="quality",
        pupil_range_mm=(moment.pupil_diameter_mm,) * 2,
        focus_range_dpt=(moment.focus_dpt,) * 2,
        object_range_dpt=PATH["object_range_dpt"],
    )
    state = EyeState(traced_eye(eye, spec), spec, *moment.state.values())
    whole = Window(0, 0, camera.width_px, camera.height_px)
    return np.concatenate(
        [
            dense_reference(
                moment.view, state, bins=True, window=None if w == whole else w
            ).reshape(-1, 3)
            for w in windows
        ]
    )


def ways(gl) -> Iterator[tuple[str, object, int | None]]:
    """Yield names, renderers and numbers of frames.

    They are OpenGL, if it is there, and the native engine on one and two cores.
    """
    if gl is not None:
        few = SOFTWARE_GL_FRAMES if is_software_renderer(gl.name) else None
        yield "GL", gl, few
    for n_threads, name in ((1, "1 core"), (2, "2 cores")):
        renderer = NativeRenderer(n_threads=n_threads)
        yield name, renderer, None
        renderer.close()


def eye_rows(eye: str, walk: Sequence[Moment], gl) -> list[Row]:
    """Return the rows of one eye and size, each way and its stages."""
    judged, camera = walk[len(walk) // 2], walk[0].view.camera
    windows = judged_windows(camera.width_px, camera.height_px)
    truth = exact_pixels(judged, eye, windows)
    spec = grid_spec(camera, mode="dynamic", **PATH)
    store = build_psf_store(traced_eye(eye, spec), spec)
    reference = "dense, over the field, bins of 0.2 deg and 0.005 dpt"
    if len(windows) > 1:
        reference += f", three windows of {WINDOW_PX} x {WINDOW_PX} px"
    rows: list[Row] = []
    for name, renderer, count in ways(gl):
        handle = renderer.load(store)

        def frame(moment, output, renderer=renderer, handle=handle):
            options = moment.state | {"output": output}
            return renderer.render(moment.view, handle, **options)

        seen = frame(judged, "linear").color
        error_db = psnr_db(
            np.concatenate([w.of(seen).reshape(-1, 3) for w in windows]), truth
        )
        times_ms: dict[str, list[float]] = {"frame": []}
        for moment in walk[:WARM_UPS]:
            frame(moment, "srgb8")
        for number, moment in enumerate(walk[:count]):
            start_s = time.perf_counter()
            stages_ms = frame(moment, "srgb8").stage_times_ms
            times_ms["frame"].append(1e3 * (time.perf_counter() - start_s))
            for stage, stage_ms in stages_ms.items():
                own = times_ms.setdefault(f"  {stage.removesuffix('_ms')}", [])
                own += [0.0] * (number - len(own)) + [stage_ms]
        setting = f"{camera.width_px}x{camera.height_px} {name}"
        rows += [
            row_of(
                *("live", method, eye, setting, own_ms, "psnr_db", error_db, reference)
            )
            for method, own_ms in times_ms.items()
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
    gl = None if run.is_quick else FilterRenderer(Gpu())
    for size_px in ((96, 54),) if run.is_quick else SIZES:
        walk = courtyard_walk(size_px, 24 if size_px[0] <= 640 else 12)
        for eye in CONDITIONS[: 1 if run.is_quick else None]:
            rows += eye_rows(eye, walk, gl)
            print(f"{size_px} {eye}", file=sys.stderr, flush=True)
    if gl is not None:
        plot_stages(rows, written_path("live.png"))
    return rows
