"""Boxes that kernels are cropped to: sizes, packed reaches, unpacking of kernels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_REACH_PX = 255
"""Limit of a reach, as four reaches share a word."""

SIDES = 4


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


def square_kernel(
    weights: NDArray[np.uint16], offset: int, reach_px: NDArray[Any], radius_px: int
) -> NDArray[np.float64]:
    """Return a centered kernel (2 R + 1, 2 R + 1), in its quantization steps."""
    left, right, up, down = (int(r) for r in reach_px)
    width, height = left + right + 1, up + down + 1
    square = np.zeros((2 * radius_px + 1,) * 2)
    square[
        radius_px - up : radius_px + down + 1, radius_px - left : radius_px + right + 1
    ] = weights[offset : offset + width * height].reshape(height, width)
    return square
