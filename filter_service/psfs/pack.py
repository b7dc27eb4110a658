"""Packing of computed kernels: cropped to their boxes, 16 bits per weight.

Off axis a kernel is elongated and displaced from its center: the box that holds its
light has a third of the area of the disc about the center.  The loops over single
kernels are compiled; threads share a batch.
"""

from __future__ import annotations

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.psf.compute import PsfBatch
from filter_service.constants import WEIGHT_MAX
from filter_service.psfs.boxes import SIDES, box_sizes

MAX_CENTROID_SHIFT_RATIO = 0.005
"""Largest shift of a kernel's centroid by cropping, relative to its spread, or to a
pixel for sharper kernels; `GridSpec.kept_energy_ratio` states the total cost."""

CUT_STEPS = 7
"""Number of halvings of the cropped light, until the centroid shift is small enough;
after them, nothing is cropped."""

PSFS_PER_TASK = 64


@dataclass(frozen=True)
class PackedKernels:
    """P concatenated kernels.

    Attributes
    ----------
    weights : (n_texels,), uint16
        Rows from top to bottom; in steps of the kernel's peak over WEIGHT_MAX.
    offsets : (P,)
    reach_px : (P, 4)
        Columns left and right of the center, and rows above and below it.
    radius_px : (P,)
        Radius R: all nonzero weights lie within dx² + dy² <= (R + 0.5)².
    peak_ratio : (P,)
        Largest weight.
    spread_px : (P,)
        Radius of the uniform disc that has the kernel's sum of squares.
    lost_energy_ratio : (P,)
        Light outside the box, before the kernel was normalized to unit sum.
    """

    weights: NDArray[np.uint16]
    offsets: NDArray[np.int64]
    reach_px: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    spread_px: NDArray[np.float64]
    lost_energy_ratio: NDArray[np.float64]

    def with_kernels(
        self, places: NDArray[np.int64], others: PackedKernels
    ) -> PackedKernels:
        """Return these kernels with those at ``places`` replaced by others."""
        arrays = {
            name: getattr(self, name).copy()
            for name in (
                *("offsets", "reach_px", "radius_px"),
                *("peak_ratio", "spread_px", "lost_energy_ratio"),
            )
        }
        for name, array in arrays.items():
            array[places] = getattr(others, name)
        arrays["offsets"][places] += self.weights.size
        return replace(
            self, weights=np.concatenate([self.weights, others.weights]), **arrays
        )


def pack_kernels(
    batch: PsfBatch, *, kept_energy_ratio: float, pool: Executor
) -> PackedKernels:
    """Crop and quantize a batch.

    Parameters
    ----------
    kept_energy_ratio : float
        Share of a kernel's light that its box must hold.
    """
    count = len(batch)
    reach_px = np.empty((count, SIDES), np.int64)
    cut_ratio = np.empty(count)
    tasks = [slice(k, k + PSFS_PER_TASK) for k in range(0, count, PSFS_PER_TASK)]

    def shared(work: Any, *arrays: Any) -> None:
        list(pool.map(lambda part: work(*(a[part] for a in arrays)), tasks))

    shared(
        lambda *parts: _cut(batch.flat_kernels, 1.0 - kept_energy_ratio, *parts),
        *(batch.offset_count, batch.radius_px, reach_px, cut_ratio),
    )
    widths, heights = box_sizes(reach_px)
    sizes = widths * heights
    offsets = np.cumsum(sizes) - sizes
    weights = np.empty(int(sizes.sum()), np.uint16)
    radius_px = np.empty(count, np.int64)
    peak_ratio, spread_px = np.empty(count), np.empty(count)
    shared(
        lambda *parts: _quantize(batch.flat_kernels, weights, *parts),
        *(batch.offset_count, batch.radius_px, offsets, reach_px),
        *(radius_px, peak_ratio, spread_px),
    )
    return PackedKernels(
        weights=weights,
        offsets=offsets,
        reach_px=reach_px,
        radius_px=radius_px,
        peak_ratio=peak_ratio,
        spread_px=spread_px,
        lost_energy_ratio=batch.lost_energy_ratio + cut_ratio,
    )


@njit(nogil=True, cache=True)
def _cut(kernels, cut_ratio, starts, full_px, reach_px, removed_ratio):
    """Write reaches beyond which each side has its share of the light to crop."""
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
    """Return reaches before and after the center, and the shift of the centroid."""
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
def _quantize(
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
    """Normalize the boxes to unit sum, and quantize them in steps of their peak."""
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
