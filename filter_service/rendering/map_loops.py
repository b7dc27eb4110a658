"""Compiled loops over the maps of `cell_maps.py`."""

import math

from numba import njit

MIN_SHIFT_PX = 0.5
"""Maps that would displace light by less are not applied: interpolation between stored
pixels blurs light by as much."""

MIN_SHIFT_RATIO = 0.1
"""Maps that change a kernel's size by less are not applied: blending the three field
nodes averages such differences.  At 5 mm over the field of the demo, the PSNR against
the image with all maps is 63 to 69 dB (cataract, myopia, keratoconus), and blending
takes half of the time."""

MAX_REACH_PX = 255
"""Reaches are stored in one byte per side; light that a map moves farther is lost."""


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
