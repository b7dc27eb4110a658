"""Kernels of a plan that were computed before, for stores of other parts of it."""

from collections import Counter
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from filter_service.psfs.boxes import box_sizes
from filter_service.psfs.build_store import ComputedKernels
from filter_service.psfs.pack import PackedKernels

NOWHERE = -1


class KernelShelf:
    """Computed kernels by the number of their node in a whole plan.

    Parameters
    ----------
    node_count : int
        Of the whole plan.
    channels : int
        Kernels of a node.
    """

    def __init__(self, node_count: int, channels: int) -> None:
        self._channels = channels
        self._place = np.full(node_count, NOWHERE)
        self._pieces: list[PackedKernels] = []
        self._starts = [0]
        self._blur_px: list[NDArray[np.float64]] = []
        self.methods: Counter[str] = Counter()

    @property
    def memory_mb(self) -> float:
        """Size of what it holds."""
        return sum(piece.weights.nbytes for piece in self._pieces) / 1e6

    def missing(self, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return those of some nodes (n,) whose kernels it lacks."""
        return nodes[self._place[nodes] == NOWHERE]

    def put(self, nodes: NDArray[np.int64], kernels: ComputedKernels) -> None:
        """Keep the kernels of nodes (n,), channel fastest."""
        self._place[nodes] = self._starts[-1] + self._channels * np.arange(nodes.size)
        for piece in kernels.packed:
            self._pieces.append(piece)
            self._starts.append(self._starts[-1] + piece.offsets.size)
        self._blur_px.append(kernels.blur_px)
        self.methods += kernels.methods

    def kernels(self, nodes: NDArray[np.int64]) -> ComputedKernels:
        """Return the kernels of nodes (n,), all of which it holds, in their order."""
        first = self._place[nodes]
        places = (first[:, None] + np.arange(self._channels)).ravel()
        columns = {
            field.name: np.concatenate([getattr(p, field.name) for p in self._pieces])
            for field in fields(PackedKernels)
            if field.name not in ("weights", "offsets")
        }
        of_piece = np.searchsorted(self._starts, places, side="right") - 1
        within = places - np.array(self._starts)[of_piece]
        widths, heights = box_sizes(columns["reach_px"][places])
        sizes = widths * heights
        offsets = np.cumsum(sizes) - sizes
        weights = np.empty(int(sizes.sum()), np.uint16)
        for k in range(len(self._pieces)):
            self._copy(k, of_piece == k, within, sizes, offsets, weights)
        packed = PackedKernels(
            weights=weights,
            offsets=offsets,
            **{name: column[places] for name, column in columns.items()},
        )
        return ComputedKernels(
            [packed], np.concatenate(self._blur_px)[places], self.methods
        )

    def _copy(self, k: int, own, within, sizes, offsets, weights) -> None:
        """Copy kernels of one piece; runs of neighbours at once."""
        chosen = np.flatnonzero(own)
        if chosen.size == 0:
            return
        piece = self._pieces[k]
        starts = piece.offsets[within[chosen]]
        ends = starts + sizes[chosen]
        to = offsets[chosen]
        # Neighbours here and there, as all kernels of a group are, are one copy.
        breaks = (starts[1:] != ends[:-1]) | (to[1:] != to[:-1] + sizes[chosen][:-1])
        runs = np.flatnonzero(np.concatenate([[True], breaks]))
        last = np.append(runs[1:], chosen.size) - 1
        for start, end, at in zip(
            starts[runs].tolist(), ends[last].tolist(), to[runs].tolist(), strict=True
        ):
            weights[at : at + end - start] = piece.weights[start:end]
