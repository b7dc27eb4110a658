"""Computed kernels to cached ones: rim trimmed, sixteen bits a weight.

Loops over single kernels, so compiled; threads share a batch.
"""

import math
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.psf import PsfBatch
from filter_service.constants import WEIGHT_MAX

MAX_CENTROID_SHIFT_PX = 0.005
"""Trimming stops where it would move a kernel's centroid farther than this."""

PSFS_PER_TASK = 64


@dataclass(frozen=True)
class PackedKernels:
    """P kernels, one behind the other.

    Attributes
    ----------
    weights : (n_texels,), uint16
        Rows downwards; in steps of the kernel's peak over WEIGHT_MAX.
    offsets, radius_px : (P,)
    peak_ratio : (P,)
        Largest weight.
    spread_px : (P,)
        Radius of the uniform disc that has the kernel's sum of squares.
    lost_energy_ratio : (P,)
        Light outside, before the kernel was brought to unit sum.
    """

    weights: NDArray[np.uint16]
    offsets: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    spread_px: NDArray[np.float64]
    lost_energy_ratio: NDArray[np.float64]


def pack_kernels(
    batch: PsfBatch, *, kept_energy_ratio: float, pool: Executor
) -> PackedKernels:
    """Trim and quantise a batch.

    Parameters
    ----------
    kept_energy_ratio : float
        Share of a kernel's light that its radius must hold.
    """
    count = len(batch)
    radius_px = np.empty(count, np.int64)
    trimmed_ratio = np.empty(count)
    tasks = [slice(k, k + PSFS_PER_TASK) for k in range(0, count, PSFS_PER_TASK)]

    def shared(work, *arrays) -> None:
        list(pool.map(lambda part: work(*(a[part] for a in arrays)), tasks))

    shared(
        lambda *parts: _trim_radii(batch.flat_kernels, kept_energy_ratio, *parts),
        *(batch.offset_count, batch.radius_px, radius_px, trimmed_ratio),
    )
    sizes = (2 * radius_px + 1) ** 2
    offsets = np.cumsum(sizes) - sizes
    weights = np.empty(int(sizes.sum()), np.uint16)
    peak_ratio, spread_px = np.empty(count), np.empty(count)
    shared(
        lambda *parts: _quantise(batch.flat_kernels, weights, *parts),
        *(batch.offset_count, batch.radius_px, offsets, radius_px),
        *(peak_ratio, spread_px),
    )
    return PackedKernels(
        weights=weights,
        offsets=offsets,
        radius_px=radius_px,
        peak_ratio=peak_ratio,
        spread_px=spread_px,
        lost_energy_ratio=batch.lost_energy_ratio + trimmed_ratio,
    )


@njit(nogil=True, cache=True)
def _trim_radii(kernels, kept_energy_ratio, starts, full_px, radius_px, trimmed_ratio):
    """Smallest radii from which on the rule holds: light within, centroid unmoved."""
    for p in range(starts.size):
        full, start = full_px[p], starts[p]
        light, moment_x, moment_y = np.zeros((3, full + 1))
        for dy in range(-full, full + 1):
            row = start + (dy + full) * (2 * full + 1) + full
            for dx in range(-full, full + 1):
                ring = math.ceil(math.hypot(dx, dy) - 0.5)
                if ring <= full:
                    value = kernels[row + dx]
                    light[ring] += value
                    moment_x[ring] += value * dx
                    moment_y[ring] += value * dy
        light, moment_x, moment_y = (
            np.cumsum(light),
            np.cumsum(moment_x),
            np.cumsum(moment_y),
        )
        center_x, center_y = moment_x[full] / light[full], moment_y[full] / light[full]
        radius = full
        while radius > 0:
            kept = max(light[radius - 1], 1e-12)
            shift = math.hypot(
                moment_x[radius - 1] / kept - center_x,
                moment_y[radius - 1] / kept - center_y,
            )
            if kept < kept_energy_ratio * light[full] or shift > MAX_CENTROID_SHIFT_PX:
                break
            radius -= 1
        radius_px[p] = radius
        trimmed_ratio[p] = 1.0 - light[radius] / light[full]


@njit(nogil=True, cache=True)
def _quantise(
    kernels, weights, starts, full_px, offsets, radius_px, peak_ratio, spread_px
):
    """Cut kernels to their discs, bring them to unit sum and to steps of their peak."""
    for p in range(starts.size):
        full, radius = full_px[p], radius_px[p]
        centre = starts[p] + full * (2 * full + 1) + full
        total, squares, peak = 0.0, 0.0, 0.0
        for dy in range(-radius, radius + 1):
            row = centre + dy * (2 * full + 1)
            for dx in range(-radius, radius + 1):
                if math.ceil(math.hypot(dx, dy) - 0.5) <= radius:
                    value = float(kernels[row + dx])
                    total += value
                    squares += value * value
                    peak = max(peak, value)
        to = offsets[p]
        for dy in range(-radius, radius + 1):
            row = centre + dy * (2 * full + 1)
            for dx in range(-radius, radius + 1):
                value = 0.0
                if math.ceil(math.hypot(dx, dy) - 0.5) <= radius:
                    value = float(kernels[row + dx])
                weights[to] = np.uint16(value * (WEIGHT_MAX / peak) + 0.5)
                to += 1
        peak_ratio[p] = peak / total
        spread_px[p] = total / math.sqrt(math.pi * squares)
