"""Compiled loops over the maps of `cell_maps.py`."""

import math

from numba import njit

UNMOVED_PX = 0.5
"""Maps that would move light by less are not applied: interpolation between stored
pixels would blur it by as much."""

UNMOVED_RATIO = 0.1
"""Maps that change a kernel's size by less are not applied: the differences between the
field nodes around a cell are blended away.  At 5 mm over the field of the demo the
image then differs by 63 to 69 dB from the one with all maps (cataract, myopia,
keratoconus), and the blend takes half of the time."""

MAX_REACH_PX = 255
"""One byte per side; light that a map moves beyond it is cut off."""


@njit(cache=True, nogil=True, error_model="numpy")
def fill_ratios(maps, inverse, ratios):
    """Fill in inverses of maps (n, 3, 2, 2), and ratios (4, n, 3) as in `MapTables`."""
    for cell in range(maps.shape[0]):
        for j in range(maps.shape[1]):
            a, b = maps[cell, j, 0, 0], maps[cell, j, 0, 1]
            c, d = maps[cell, j, 1, 0], maps[cell, j, 1, 1]
            area = a * d - b * c
            inverse[cell, j, 0, 0], inverse[cell, j, 0, 1] = d / area, -b / area
            inverse[cell, j, 1, 0], inverse[cell, j, 1, 1] = -c / area, a / area
            # The largest singular value of the inverse is the map's over its area.
            longest = 0.5 * (math.hypot(a + d, b - c) + math.hypot(a - d, b + c))
            ratios[0, cell, j] = abs(area)
            ratios[1, cell, j] = abs(area) / abs(a * d)
            ratios[2, cell, j] = longest / abs(area)
            off = (a - 1.0) ** 2 + b**2 + c**2 + (d - 1.0) ** 2
            ratios[3, cell, j] = math.sqrt(off)


@njit(cache=True, nogil=True, error_model="numpy")
def moves(change_ratio, radius_px):
    """Return whether a map is worth applying to a kernel."""
    return change_ratio > UNMOVED_RATIO and change_ratio * radius_px > UNMOVED_PX


@njit(cache=True, nogil=True, error_model="numpy")
def mapped_reach(out, cell, corner, reach_px):
    """Convert reaches (left, right, up, down) to the image's pixels, in place.

    Interpolated light ends one stored pixel beyond the last one.
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
