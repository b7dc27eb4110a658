"""The letter chart as an eye sees it near and far, filtered by an `EyeFilter`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from clients.figures import EyeStudy
from clients.figures.psfs import ARCMIN_PER_MRAD, ray_directions_mrad
from clients.figures.study import PUPILS_MM
from clients.scenes.letter_chart import letter_chart
from filter_service import Camera, EyeFilter, FilterSettings

DISTANCES_M = (0.4, 1.0, 6.0)
FIELD_DEG = 8.2
LOG_MAR = tuple(round(1.0 - 0.1 * k, 1) for k in range(13))
SIDE_PX, LEAST_SIDE_PX = 860, 180
LARGEST_BLUR_PX = 190.0
"""Largest blur radius that PSFs are computed for, with a margin for the edge."""

Chart = tuple[float, float]
"""Pupil, mm, and distance, m."""


def charts_of(
    study: EyeStudy,
    *,
    pupils_mm: Sequence[float] = PUPILS_MM,
    distances_m: Sequence[float] = DISTANCES_M,
    progress: Callable[[float], None] | None = None,
) -> dict[Chart, NDArray[np.uint8]]:
    """Return the chart for each pupil and distance, with the eye focusing on it.

    The filters of a process share one worker: call from one thread at a time.

    Raises
    ------
    FilterError
        If no engine works here, or the eye's blur is wider than the largest PSF.
    """
    side_px = picture_side_px(study, max(pupils_mm), distances_m)
    camera = Camera.from_fov(FIELD_DEG, width_px=side_px, height_px=side_px)
    views = {
        d: letter_chart(camera, distance_m=d, log_mar=LOG_MAR).view for d in distances_m
    }
    found: dict[Chart, NDArray[np.uint8]] = {}
    with EyeFilter(camera=camera) as eye_filter:
        for pupil_mm in pupils_mm:
            settings = _settings(pupil_mm, distances_m)
            eye_filter.set_profile(study.profile, settings=settings, cameras=[camera])
            eye_filter.wait()
            for distance_m, view in views.items():
                seen = eye_filter.filter(
                    view, pupil_diameter_mm=pupil_mm, focus_dpt=1.0 / distance_m
                )
                found[pupil_mm, distance_m] = seen.color
                if progress is not None:
                    progress(len(found) / (len(pupils_mm) * len(views)))
    return found


@cache
def chart_rows() -> tuple[tuple[float, float], ...]:
    """Return the size of each row, logMAR, and its height in the image, 0 to 1."""
    camera = Camera.from_fov(FIELD_DEG, width_px=LEAST_SIDE_PX, height_px=LEAST_SIDE_PX)
    chart = letter_chart(camera, distance_m=1.0, log_mar=LOG_MAR)
    return tuple((row.log_mar, row.y_px / LEAST_SIDE_PX) for row in chart.rows)


def _settings(pupil_mm: float, distances_m: Sequence[float]) -> FilterSettings:
    at_dpt = tuple(sorted(1.0 / d for d in distances_m))
    return FilterSettings(
        mode="on-axis",  # a chart lies within 4 deg
        pupil_range_mm=(pupil_mm, pupil_mm),
        focus_range_dpt=(at_dpt[0], at_dpt[-1]),
        object_planes_dpt=at_dpt,
    )


def picture_side_px(
    study: EyeStudy, pupil_mm: float, distances_m: Sequence[float]
) -> int:
    """Return the image size that the widest blur allows: blurred images need few px."""
    reach_mrad = 0.0
    for distance_m in distances_m:
        at_dpt = 1.0 / distance_m
        seen = study.wavefront(pupil_mm, object_dpt=at_dpt, focus_dpt=at_dpt)
        slopes = np.linalg.norm(ray_directions_mrad(seen), axis=1)
        aside_mrad = 0.0
        if seen.rings is not None:
            radius_mm = seen.circle_diameter_mm / 2.0
            aside_mrad = float(seen.rings.reach_mrad(radius_mm, seen.wavelength_nm))
        reach_mrad = max(reach_mrad, float(slopes.max()) + aside_mrad)
    reach_arcmin = max(reach_mrad * ARCMIN_PER_MRAD, 1e-6)
    fitting = math.floor(LARGEST_BLUR_PX * FIELD_DEG * 60.0 / reach_arcmin)
    return max(min(SIDE_PX, fitting), LEAST_SIDE_PX)
