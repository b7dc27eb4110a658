"""Packing of computed kernels: cropped to their boxes, 16 bits per weight.

Off axis, kernels are elongated and displaced from their center.  The box that contains
the light of such a kernel has a third of the area of the disc about the center.
Threads share a batch and run compiled loops over its kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compute import PsfBatch
from filter_service.psfs.boxes import SIDES, box_sizes
from filter_service.psfs.pack_loops import crop, quantize

PSFS_PER_TASK = 64


@dataclass(frozen=True)
class PackedKernels:
    """Concatenated kernels (P,).

    Attributes
    ----------
    weights : (n_texels,), uint16
        Rows from top to bottom, in steps of the kernel's peak over `WEIGHT_MAX`.
    offsets : (P,)
    reach_px : (P, 4)
        Columns left and right of the center, and rows above and below it.
    radius_px : (P,)
        Radius R: all nonzero weights lie within dx² + dy² <= (R + 0.5)².
    peak_ratio : (P,)
        Largest weight.
    spread_px : (P,)
        Radius of the uniform disc with the same sum of squares as the kernel.
    lost_energy_ratio : (P,)
        Share of light outside the box, before normalization to unit sum.
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
        """Return the kernels with those at ``places`` replaced by others."""
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
    """Crop and quantize a batch of kernels.

    Parameters
    ----------
    kept_energy_ratio : float
        Share of a kernel's light that its box must contain.
    """
    count = len(batch)
    reach_px = np.empty((count, SIDES), np.int64)
    cut_ratio = np.empty(count)
    tasks = [slice(k, k + PSFS_PER_TASK) for k in range(0, count, PSFS_PER_TASK)]

    def shared(work: Callable[..., None], *arrays: NDArray[np.generic]) -> None:
        list(pool.map(lambda part: work(*(a[part] for a in arrays)), tasks))

    shared(
        lambda *parts: crop(batch.flat_kernels, 1.0 - kept_energy_ratio, *parts),
        *(batch.offset_count, batch.radius_px, reach_px, cut_ratio),
    )
    widths, heights = box_sizes(reach_px)
    sizes = widths * heights
    offsets = np.cumsum(sizes) - sizes
    weights = np.empty(int(sizes.sum()), np.uint16)
    radius_px = np.empty(count, np.int64)
    peak_ratio, spread_px = np.empty(count), np.empty(count)
    shared(
        lambda *parts: quantize(batch.flat_kernels, weights, *parts),
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
