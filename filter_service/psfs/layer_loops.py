"""Compiled loop that places the layers of a frame, once for each new state."""

import math

import numpy as np
from numba import njit

from filter_service.planning.grid import (
    BASE_OBJECT_STEP_DPT,
    LAYER_GAP_STEPS,
    MIN_BLUR_STEP_PX,
)
from filter_service.psfs.read_loops import layer_blur_px


@njit(cache=True, nogil=True, error_model="numpy")
def layer_distances_dpt(
    tables, reads, zero_dpt, range_dpt, ends_dpt, blur_px_per_dpt, blur_ratio, pace
):
    """Return the vergences (n_layers,) of a frame's layers over a range, ascending.

    Parameters
    ----------
    zero_dpt : (n_fields, 3)
        Total defocus of field nodes and channels at 0 dpt.
    ends_dpt : (n,)
        Vergences that always are layers: the ends of object ranges, and vergences at
        which some channel is in focus, so that the blur is monotonic between layers.
    blur_px_per_dpt : float
        Blur of a perfect eye.
    blur_ratio : float
        Blur step between layers, relative to the blur radius.
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
    blur_px = layer_blur_px(tables, reads, zero_dpt, at_dpt)
    steps_before = np.zeros(at_dpt.size)
    for k in range(at_dpt.size - 1):
        steps = _steps(blur_px[k], blur_px[k + 1], blur_ratio)
        smallest_px = min(blur_px[k].min(), blur_px[k + 1].min())
        gap_dpt = LAYER_GAP_STEPS * blur_ratio * smallest_px
        gap_dpt = max(gap_dpt / max(blur_px_per_dpt, 1e-12), BASE_OBJECT_STEP_DPT)
        steps = max(steps, (at_dpt[k + 1] - at_dpt[k]) / gap_dpt) / pace
        steps_before[k + 1] = steps_before[k] + steps
    ends = np.searchsorted(at_dpt, np.append(inside, high_dpt))
    return _between(at_dpt, steps_before, np.unique(ends))


@njit(cache=True, nogil=True, error_model="numpy")
def _steps(first_px, second_px, blur_ratio):
    """Return the largest number of blur steps of any node and channel."""
    most = 0.0
    for k in range(first_px.size):
        smaller_px = min(first_px[k], second_px[k])
        step_px = max(blur_ratio * smaller_px, MIN_BLUR_STEP_PX)
        most = max(most, abs(second_px[k] - first_px[k]) / step_px)
    return most


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
