"""Prediction of the pairs that a frame uses from the previous frame.

If the CPU read back which (cell, interval) pairs a frame uses, it would wait for the
GPU in the middle of the frame.  The pairs of a static scene in another state of the eye
follow from the positions of its pixels among the layers.  If the scene moves, the pairs
of neighboring cells are added.  A wrong prediction is detected when the result is read
back; the frame is then filtered again.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import USED_PARTS
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.image_cells import ImageCells

MARGIN_DPT = 1e-3
"""Margin for the rounding of a pixel's layer position to float32 on the GPU."""

MOVING_FRAMES = 8
"""Number of frames after a wrong prediction that include neighboring cells."""


class FrameState(NamedTuple):
    """Layers and cells that the pairs of a frame refer to.

    Attributes
    ----------
    layers : FrameLayers
    image : ImageCells
    change_dpt : (rows + 1, columns + 1), float32
        Change of defocus at the corners of the cells.
    """

    layers: FrameLayers
    image: ImageCells
    change_dpt: NDArray[np.float32]


def part_edges_dpt(layers: FrameLayers) -> NDArray[np.float64]:
    """Return the bounds of the parts of all intervals, ascending."""
    ends_dpt = layers.layer_dpt
    if ends_dpt.size == 1:
        return np.full(USED_PARTS + 1, ends_dpt[0])
    places = np.arange(USED_PARTS * (ends_dpt.size - 1) + 1) / USED_PARTS
    return np.interp(places, np.arange(ends_dpt.size), ends_dpt)


def _is_same(one: FrameState, other: FrameState) -> bool:
    return one.layers is other.layers and one.image is other.image


class ExpectedPairs:
    """Predictor of the pairs (n_cells, n_intervals) that an eye's next frame uses."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard the previous frame."""
        self._last: tuple[FrameState, NDArray[np.uint32]] | None = None
        self._predicted: tuple[FrameState, NDArray[np.bool_]] | None = None
        self._moving = 0

    def record(self, state: FrameState, words: NDArray[np.uint32]) -> None:
        """Record the bits (n_cells, n_words) of the parts that a frame used."""
        from filter_service.rendering.pair_loops import unpack_pairs

        if self._predicted is not None and self._predicted[0] is state:
            predicted = self._predicted[1]
            used = unpack_pairs(words, predicted.shape[1])
            is_wrong = bool(np.any(used & ~predicted))
            self._moving = MOVING_FRAMES if is_wrong else max(self._moving - 1, 0)
        last = self._last
        if last is not None and _is_same(last[0], state):
            words = words | last[1]  # of another view, or of a moving scene
        self._last, self._predicted = (state, words), None

    def predict(self, state: FrameState) -> NDArray[np.bool_] | None:
        """Return the predicted pairs of a frame, or None if the cells have changed."""
        from filter_service.rendering.pair_loops import dilate, predict_pairs

        if self._last is None or self._last[0].image is not state.image:
            return None
        before, words = self._last
        columns, rows = state.image.grid
        predicted = predict_pairs(
            words.reshape(rows, columns, -1),
            *(part_edges_dpt(before.layers), before.change_dpt),
            *(state.layers.layer_dpt, state.change_dpt, MARGIN_DPT),
        )
        flat = predicted.reshape(state.image.count, -1)
        self._predicted = state, flat
        return dilate(predicted).reshape(flat.shape) if self._moving else flat
