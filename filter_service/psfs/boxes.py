"""Boxes that kernels are cropped to: limits, sizes and packed reaches."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
