"""Depth that an OpenXR application submits, which is often wrong, as planar depth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Depth = NDArray[np.float32]

CHECK_STRIDE = 8
MAX_INVALID_RATIO = 0.2
"""Largest fraction of values that are not in the range of the depth buffer."""

NEAR_RATIO = 2.0
"""The planes are swapped if at least half the pixels are closer than this many times
the near plane, which no program draws."""

FAR_RATIO = 4.0
FAR_PLANE_RATIO = 0.99
NOISE_RATIO = 0.5
"""Median difference of neighbors to median deviation: 1 in noise, 0.001 in a room."""


class DepthRange(NamedTuple):
    """Values of `XrCompositionLayerDepthInfoKHR`.

    Attributes
    ----------
    min_depth, max_depth : float
        Values in the buffer at `near_m` and `far_m`.
    near_m, far_m : float
        Planar depths; near is farther than far in reversed buffers, and one of them may
        be infinite.
    """

    min_depth: float
    max_depth: float
    near_m: float
    far_m: float

    def problem(self) -> str:
        """Return what is wrong with the values; empty if nothing is."""
        low, high, near_m, far_m = self
        if not 0.0 <= low < high <= 1.0:
            return f"the range of the buffer is {low:g} to {high:g}"
        if not (near_m > 0.0 and far_m > 0.0):  # also NaN
            return f"its planes are at {near_m:g} and {far_m:g} m"
        if near_m == far_m:
            return f"both its planes are at {near_m:g} m"
        return ""


QT_NEAR_M = 1.0


def corrected_range(given: DepthRange, engine: str) -> tuple[DepthRange, str]:
    """Return the range that an engine means, and a note if that differs.

    Qt Quick 3D (6.8 to 6.12) states its planes in centimeters, and renders with a
    projection for depths from 0 to 1 in OpenGL's range from -1 to 1, so that its values
    are between 0.5 and 1.
    """
    planes_m = given.near_m, given.far_m
    if engine != "Qt" or not min(planes_m) >= QT_NEAR_M:
        return given, ""
    found = DepthRange(0.5, 1.0, 0.01 * given.near_m, 0.01 * given.far_m)
    return found, "its planes are in centimeters, as always in Qt Quick 3D; corrected"


def planar_depth(
    values: Depth, given: DepthRange, size_px: tuple[int, int]
) -> tuple[Depth | None, str]:
    """Return planar depth in m for the pixels of an image, and a note.

    Parameters
    ----------
    values : (h, w) float32
        Depth buffer, 0 to 1.
    given : DepthRange
    size_px : (int, int)
        Width and height of the image, which may differ from those of the buffer.

    Returns
    -------
    depth_m : (height, width) float32, or None if the buffer contains no depth
    note : str
        What was found to be wrong; empty if nothing was.
    """
    problem = given.problem()
    if problem:
        return None, problem
    sample = values[::CHECK_STRIDE, ::CHECK_STRIDE]
    is_valid = (sample >= given.min_depth) & (sample <= given.max_depth)
    if np.mean(is_valid) < 1.0 - MAX_INVALID_RATIO:
        return None, "most of its values are out of range"
    note = ""
    if _is_swapped(sample[is_valid], given):
        given = given._replace(near_m=given.far_m, far_m=given.near_m)
        note = "its near and far planes are swapped; corrected"
    if _is_cleared(sample[is_valid], given):
        return None, f"all its values are {sample[is_valid][0]:g}"
    if _is_noise(values[::CHECK_STRIDE], given):
        return None, "the values of neighboring pixels are unrelated"
    height_px, width_px = values.shape
    if (width_px, height_px) != size_px:
        values = values[_nearest(height_px, size_px[1])][
            :, _nearest(width_px, size_px[0])
        ]
    return _planar(values, given), note


def _planar(values: Depth, given: DepthRange) -> Depth:
    """Return planar depth, m; 0 where there is none."""
    # The inverse of planar depth is linear in the values; a plane may be infinite.
    low, high, near_m, far_m = given
    slope = (1.0 / far_m - 1.0 / near_m) / (high - low)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = np.float32(1.0) / (
            values * np.float32(slope) + np.float32(1.0 / near_m - slope * low)
        )
    # Rounding at an infinite plane may give a small negative inverse.
    far = np.float32(max(near_m, far_m))
    np.copyto(depth_m, far, where=~(depth_m > 0.0))
    return np.where(_has_depth(values, given), depth_m, np.float32(0.0))


def _has_depth(values: Depth, given: DepthRange) -> NDArray[np.bool_]:
    """Return which pixels have depth.

    Nothing is drawn exactly at the near plane: such values are of pixels without depth,
    as those that were not a number and were clamped.
    """
    low, high, near_m, far_m = given
    if near_m < far_m:
        return (values > low) & (values <= high)
    return (values >= low) & (values < high)


def _is_swapped(values: Depth, given: DepthRange) -> bool:
    """Whether the image is only plausible with swapped planes."""
    near_m = min(given.near_m, given.far_m)
    other = given._replace(near_m=given.far_m, far_m=given.near_m)
    # Where nothing was drawn, swapped planes have their near plane.
    own = float(np.median(np.maximum(_planar(values, given), near_m)))
    swapped = float(np.median(np.maximum(_planar(values, other), near_m)))
    return own < NEAR_RATIO * near_m and (
        swapped > FAR_RATIO * near_m or math.isinf(swapped)
    )


def _is_cleared(values: Depth, given: DepthRange) -> bool:
    """Whether nothing was drawn; a wall across the view has one value as well."""
    if np.ptp(values) > 0.0:
        return False
    near_m, far_m = sorted((given.near_m, given.far_m))
    depth_m = float(_planar(values[:1], given)[0])
    return not NEAR_RATIO * near_m < depth_m < FAR_PLANE_RATIO * far_m


def _is_noise(values: Depth, given: DepthRange) -> bool:
    """Whether neighbors in a row differ as much as pixels do on the whole."""
    rows = np.where(_has_depth(values, given), values, np.float32(np.nan))
    own = rows[np.isfinite(rows)]
    spread = np.median(np.abs(own - np.median(own)))
    steps = np.abs(np.diff(rows, axis=1))
    step = np.median(steps[np.isfinite(steps)]) if np.isfinite(steps).any() else 0.0
    return bool(step > NOISE_RATIO * spread > 0.0)


def _nearest(given_px: int, wanted_px: int) -> NDArray[np.intp]:
    """Return the index of the nearest pixel for each wanted one."""
    return ((np.arange(wanted_px) + 0.5) * (given_px / wanted_px)).astype(np.intp)
