"""How an eye's state reads its cache: the plain arrays that `read_loops.py` takes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class StoreTables(NamedTuple):
    """What plans of frames read of a store, as plain arrays that all have one layout.

    Attributes
    ----------
    values_dpt, keys_dpt : (n_nodes,)
    starts : (n_groups + 1,)
    lowest_dpt, span_dpt : float
        See `RaggedNodes`.
    channel_shift_dpt : (n_groups, 3)
    groups_per_field : int
    offsets : (n_psfs,)
    reach_words : (n_psfs,)
        Four reaches, a byte a side.
    radius_px, blur_px, spread_px, peak_ratio : (n_psfs,)
        See `PsfStore`.
    is_computed : (n_psfs,)
        Whether there is a kernel; without one all else but its blur is 0.
    last_used : (n_psfs,)
        Number of the frame that read it last.
    """

    values_dpt: NDArray[np.float64]
    keys_dpt: NDArray[np.float64]
    starts: NDArray[np.int64]
    lowest_dpt: float
    span_dpt: float
    channel_shift_dpt: NDArray[np.float64]
    groups_per_field: int
    offsets: NDArray[np.uint32]
    reach_words: NDArray[np.uint32]
    radius_px: NDArray[np.int32]
    blur_px: NDArray[np.float32]
    spread_px: NDArray[np.float32]
    peak_ratio: NDArray[np.float32]
    is_computed: NDArray[np.bool_]
    last_used: NDArray[np.uint32]


class StateReads(NamedTuple):
    """Cached neighbours in pupil and accommodation that a state reads.

    Attributes
    ----------
    groups : (n_corners,)
        Group of each neighbour, counted from the first of a field node.
    scales : (n_corners,)
        Neighbouring pupils are blended at equal geometric blur: the node of pupil A_i
        is read at total defocus t A / A_i, so no blended pair differs in size.
    weights : (n_corners,)
        Sum 1.
    """

    groups: NDArray[np.int64]
    scales: NDArray[np.float64]
    weights: NDArray[np.float64]
