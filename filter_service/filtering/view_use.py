"""What a frame asks of an eye: its state, and how near and far its objects are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from filter_service.building.jobs import LookAt
from filter_service.building.used_ranges import Range
from filter_service.filtering.stream_use import FrameUse
from filter_service.rgbd_view import RgbdView
from filter_service.settings import MAX_VERGENCE_DPT

STEP_PX = 8
"""Every so many pixels of a view are looked at: a thing so small is blurred by what it
stands before."""


def frame_use(views: Sequence[RgbdView], look_at: LookAt, *, at_s: float) -> FrameUse:
    """Return what a frame of several views asks for."""
    ranges = [object_range_dpt(view) for view in views]
    return FrameUse(
        at_s,
        look_at.pupil_diameter_mm,
        look_at.focus_dpt,
        (min(low for low, _ in ranges), max(high for _, high in ranges)),
    )


def object_range_dpt(view: RgbdView) -> Range:
    """Bounds of the object distances of a view, dpt; infinity where nothing is valid.

    Planar depth is that along the axis: towards the corners objects are farther.
    """
    depths_m = [d[::STEP_PX, ::STEP_PX] for d in view.surface_depths_m]
    valid_m = np.concatenate([d[d > 0.0] for d in depths_m])
    if valid_m.size == 0:
        return 0.0, 0.0
    left, right, up, down = view.tangents
    stretch = 1.0
    if view.depth_kind == "planar":
        across, along = max(abs(left), abs(right)), max(abs(up), abs(down))
        stretch = math.sqrt(1.0 + across**2 + along**2)
    with np.errstate(divide="ignore"):
        far_dpt = 1.0 / (float(valid_m.max()) * stretch)
        near_dpt = float(1.0 / valid_m.min())
    return far_dpt, min(near_dpt, MAX_VERGENCE_DPT)
