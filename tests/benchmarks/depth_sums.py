"""Light and coverage of pixels to which sources are added near to far."""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from filter_service.constants import MIN_COVERAGE

BAND_ROWS = 8
"""Rows that one thread adds to; a source reaches few bands, so all stay busy."""

RULES = ("coverage", "paper", "sum")


def normalised(
    light: NDArray, coverage: NDArray, unfiltered: NDArray
) -> NDArray[np.float64]:
    """Light over coverage, (height, width, 3) from planes (3, height, width)."""
    light, coverage = (np.moveaxis(planes, 0, -1) for planes in (light, coverage))
    covered = coverage >= MIN_COVERAGE
    return np.where(covered, light / np.where(covered, coverage, 1.0), unfiltered)


def close_depths(depths: NDArray, light: NDArray, coverage: NDArray) -> None:
    """`close_depth` of all pixels at once."""
    share = np.minimum((1.0 - coverage) / np.maximum(depths[2], MIN_COVERAGE), 1.0)
    light += share * depths[1]
    coverage += share * depths[2]


@njit(cache=True)
def close_depth(at, depths, light, coverage):
    """Add what a pixel has of one depth: its share of what nearer ones leave free."""
    share = min((1.0 - coverage[at]) / max(depths[2][at], MIN_COVERAGE), 1.0)
    light[at] += share * depths[1][at]
    coverage[at] += share * depths[2][at]
    depths[1][at] = 0.0
    depths[2][at] = 0.0


@njit(cache=True)
def add_to_depth(at, weight, color, distance_dpt, step_dpt, sums):
    """Add a source to the depth that a pixel is at, or begin the next one with it.

    ``sums``: arrays of depths, light and coverage, see `add_sources`.
    """
    depths, light, coverage = sums
    if depths[0][at] - distance_dpt > step_dpt:
        close_depth(at, depths, light, coverage)
    if depths[2][at] == 0.0:
        depths[0][at] = distance_dpt
    depths[1][at] += weight * color
    depths[2][at] += weight


@njit(parallel=True, cache=True)
def add_sources(
    rows,
    columns,
    distance_dpt,
    color,
    offset,
    radius_px,
    kernels,
    rule,
    step_dpt,
    depths,
    light,
    coverage,
):
    """Splat sources one after the other; threads share the rows of the image.

    Parameters
    ----------
    rows, columns, distance_dpt : (n,)
        Near to far.
    color, offset, radius_px : (n, 3)
        Light, and where each channel's (2R+1)² weights are in ``kernels``.
    rule : int
        Index into `RULES`.
    step_dpt : float
        Sources no farther apart are at one depth.
    depths : (3, 3, height, width)
        Of the depth that a pixel is at: nearest distance, light and coverage.
    light, coverage : (3, height, width)
        Added to.
    """
    height, width = light.shape[1:]
    sums = (depths, light, coverage)
    for band in prange(-(-height // BAND_ROWS)):
        top = band * BAND_ROWS
        bottom = min(height, top + BAND_ROWS)
        for n in range(rows.size):
            y, x = rows[n], columns[n]
            for c in range(3):
                r = radius_px[n, c]
                left, right = max(0, x - r), min(width, x + r + 1)
                for to_y in range(max(top, y - r), min(bottom, y + r + 1)):
                    line = offset[n, c] + (to_y - y + r) * (2 * r + 1) + r - x
                    for to_x in range(left, right):
                        weight = kernels[line + to_x]
                        if weight == 0.0:
                            continue
                        if rule == 0:
                            at = (c, to_y, to_x)
                            source = (color[n, c], distance_dpt[n])
                            add_to_depth(at, weight, *source, step_dpt, sums)
                            continue
                        if rule == 1:
                            weight = weight * (1.0 - coverage[c, to_y, to_x])
                        light[c, to_y, to_x] += weight * color[n, c]
                        coverage[c, to_y, to_x] += weight
