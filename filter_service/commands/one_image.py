"""Filter one RGB-D image through one eye, from profile to pixels, without a server."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimator.profiles import EyeProfile
from filter_service.gl.gpu import Gpu
from filter_service.planning.eye import Eye
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.plan import plan_cache
from filter_service.psfs.build import build_psf_store
from filter_service.psfs.eye_model import prepare_eye
from filter_service.rendering.frame import View, fill_missing_depth, object_dpt
from filter_service.rendering.renderer import FilterRenderer, Rendered
from filter_service.wire.profiles import DEFAULT_ACCURACY

NEAREST_OBJECT_DPT = 20.0
"""Nearest object distance given PSFs of its own; nearer pixels count as clamped."""

KEPT_ENERGY_RATIO = 0.998
"""A single image has time for wider kernels than a stream: about 70 dB, not 55."""


@dataclass(frozen=True)
class ImageSettings:
    """What of the eye and the filter one image is made with."""

    pupil_diameter_mm: float
    focus_dpt: float
    accumulation: str = "coverage"
    diffraction: bool = True
    chromatic: bool = True
    lateral_color: bool = False
    merge: bool = True
    output: str = "linear"
    eye_model: str = "wavefront"
    accuracy: str = DEFAULT_ACCURACY
    mode: str = "on-axis"
    grid: str = "planned"
    tolerance: str = "normal"
    gaze_deg: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class FilteredImage:
    """A filtered image and how it came about."""

    rendered: Rendered
    eye_notes: tuple[str, ...]
    grid: GridSpec
    plan: CachePlan
    gl_renderer: str
    build_ms: float
    start_ms: float
    render_ms: float


def symmetric_tangents(
    *, width_px: int, height_px: int, vertical_fov_deg: float
) -> tuple[float, float, float, float]:
    """Tangents (left, right, up, down) of a centred camera with square pixels."""
    up = math.tan(math.radians(vertical_fov_deg) / 2.0)
    right = up * width_px / height_px
    return -right, right, up, -up


def object_range_dpt(view: View) -> tuple[float, float]:
    """Farthest and nearest object distance of a view, as (low, high) dpt.

    Missing depth is filled first, by the rule of `frame.fill_missing_depth`; what is
    hidden counts where it is.
    """
    filled_m, _ = fill_missing_depth(view.depth_m)
    distance_dpt = object_dpt(view, filled_m)
    if view.hidden_depth_m is not None:
        holds = view.hidden_depth_m > 0.0
        hidden_m = np.where(holds, view.hidden_depth_m, filled_m)
        distance_dpt = np.stack([distance_dpt, object_dpt(view, hidden_m)])
    low_dpt, high_dpt = float(distance_dpt.min()), float(distance_dpt.max())
    return min(low_dpt, NEAREST_OBJECT_DPT), min(high_dpt, NEAREST_OBJECT_DPT)


def grid_spec(view: View, settings: ImageSettings) -> GridSpec:
    """Return what the PSFs of one view must cover."""
    pupil_mm, focus_dpt = settings.pupil_diameter_mm, settings.focus_dpt
    return GridSpec.for_camera(
        width_px=view.width_px,
        height_px=view.height_px,
        tangents=view.tangents,
        pupil_range_mm=(pupil_mm, pupil_mm),
        object_range_dpt=object_range_dpt(view),
        focus_range_dpt=(focus_dpt, focus_dpt),
        diffraction=settings.diffraction,
        chromatic=settings.chromatic,
        lateral_color=settings.lateral_color,
        mode=settings.mode,
        grid=settings.grid,
        tolerance=settings.tolerance,
        gaze_deg=settings.gaze_deg,
        kept_energy_ratio=KEPT_ENERGY_RATIO,
    )


def _prepare(
    eye: EyeProfile, grid: GridSpec, settings: ImageSettings
) -> tuple[Eye, tuple[str, ...]]:
    return prepare_eye(
        eye, grid, eye_model=settings.eye_model, accuracy=settings.accuracy
    )


def plan_one_image(view: View, eye: EyeProfile, settings: ImageSettings) -> CachePlan:
    """Decide which PSFs one view needs, and compute none.

    Raises
    ------
    ValueError
        A setting out of range; a plan beyond the memory budget.
    """
    grid = grid_spec(view, settings)
    prepared, _ = _prepare(eye, grid, settings)
    return plan_cache(prepared, grid)


def filter_one_image(
    view: View,
    eye: EyeProfile,
    settings: ImageSettings,
    *,
    progress: Callable[[float, str], None] | None = None,
) -> FilteredImage:
    """Build the PSFs that one view needs, start the GPU, and filter the view.

    Raises
    ------
    ValueError
        A setting out of range, a blur too large for the image, or a plan beyond the
        memory budget.
    RenderError
        The GPU part failed.
    """
    grid = grid_spec(view, settings)
    clock_s = [time.perf_counter()]
    prepared, eye_notes = _prepare(eye, grid, settings)
    store = build_psf_store(prepared, grid, progress=progress)
    clock_s.append(time.perf_counter())
    gpu = Gpu()
    renderer = FilterRenderer(gpu)
    handle = renderer.load(store)
    clock_s.append(time.perf_counter())
    rendered = renderer.render(
        view,
        handle,
        pupil_diameter_mm=settings.pupil_diameter_mm,
        focus_dpt=settings.focus_dpt,
        accumulation=settings.accumulation,
        merge=settings.merge,
        output=settings.output,
    )
    clock_s.append(time.perf_counter())
    build_ms, start_ms, render_ms = (1000.0 * step for step in np.diff(clock_s))
    return FilteredImage(
        rendered=rendered,
        eye_notes=eye_notes,
        grid=grid,
        plan=store.plan,
        gl_renderer=gpu.info["renderer"],
        build_ms=float(build_ms),
        start_ms=float(start_ms),
        render_ms=float(render_ms),
    )
