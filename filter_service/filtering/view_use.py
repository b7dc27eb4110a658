"""What a frame asks of an eye: its state, and how near and far its objects are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from filter_service.building.jobs import LookAt
from filter_service.building.used_ranges import Range
from filter_service.filtering.stream_use import FrameUse
from filter_service.rgbd_view import LEAST_DEPTH_M, RgbdView
from filter_service.settings import MAX_PLANES, MAX_VERGENCE_DPT, PLANE_ROOM_DPT

STEP_PX = 8
"""Every so many pixels of a view are looked at: a thing so small is blurred by what it
stands before."""

PLANES_STEP_PX = 4
"""The same, where there seem to be planes and nothing else."""

FIRST_LOOK_COUNT = 64
"""So many depths are looked at first, and most often show more than a few planes."""


def frame_use(views: Sequence[RgbdView], look_at: LookAt, *, at_s: float) -> FrameUse:
    """Return what a frame of several views asks for."""
    ranges = [_object_range_dpt(view) for view in views]
    planes_dpt = [planes_of_view_dpt(view) for view in views]
    every_dpt = sorted({p for planes in planes_dpt for p in planes})
    is_flat = all(planes_dpt) and len(every_dpt) <= MAX_PLANES
    return FrameUse(
        at_s,
        look_at.pupil_diameter_mm,
        look_at.focus_dpt,
        (min(low for low, _ in ranges), max(high for _, high in ranges)),
        tuple(every_dpt) if is_flat else (),
    )


def planes_of_view_dpt(
    view: RgbdView, *, step_px: int = PLANES_STEP_PX
) -> tuple[float, ...]:
    """Planes of a view that has a few and nothing else, ascending; else none.

    Missing depth aside.

    Parameters
    ----------
    step_px : int
        Every so many pixels are looked at.
    """
    if view.depth_kind != "planar":
        return ()
    few_m = _valid_depths_m(view, step_px=STEP_PX)
    few_m = few_m[:: max(few_m.size // FIRST_LOOK_COUNT, 1)]
    if not _plane_steps(few_m):
        return ()
    steps = _plane_steps(_valid_depths_m(view, step_px=step_px))
    return tuple(PLANE_ROOM_DPT * step for step in sorted(steps))


def _plane_steps(depths_m: NDArray[np.float32]) -> list[float]:
    """Planes on which planar depths (n,) lie, in steps of `PLANE_ROOM_DPT`.

    None where there are more than a few.
    """
    with np.errstate(divide="ignore"):
        left = 1.0 / (PLANE_ROOM_DPT * depths_m)
    found: list[float] = []
    while left.size:
        if len(found) == MAX_PLANES or left[0] * PLANE_ROOM_DPT > MAX_VERGENCE_DPT:
            return []
        found.append(float(np.rint(left[0])))
        left = left[np.abs(left - found[-1]) > 1.0]
    return found


def _valid_depths_m(view: RgbdView, *, step_px: int) -> NDArray[np.float32]:
    depths_m = [d[::step_px, ::step_px] for d in view.surface_depths_m]
    return np.concatenate([d[d >= LEAST_DEPTH_M] for d in depths_m])


def _object_range_dpt(view: RgbdView) -> Range:
    """Bounds of the object distances of a view, dpt; infinity where nothing is valid.

    Planar depth is that along the axis: towards the corners objects are farther.
    """
    valid_m = _valid_depths_m(view, step_px=STEP_PX)
    if valid_m.size == 0:
        return 0.0, 0.0
    stretch = view.camera.corner_distance_ratio if view.depth_kind == "planar" else 1.0
    with np.errstate(divide="ignore"):
        far_dpt = 1.0 / (float(valid_m.max()) * stretch)
        near_dpt = float(1.0 / valid_m.min())
    return far_dpt, min(near_dpt, MAX_VERGENCE_DPT)
