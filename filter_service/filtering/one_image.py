"""Filter one RGB-D image through one eye, from profile to pixels, without a server."""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from estimator.profiles.parse import EyeProfile
from filter_service.filtering.choose_engine import open_engine
from filter_service.filtering.view_use import planes_of_view_dpt
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.plan import plan_cache
from filter_service.psfs.build_store import build_psf_store
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.rendering.filtered_view import FilteredView
from filter_service.rendering.frame import fill_missing_depth, object_dpt
from filter_service.rendering.media_effects import MediaEffects, render_through_media
from filter_service.rgbd_view import RgbdView
from filter_service.settings import (
    MAX_VERGENCE_DPT,
    Accumulation,
    Engine,
    FilterSettings,
    Output,
)

KEPT_ENERGY_RATIO = 0.998
"""A single image has time for wider kernels than a stream: about 70 dB, not 55."""


@dataclass(frozen=True)
class FilteredImage:
    """A filtered image and how it came about."""

    rendered: FilteredView
    eye_notes: tuple[str, ...]
    spec: GridSpec
    plan: CachePlan
    engine: str
    renderer: str
    build_ms: float
    start_ms: float
    render_ms: float


def object_range_dpt(view: RgbdView) -> tuple[float, float]:
    """Farthest and nearest object distance of a view, as (low, high) dpt.

    Missing depth is filled first, by the rule of `frame.fill_missing_depth`; what is
    hidden counts where it is.  Nearer than the nearest distance that may be prepared
    counts as that.
    """
    filled_m, _ = fill_missing_depth(view.depth_m)
    distance_dpt = object_dpt(view, filled_m)
    if view.hidden_depth_m is not None:
        holds = view.hidden_depth_m > 0.0
        hidden_m = np.where(holds, view.hidden_depth_m, filled_m)
        distance_dpt = np.stack([distance_dpt, object_dpt(view, hidden_m)])
    low_dpt, high_dpt = float(distance_dpt.min()), float(distance_dpt.max())
    return min(low_dpt, MAX_VERGENCE_DPT), min(high_dpt, MAX_VERGENCE_DPT)


def image_spec(
    view: RgbdView,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    settings: Mapping[str, Any] = MappingProxyType({}),
) -> GridSpec:
    """Return what the PSFs of one view must cover: one pupil, one focus, its distances.

    Parameters
    ----------
    settings : mapping, optional
        Further fields of `FilterSettings`.

    Raises
    ------
    ValueError
        A setting out of range.
    """
    return GridSpec(
        camera=view.camera,
        settings=FilterSettings(
            pupil_range_mm=(pupil_diameter_mm, pupil_diameter_mm),
            focus_range_dpt=(focus_dpt, focus_dpt),
            object_range_dpt=object_range_dpt(view),
            object_planes_dpt=planes_of_view_dpt(view, step_px=1),
            **settings,
        ),
        kept_energy_ratio=KEPT_ENERGY_RATIO,
    )


def plan_one_image(spec: GridSpec, profile: EyeProfile) -> CachePlan:
    """Decide which PSFs one view needs, and compute none.

    Raises
    ------
    ValueError
        A plan beyond the memory budget.
    """
    eye, _ = eye_for_spec(profile, spec)
    return plan_cache(eye, spec)


def filter_one_image(
    view: RgbdView,
    profile: EyeProfile,
    spec: GridSpec,
    *,
    accumulation: Accumulation = "coverage",
    merge: bool = True,
    render_tolerance: float = 1.0,
    engine: Engine = "auto",
    output: Output = "linear",
    progress: Callable[[float, str], None] | None = None,
) -> FilteredImage:
    """Build the PSFs that one view needs, open an engine, and filter the view.

    Parameters
    ----------
    spec : GridSpec
        As `image_spec` gives it for the view.
    render_tolerance : float
        Errors of rendering against the usual; 0 is exact.
    engine : "auto", "gl" or "native"

    Raises
    ------
    ValueError
        A blur too large for the image, or a plan beyond the memory budget.
    RenderError
        The GPU part failed.
    """
    clock_s = [time.perf_counter()]
    eye, eye_notes = eye_for_spec(profile, spec)
    store = build_psf_store(eye, spec, progress=progress)
    clock_s.append(time.perf_counter())
    with ExitStack() as closing:
        chosen = open_engine(engine, closing)
        handle = chosen.engine.load(store)
        clock_s.append(time.perf_counter())
        rendered = render_through_media(
            chosen.engine,
            view,
            handle,
            MediaEffects.of(profile, spec.settings.display),
            pupil_diameter_mm=spec.settings.pupil_range_mm[0],
            focus_dpt=spec.settings.focus_range_dpt[0],
            accumulation=accumulation,
            merge=merge,
            render_tolerance=render_tolerance,
            output=output,
        )
        clock_s.append(time.perf_counter())
        renderer = chosen.engine.name
    build_ms, start_ms, render_ms = (1000.0 * step for step in np.diff(clock_s))
    return FilteredImage(
        rendered=rendered,
        eye_notes=eye_notes,
        spec=spec,
        plan=store.plan,
        engine=chosen.name,
        renderer=renderer,
        build_ms=float(build_ms),
        start_ms=float(start_ms),
        render_ms=float(render_ms),
    )
