"""Packed kernels as square arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
