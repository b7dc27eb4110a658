"""Compiled loops over the maps of `cell_maps.py`."""

import math

from numba import njit

from filter_service.constants import MAX_REACH_PX, MIN_SHIFT_PX, MIN_SHIFT_RATIO


@njit(cache=True, nogil=True, error_model="numpy")
def fill_ratios(maps, inverse, ratios):
    """Write inverses of maps (n, 3, 2, 2) and the ratios (4, n, 3) of `MapTables`."""
    for cell in range(maps.shape[0]):
        for j in range(maps.shape[1]):
            a, b = maps[cell, j, 0, 0], maps[cell, j, 0, 1]
            c, d = maps[cell, j, 1, 0], maps[cell, j, 1, 1]
            area = a * d - b * c
            inverse[cell, j, 0, 0], inverse[cell, j, 0, 1] = d / area, -b / area
            inverse[cell, j, 1, 0], inverse[cell, j, 1, 1] = -c / area, a / area
            # Largest singular value of the inverse: that of the map over its area.
            longest = 0.5 * (math.hypot(a + d, b - c) + math.hypot(a - d, b + c))
            ratios[0, cell, j] = abs(area)
            ratios[1, cell, j] = abs(area) / abs(a * d)
            ratios[2, cell, j] = longest / abs(area)
            off = (a - 1.0) ** 2 + b**2 + c**2 + (d - 1.0) ** 2
            ratios[3, cell, j] = math.sqrt(off)


@njit(cache=True, nogil=True, error_model="numpy")
def needs_map(change_ratio, radius_px):
    """Return whether a map changes a kernel noticeably."""
    return change_ratio > MIN_SHIFT_RATIO and change_ratio * radius_px > MIN_SHIFT_PX


@njit(cache=True, nogil=True, error_model="numpy")
def mapped_reach(out, cell, corner, reach_px):
    """Convert reaches (left, right, up, down) to the image's pixels, in place.

    Linear interpolation extends the light by one stored pixel.
    """
    left, right, up, down = reach_px
    for axis in range(2):
        a, b = out[cell, corner, axis, 0], out[cell, corner, axis, 1]
        low = min(-a * (left + 1.0), a * (right + 1.0))
        low += min(-b * (up + 1.0), b * (down + 1.0))
        high = max(-a * (left + 1.0), a * (right + 1.0))
        high += max(-b * (up + 1.0), b * (down + 1.0))
        for side, end in ((2 * axis, -low), (2 * axis + 1, high)):
            whole_px = math.ceil(end - 1e-9) - 1
            reach_px[side] = min(max(whole_px, 0), MAX_REACH_PX)
