"""Plain arrays from which the loops in C interpolate the kernels of a state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import RGB
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.planning.nodes import PlanNodes

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
        """Return tables extended to ``nodes``, which start with those of the tables.

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
        Group of each neighbor at the first field node; those of the other field nodes
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
