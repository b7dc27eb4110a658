"""Compiled loops that place the layers of a frame, once for each new state.

How many layers a state needs between two vergences is found for the nodes of pupil and
accommodation, which many frames share, and interpolated between them.
"""

import math

import numpy as np
from numba import njit

from filter_service.planning.grid import (
    BASE_OBJECT_STEP_DPT,
    LAYER_GAP_STEPS,
    MIN_BLUR_STEP_PX,
)
from filter_service.psfs.read_loops import add_blur_row


@njit(cache=True, nogil=True, error_model="numpy")
def layer_distances_dpt(
    curves, starts, scales, weights, zero_dpt, range_dpt, ends_dpt, pace
):
    """Return the vergences (n_layers,) of a frame's layers over a range, ascending.

    Parameters
    ----------
    curves : (2, n)
        Step curves of the nodes around the state, one after the other; see
        `step_curve`.
    starts : (n_corners + 1,)
        First column of each curve, and the end.
    scales, weights : (n_corners,)
        Pupil relative to that of each node, and weight of the node.
    zero_dpt : float
        Total defocus of the eye at 0 dpt.
    ends_dpt : (n,)
        Vergences that always are layers: the ends of object ranges, and vergences at
        which some channel is in focus, so that the blur is monotonic between layers.
    pace : float
        Factor of all steps.

    References
    ----------
    Csoba & Kunkli 2023, Eq. 8: L = ceil(|R(k+1) - R(k)|) - 1 transitional layers, here
    with steps proportional to R, and none where R is constant.
    """
    low_dpt, high_dpt = range_dpt
    count = 1 + math.ceil((high_dpt - low_dpt) / BASE_OBJECT_STEP_DPT - 1e-9)
    inside = ends_dpt[(ends_dpt > low_dpt) & (ends_dpt < high_dpt)]
    regular = np.linspace(low_dpt, high_dpt, max(count, 1))
    at_dpt = np.unique(np.concatenate((regular, inside)))
    if at_dpt.size == 1:
        return at_dpt
    steps_before = np.zeros(at_dpt.size)
    for corner in range(scales.size):
        total_dpt = curves[0, starts[corner] : starts[corner + 1]]
        steps = curves[1, starts[corner] : starts[corner + 1]]
        k, last = 0, total_dpt.size - 2
        for i in range(at_dpt.size):
            t = (at_dpt[i] + zero_dpt) * scales[corner]
            while k < last and total_dpt[k + 1] < t:
                k += 1
            # A line through the first or last two points goes on beyond them.
            share = (t - total_dpt[k]) / (total_dpt[k + 1] - total_dpt[k])
            found = steps[k] + share * (steps[k + 1] - steps[k])
            steps_before[i] += found * weights[corner] / pace
    ends = np.searchsorted(at_dpt, np.append(inside, high_dpt))
    return _between(at_dpt, steps_before, np.unique(ends))


@njit(cache=True, nogil=True, error_model="numpy")
def step_curve(tables, reads, zero_dpt, at_dpt, blur_px_per_dpt, blur_ratio):
    """Return the number of layers (n,) that a state needs up to each vergence (n,).

    Parameters
    ----------
    zero_dpt : (n_fields, 3)
        Total defocus of field nodes and channels at 0 dpt.
    blur_px_per_dpt : float
        Blur of a perfect eye.
    blur_ratio : float
        Blur step between layers, relative to the blur radius.
    """
    most_steps, least_px = _blur_steps(tables, reads, zero_dpt, at_dpt, blur_ratio)
    steps_before = np.zeros(at_dpt.size)
    for k in range(at_dpt.size - 1):
        smallest_px = min(least_px[k], least_px[k + 1])
        gap_dpt = LAYER_GAP_STEPS * blur_ratio * smallest_px
        gap_dpt = max(gap_dpt / max(blur_px_per_dpt, 1e-12), BASE_OBJECT_STEP_DPT)
        steps = max(most_steps[k], (at_dpt[k + 1] - at_dpt[k]) / gap_dpt)
        steps_before[k + 1] = steps_before[k] + steps
    return steps_before


@njit(cache=True, nogil=True, error_model="numpy")
def _blur_steps(tables, reads, zero_dpt, at_dpt, blur_ratio):
    """Return the extremes over all nodes and channels.

    Returns
    -------
    most_steps : (n - 1,)
        Largest number of blur steps between neighboring vergences.
    least_px : (n,)
        Smallest blur at each.
    """
    n = at_dpt.size
    most_steps, least_px = np.zeros(n - 1), np.full(n, np.inf)
    row_px = np.empty(n)
    for field in range(zero_dpt.shape[0]):
        for channel in range(zero_dpt.shape[1]):
            row_px[:] = 0.0
            zero = zero_dpt[field, channel]
            add_blur_row(tables, reads, field, channel, zero, at_dpt, row_px)
            for k in range(n - 1):
                first_px, second_px = row_px[k], row_px[k + 1]
                step_px = max(blur_ratio * min(first_px, second_px), MIN_BLUR_STEP_PX)
                steps = abs(second_px - first_px) / step_px
                most_steps[k] = max(most_steps[k], steps)
            for k in range(n):
                least_px[k] = min(least_px[k], row_px[k])
    return most_steps, least_px


@njit(cache=True, nogil=True, error_model="numpy")
def _between(at_dpt, steps_before, ends):
    """Return vergences that include each end and are at most one step apart."""
    found_dpt, first = [at_dpt[0]], 0
    for end in ends:
        low, high = steps_before[first], steps_before[end]
        count = max(math.ceil(high - low - 1e-9), 1)
        for k in range(1, count):
            wanted = low + (high - low) / count * k
            while steps_before[first + 1] < wanted:
                first += 1
            share = wanted - steps_before[first]
            share /= steps_before[first + 1] - steps_before[first]
            found_dpt.append(
                at_dpt[first] + share * (at_dpt[first + 1] - at_dpt[first])
            )
        found_dpt.append(at_dpt[end])
        first = end
    return np.array(found_dpt)
