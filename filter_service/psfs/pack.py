"""Packed kernels, cropped to their boxes with 16 bits per weight, and tables of stores.

Off axis, kernels are elongated and displaced from their center.  The box that contains
the light of such a kernel has a third of the area of the disc about the center.  The
engine in C packs its own kernels; this module packs kernels of other engines.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compute import PsfBatch
from filter_service.constants import RGB, WEIGHT_MAX
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.planning.nodes import PlanNodes

SIDES = 4

MAX_CENTROID_SHIFT_RATIO = 0.005
"""Largest shift of a kernel's centroid by cropping, relative to its spread or at least
to a pixel.  `GridSpec.kept_energy_ratio` documents the total error of cropping."""

CUT_STEPS = 7
"""Number of times that the light to crop is halved until the shift of the centroid is
small enough.  If it never is, nothing is cropped."""


def box_sizes(reach_px: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return widths and heights (...) of kernels with reaches (..., 4)."""
    left, right, up, down = np.moveaxis(np.asarray(reach_px), -1, 0)
    return left + right + 1, up + down + 1


def pack_reach(reach_px: NDArray[Any]) -> NDArray[np.uint32]:
    """Pack four reaches (..., 4) into the bytes of a word, left in the lowest."""
    return (np.asarray(reach_px, np.uint32) << np.array([0, 8, 16, 24], np.uint32)).sum(
        axis=-1, dtype=np.uint32
    )


