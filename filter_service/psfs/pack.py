"""Packing of computed kernels: cropped to their boxes, 16 bits per weight.

Off axis, kernels are elongated and displaced from their center.  The box that contains
the light of such a kernel has a third of the area of the disc about the center.  The
engine in C packs its own kernels; this module packs those of other engines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compute import PsfBatch
from filter_service.constants import WEIGHT_MAX
from filter_service.psfs.boxes import CUT_STEPS, MAX_CENTROID_SHIFT_RATIO, SIDES


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


def pack_kernels(batch: PsfBatch, *, kept_energy_ratio: float) -> PackedKernels:
    """Crop and quantize a batch of kernels.

    Parameters
    ----------
    kept_energy_ratio : float
        Share of a kernel's light that its box must contain.
    """
    count = len(batch)
    reach_px = np.empty((count, SIDES), np.int64)
    radius_px = np.empty(count, np.int64)
    peak_ratio, spread_px, cut_ratio = np.empty((3, count))
    weights = []
    for p in range(count):
        kernel = batch[p].kernel.astype(np.float64)
        reach_px[p] = left, right, up, down = _reaches(kernel, 1.0 - kept_energy_ratio)
        full = len(kernel) // 2
        box = kernel[full - up : full + down + 1, full - left : full + right + 1]
        held, peak = box.sum(), box.max()
        steps = (box * (WEIGHT_MAX / peak) + 0.5).astype(np.uint16)
        row, column = np.nonzero(steps)
        farthest = np.max((row - up) ** 2 + (column - left) ** 2)
        weights.append(steps.ravel())
        radius_px[p] = math.ceil(math.sqrt(farthest) - 0.5)
        peak_ratio[p], spread_px[p] = peak / held, _spread_px(box)
        cut_ratio[p] = 1.0 - held / kernel.sum()
    sizes = np.array([own.size for own in weights])
    return PackedKernels(
        weights=np.concatenate(weights),
        offsets=np.cumsum(sizes) - sizes,
        reach_px=reach_px,
        radius_px=radius_px,
        peak_ratio=peak_ratio,
        spread_px=spread_px,
        lost_energy_ratio=batch.lost_energy_ratio + cut_ratio,
    )


def _spread_px(kernel: NDArray[np.float64]) -> float:
    """Return the radius of the uniform disc with the same sum of squares."""
    return float(kernel.sum() / math.sqrt(math.pi * np.square(kernel).sum()))


def _reaches(kernel: NDArray[np.float64], cut_ratio: float) -> tuple[int, ...]:
    """Return the reaches (4,) of a kernel (n, n).

    Each side of the box may remove a quarter of ``cut_ratio``.  The share is halved
    until the shift of the centroid is within `MAX_CENTROID_SHIFT_RATIO`.
    """
    lines = kernel.sum(axis=0), kernel.sum(axis=1)
    limit_px = MAX_CENTROID_SHIFT_RATIO * max(_spread_px(kernel), 1.0)
    side_ratio = cut_ratio / SIDES
    for step in range(CUT_STEPS + 1):
        allowed = side_ratio * lines[0].sum() if step < CUT_STEPS else 0.0
        ends = [_ends(line, allowed) for line in lines]
        if max(abs(shift_px) for *_, shift_px in ends) <= limit_px:
            break
        side_ratio /= 2.0
    return tuple(reach for *reaches, _ in ends for reach in reaches)


def _ends(line: NDArray[np.float64], allowed: float) -> tuple[int, int, float]:
    """Return the reaches before and after the center, and the shift of the centroid.

    Each end of the line removes at most the allowed light.
    """
    full = len(line) // 2
    places = np.arange(-full, full + 1)
    first, after = (
        int(np.searchsorted(np.cumsum(side), allowed, side="right"))
        for side in (line[:full], line[:full:-1])
    )
    kept = slice(first, line.size - after)
    shift_px = (line @ places) / max(line.sum(), 1e-12)
    kept_px = (line[kept] @ places[kept]) / max(line[kept].sum(), 1e-12)
    return full - first, full - after, float(kept_px - shift_px)
