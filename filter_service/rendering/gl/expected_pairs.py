"""The kernels that a frame will ask for, told from the frame before.

To ask the GPU which pairs of cell and layer interval a frame uses is to wait for it in
the middle of the frame.  A scene that stays uses, in another state of the eye, what its
pixels' places among the layers say; one that moves also what its neighbours used.  What
was told wrongly is seen when the frame is fetched, and the frame done again.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import USED_PARTS
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.image_cells import ImageCells

MARGIN_DPT = 1e-3
"""A pixel's place among the layers is a float of 32 bits on the GPU."""

MOVING_FRAMES = 8
"""After a frame that its neighbours would have told, so many count on them, too."""


class FrameState(NamedTuple):
    """What a frame's pairs are numbered by.

    Attributes
    ----------
    layers : FrameLayers
    image : ImageCells
    change_dpt : (rows + 1, columns + 1), float32
        Of defocus at the corners of the cells.
    """

    layers: FrameLayers
    image: ImageCells
    change_dpt: NDArray[np.float32]


def part_edges_dpt(layers: FrameLayers) -> NDArray[np.float64]:
    """Return where the parts of the intervals begin, and the last ends."""
    ends_dpt = layers.layer_dpt
    if ends_dpt.size == 1:
        return np.full(USED_PARTS + 1, ends_dpt[0])
    places = np.arange(USED_PARTS * (ends_dpt.size - 1) + 1) / USED_PARTS
    return np.interp(places, np.arange(ends_dpt.size), ends_dpt)


def _is_same(one: FrameState, other: FrameState) -> bool:
    return one.layers is other.layers and one.image is other.image


class ExpectedPairs:
    """Used pairs (n_cells, n_intervals) of an eye's next frame."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Know of no frame."""
        self._last: tuple[FrameState, NDArray[np.uint32]] | None = None
        self._told: tuple[FrameState, NDArray[np.bool_]] | None = None
        self._moving = 0

    def note(self, state: FrameState, words: NDArray[np.uint32]) -> None:
        """Take what a frame used, (n_cells, n_words) of parts of intervals."""
        from filter_service.rendering.pair_loops import used_pairs

        if self._told is not None and self._told[0] is state:
            told = self._told[1]
            used = used_pairs(words, told.shape[1])
            is_wrong = bool(np.any(used & ~told))
            self._moving = MOVING_FRAMES if is_wrong else max(self._moving - 1, 0)
        last = self._last
        if last is not None and _is_same(last[0], state):
            words = words | last[1]  # of another view of the eye, or a scene that moves
        self._last, self._told = (state, words), None

    def at(self, state: FrameState) -> NDArray[np.bool_] | None:
        """Return what a frame will use; None where nothing is known of its cells."""
        from filter_service.rendering.pair_loops import carry_over, spread

        if self._last is None or self._last[0].image is not state.image:
            return None
        before, words = self._last
        columns, rows = state.image.grid
        told = carry_over(
            words.reshape(rows, columns, -1),
            *(part_edges_dpt(before.layers), before.change_dpt),
            *(state.layers.layer_dpt, state.change_dpt, MARGIN_DPT),
        )
        flat = told.reshape(state.image.count, -1)
        self._told = state, flat
        return spread(told).reshape(flat.shape) if self._moving else flat
