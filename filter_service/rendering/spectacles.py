"""Spectacle magnification: spectacles for myopia make everything appear smaller.

A thin lens of power F, at a distance L in front of the entrance pupil, scales the
tangent of every direction by 1 / (1 - L F): by 0.92 at -6 dpt, 12 mm in front of the
cornea.  A cylinder scales along its meridians.  The view is resampled before it is
filtered, because blur arises in the eye and is not magnified.  Outside the camera's
image, its edge is repeated.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from estimator.optics import prescription as rx
from estimator.profiles.parse import EyeProfile
from filter_service.native import loops
from filter_service.rendering.srgb import linear_from_srgb
from filter_service.rgbd_view import RgbdView

ENTRANCE_PUPIL_MM = 3.05
"""Distance from the cornea, in eyes that are not described by surfaces."""

MM_PER_M = 1e3
Matrix = tuple[tuple[float, float], tuple[float, float]]


def spectacle_magnification(profile: EyeProfile) -> Matrix | None:
    """Return apparent over actual tangents, or None if the profile omits it."""
    if not profile.spectacle_magnification or profile.correction is None:
        return None
    m, j0, j45 = rx.power_vector(replace(profile.correction, vertex_mm=0.0))
    power_dpt = np.array([[m + j0, j45], [j45, m - j0]])
    before_m = (profile.correction.vertex_mm + ENTRANCE_PUPIL_MM) / MM_PER_M
    found = np.linalg.inv(np.eye(2) - before_m * power_dpt)
    (a, b), (c, d) = found.tolist()
    return (a, b), (c, d)


def seen_through(view: RgbdView, magnification: Matrix) -> RgbdView:
    """Return the view as seen through spectacles, in linear light."""
    left, right, up, down = view.tangents
    steps = (right - left) / view.width_px, (down - up) / view.height_px
    frame = np.array([left, up, *steps])
    to_source = np.linalg.inv(np.array(magnification))
    images: dict[str, Any] = {}
    for color, depth in (("color", "depth_m"), ("hidden_color", "hidden_depth_m")):
        light, meters = getattr(view, color), getattr(view, depth)
        if light is None:
            continue
        light, meters = map(np.ascontiguousarray, (_linear(light), meters))
        resampled, resampled_m = np.empty_like(light), np.empty_like(meters)
        loops().call(
            "resample",
            *(shared_threads(), light, meters, *meters.shape, frame, to_source),
            *(resampled, resampled_m),
        )
        images |= {color: resampled, depth: resampled_m}
    return replace(view, **images)


def _linear(color: NDArray[Any]) -> NDArray[np.float32]:
    if color.dtype == np.uint8:
        return _decoding()[color]
    return color.astype(np.float32)


@lru_cache(maxsize=1)
def _decoding() -> NDArray[np.float32]:
    return linear_from_srgb(np.arange(256, dtype=np.uint8)).astype(np.float32)
