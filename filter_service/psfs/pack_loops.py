"""Compiled loops of `pack`, which crop and quantize single kernels."""

import math

import numpy as np
from numba import njit

from filter_service.constants import WEIGHT_MAX
from filter_service.psfs.boxes import (
    CUT_STEPS,
    MAX_CENTROID_SHIFT_RATIO,
    SIDES,
)


@njit(nogil=True, cache=True)
def crop(kernels, cut_ratio, starts, full_px, reach_px, removed_ratio):
    """Write the reaches and the removed light of kernels (P,).

    Each side of a box may remove a quarter of `cut_ratio`.  The share is halved until
    the shift of the centroid is within `MAX_CENTROID_SHIFT_RATIO`.
    """
    for p in range(starts.size):
        full, start = full_px[p], starts[p]
        width = 2 * full + 1
        kernel = kernels[start : start + width * width].reshape(width, width)
        by_column, by_row = np.zeros(width), np.zeros(width)
        squares = 0.0
        for y in range(width):
            for x in range(width):
                value = float(kernel[y, x])
                by_column[x] += value
                by_row[y] += value
                squares += value * value
        total = by_row.sum()
        spread = total / math.sqrt(math.pi * squares)
        limit = MAX_CENTROID_SHIFT_RATIO * max(spread, 1.0)
        side_ratio = cut_ratio / SIDES
        for step in range(CUT_STEPS + 1):
            if step == CUT_STEPS:
                side_ratio = 0.0
            left, right, shift_x = _ends(by_column, side_ratio * total, full)
            up, down, shift_y = _ends(by_row, side_ratio * total, full)
            if max(abs(shift_x), abs(shift_y)) <= limit:
                break
            side_ratio /= 2.0
        reach_px[p, 0], reach_px[p, 1] = left, right
        reach_px[p, 2], reach_px[p, 3] = up, down
        held = 0.0
        for y in range(full - up, full + down + 1):
            for x in range(full - left, full + right + 1):
                held += kernel[y, x]
        removed_ratio[p] = 1.0 - held / total


@njit(nogil=True, cache=True)
def _ends(light, allowed, full):
    """Return the reaches before and after the center, and the shift of the centroid.

    Each end removes at most the allowed light.
    """
    first, cut = 0, 0.0
    while first < full and cut + light[first] <= allowed:
        cut += light[first]
        first += 1
    last, cut = light.size - 1, 0.0
    while last > full and cut + light[last] <= allowed:
        cut += light[last]
        last -= 1
    total, moment, held, held_moment = 0.0, 0.0, 0.0, 0.0
    for i in range(light.size):
        total += light[i]
        moment += light[i] * (i - full)
        if first <= i <= last:
            held += light[i]
            held_moment += light[i] * (i - full)
    shift = held_moment / max(held, 1e-12) - moment / max(total, 1e-12)
    return full - first, last - full, shift


@njit(nogil=True, cache=True)
def quantize(
    kernels,
    weights,
    starts,
    full_px,
    offsets,
    reach_px,
    radius_px,
    peak_ratio,
    spread_px,
):
    """Write the weights of boxes (P,), in steps of their peak, and their statistics."""
    for p in range(starts.size):
        full = full_px[p]
        width = 2 * full + 1
        kernel = kernels[starts[p] : starts[p] + width * width].reshape(width, width)
        box = kernel[
            full - reach_px[p, 2] : full + reach_px[p, 3] + 1,
            full - reach_px[p, 0] : full + reach_px[p, 1] + 1,
        ]
        total, squares, peak = 0.0, 0.0, 0.0
        for value in box.flat:
            total += value
            squares += float(value) * float(value)
            peak = max(peak, float(value))
        to, farthest = offsets[p], 0
        for y in range(box.shape[0]):
            for x in range(box.shape[1]):
                weight = np.uint16(float(box[y, x]) * (WEIGHT_MAX / peak) + 0.5)
                weights[to] = weight
                to += 1
                if weight > 0:
                    dx, dy = x - reach_px[p, 0], y - reach_px[p, 2]
                    farthest = max(farthest, dx * dx + dy * dy)
        radius_px[p] = math.ceil(math.sqrt(farthest) - 0.5)
        peak_ratio[p] = peak / total
        spread_px[p] = total / math.sqrt(math.pi * squares)