def unpack_reach(words: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Unpack four reaches (..., 4) from words (...)."""
    little = np.ascontiguousarray(words, "<u4")
    return little[..., None].view(np.uint8)


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

    def select(self, indices: NDArray[np.int64]) -> PackedKernels:
        """Return the kernels at indices (m,)."""
        widths, heights = box_sizes(self.reach_px[indices])
        starts, sizes = self.offsets[indices], widths * heights
        own = [
            self.weights[start : start + size]
            for start, size in zip(starts.tolist(), sizes.tolist(), strict=True)
        ]
        arrays = {
            name: getattr(self, name)[indices]
            for name in (
                *("reach_px", "radius_px"),
                *("peak_ratio", "spread_px", "lost_energy_ratio"),
            )
        }
        return PackedKernels(
            weights=np.concatenate([self.weights[:0], *own]),
            offsets=np.cumsum(sizes) - sizes,
            **arrays,
        )

    def with_kernels(
        self, indices: NDArray[np.int64], others: PackedKernels
    ) -> PackedKernels:
        """Return the kernels with those at indices (m,) replaced by others."""
        arrays = {
            name: getattr(self, name).copy()
            for name in (
                *("offsets", "reach_px", "radius_px"),
                *("peak_ratio", "spread_px", "lost_energy_ratio"),
            )
        }
        for name, array in arrays.items():
            array[indices] = getattr(others, name)
        arrays["offsets"][indices] += self.weights.size
        return replace(
            self, weights=np.concatenate([self.weights, others.weights]), **arrays
        )


class ComputedPsfs(NamedTuple):
    """Kernels that are computed but not in a store yet.

    Attributes
    ----------
    psfs : (n,)
        PSF indices.
    packed : PackedKernels
        Kernels (n,).
    methods : Counter
        Number of PSFs by method.
    """

    psfs: NDArray[np.int64]
    packed: PackedKernels
    methods: Counter[str]


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
    offsets_px = np.arange(-full, full + 1)
    first, after = (
        int(np.searchsorted(np.cumsum(side), allowed, side="right"))
        for side in (line[:full], line[:full:-1])
    )
    kept = slice(first, line.size - after)
    shift_px = (line @ offsets_px) / max(line.sum(), 1e-12)
    kept_px = (line[kept] @ offsets_px[kept]) / max(line[kept].sum(), 1e-12)
    return full - first, full - after, float(kept_px - shift_px)


PSF_TABLES = (
    *("offsets", "reach_words", "radius_px", "spread_px", "peak_ratio"),
    *("is_computed", "last_used"),
)
"""Fields of `StoreTables` that are filled when PSFs are computed."""


class StoreTables(NamedTuple):
    """Data of a store from which frames are planned, as arrays of fixed layout.

    Attributes
    ----------
    values_dpt : (n_nodes,)
    starts : (n_groups + 1,)
        See `RaggedNodes`.
    channel_shift_dpt : (n_groups, 3)
    offsets : (n_psfs,)
    reach_words : (n_psfs,)
        Four reaches, one byte each.
    radius_px, blur_px, spread_px, peak_ratio : (n_psfs,)
        See `PsfStore`.
    is_computed : (n_psfs,)
        Whether there is a kernel; without one, all other fields but the blur are 0.
    last_used : (n_psfs,)
        Number of the last frame that read the kernel.
    """

    values_dpt: NDArray[np.float64]
    starts: NDArray[np.int64]
    channel_shift_dpt: NDArray[np.float64]
    offsets: NDArray[np.uint32]
    reach_words: NDArray[np.uint32]
    radius_px: NDArray[np.int32]
    blur_px: NDArray[np.float32]
    spread_px: NDArray[np.float32]
    peak_ratio: NDArray[np.float32]
    is_computed: NDArray[np.bool_]
    last_used: NDArray[np.uint32]

    @classmethod
    def empty(cls) -> StoreTables:
        """Return tables without nodes."""
        none = np.zeros(0)
        return cls(
            values_dpt=none,
            starts=np.zeros(1, np.int64),
            channel_shift_dpt=np.zeros((0, RGB)),
            offsets=none.astype(np.uint32),
            reach_words=none.astype(np.uint32),
            radius_px=none.astype(np.int32),
            blur_px=none.astype(np.float32),
            spread_px=none.astype(np.float32),
            peak_ratio=none.astype(np.float32),
            is_computed=none.astype(np.bool_),
            last_used=none.astype(np.uint32),
        )

    def record(self) -> records.StoreTables:
        """Return the C record, which is valid as long as the tables."""
        return records.StoreTables(**pointers(**self._asdict()))

    def grown(self, nodes: PlanNodes) -> StoreTables:
        """Return tables extended to ``nodes``, which start with the tables' own nodes.

        The PSFs of the new nodes are not computed.
        """
        more = len(nodes.blur_px) - self.offsets.size
        return StoreTables(
            values_dpt=np.array(nodes.defocus.values_dpt, np.float64),
            starts=np.array(nodes.defocus.starts, np.int64),
            channel_shift_dpt=np.array(nodes.channel_shift_dpt, np.float64, order="C"),
            blur_px=np.array(nodes.blur_px, np.float32),
            **{
                name: np.append(known, np.zeros(more, known.dtype))
                for name, known in self._asdict().items()
                if name in PSF_TABLES
            },
        )


class StateReads(NamedTuple):
    """Neighboring nodes of pupil and accommodation that a state reads.

    Attributes
    ----------
    groups : (n_corners,)
        Group of each neighbor at the first field node; groups at the other field nodes
        follow.
    scales : (n_corners,)
        Factors A / A_i of total defocus t.  Neighboring pupils are blended at equal
        geometric blur: the node of pupil A_i is read at total defocus t A / A_i, so
        blended kernels have the same size.
    weights : (n_corners,)
        Weights with sum 1.
    """

    groups: NDArray[np.int64]
    scales: NDArray[np.float64]
    weights: NDArray[np.float64]

    def record(self) -> records.StateReads:
        """Return the C record, which is valid as long as the arrays."""
        return records.StateReads(**pointers(**self._asdict()), count=self.groups.size)


def layer_blur_px(
    tables: StoreTables,
    reads: StateReads,
    zero_dpt: NDArray[np.float64],
    at_dpt: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the geometric blur radii (n_fields * 3, n), px, of n ascending layers.

    Parameters
    ----------
    zero_dpt : (n_fields, 3)
        Total defocus of field nodes and channels at 0 dpt.
    """
    blur_px = np.empty((zero_dpt.size, at_dpt.size))
    loops().call(
        "layer_blur",
        *(tables.record(), reads.record(), np.ascontiguousarray(zero_dpt), at_dpt),
        *(blur_px, len(zero_dpt), at_dpt.size),
    )
    return blur_px
