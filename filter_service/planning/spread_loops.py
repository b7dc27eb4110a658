"""Compiled loops of `defocus_nodes`: distribute nodes over the ranges of groups."""

import math

import numpy as np
from numba import njit

from filter_service.planning.error_law import (
    BLUR_EXPONENT,
    DIFFRACTION_SHARE,
    DOUBLING,
    OWN_SHARE,
    SHARP_PX,
)

CHANGE = 1e-4
"""Relative change of the squared difference at which the iteration ends."""


@njit(cache=True, nogil=True, error_model="numpy")
def needed_intervals(
    covariance,
    unit_px,
    light_ratio,
    foci_dpt,
    index,
    lows,
    highs,
    shifts,
    error,
    needed,
):
    """Write the number of intervals (n, n_samples) needed up to each sample of ranges.

    Twin: `error_law.allowed_difference_px` at the middle of each step.

    Parameters
    ----------
    covariance, unit_px, light_ratio, foci_dpt
        Arrays of the groups, see `defocus_nodes._Rays`.
    index, lows, highs : (n,)
        Group and ends of each range.
    shifts : (n_shifts, n)
        Chromatic shifts, added to the defocus of nodes.
    error : float
        RMS error half-way between nodes.
    """
    n_steps = needed.shape[1] - 1
    for k in range(lows.size):
        own = covariance[index[k]]
        unit_px2 = DIFFRACTION_SHARE * unit_px[index[k]] ** 2 + SHARP_PX**2
        step_dpt = (highs[k] - lows[k]) / n_steps
        moved_px = math.sqrt(own[3, 0]) * step_dpt
        needed[k, 0] = 0.0
        last_px2 = 0.0
        for i in range(n_steps):
            least_px2 = math.inf
            for s in range(shifts.shape[0]):
                for focus in range(foci_dpt.size):
                    x = lows[k] + step_dpt * (i + 0.5) + shifts[s, k] - foci_dpt[focus]
                    xx = own[0, 0] + x * (own[0, 1] + x * own[0, 2])
                    yy = own[1, 0] + x * (own[1, 1] + x * own[1, 2])
                    xy = own[2, 0] + x * (own[2, 1] + x * own[2, 2])
                    scale = error / light_ratio[focus, index[k]] / DOUBLING
                    px2 = last_px2
                    for _ in range(24):
                        more = unit_px2 + OWN_SHARE * px2
                        square = (xx + more) * (yy + more) - xy * xy
                        blur_px2 = math.sqrt(max(square, more * more))
                        before = px2
                        px2 = scale * blur_px2**BLUR_EXPONENT
                        if abs(px2 - before) <= CHANGE * px2:
                            break
                    last_px2 = px2
                    least_px2 = min(least_px2, px2)
            needed[k, i + 1] = needed[k, i] + moved_px / math.sqrt(least_px2)


@njit(cache=True, nogil=True, error_model="numpy")
def spread_nodes(lows, highs, needed, exact):
    """Return the nodes of all ranges, concatenated, and the number in each range.

    Parameters
    ----------
    lows, highs : (n,)
    needed : (n, n_samples)
        Number of intervals needed up to each sample of a range.
    exact : float
        Ranges narrower than this get one node.
    """
    n_samples = needed.shape[1]
    counts = np.empty(lows.size, np.int64)
    for k in range(lows.size):
        if highs[k] - lows[k] < exact:
            counts[k] = 1
        elif not needed[k, -1] > 0.0:  # PSFs so wide that no difference is visible
            counts[k] = 2
        else:
            counts[k] = 1 + max(1, math.ceil(needed[k, -1] - 1e-9))
    nodes = np.empty(counts.sum())
    at = 0
    for k in range(lows.size):
        low, high, first = lows[k], highs[k], at
        nodes[at] = low
        at += 1
        step = 0
        for i in range(1, counts[k]):
            value = high
            if i < counts[k] - 1:
                wanted = needed[k, -1] * i / (counts[k] - 1)
                while step < n_samples - 2 and needed[k, step + 1] < wanted:
                    step += 1
                rise = needed[k, step + 1] - needed[k, step]
                share = (wanted - needed[k, step]) / rise if rise > 0.0 else 0.0
                value = low + (high - low) * (step + share) / (n_samples - 1)
            if value > nodes[at - 1]:  # merges ends that differ by a rounding error
                nodes[at] = value
                at += 1
        counts[k] = at - first
    return nodes[:at].copy(), counts
