"""White level: reference of the contrast below which pixels merge."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

WHITE_STEP_PX = 8
"""Stride in pixels at which the white level is sampled."""

WHITE_PERCENTILE, WHITE_RATIO = 90.0, 2.0
"""The white level of a linear image is its maximum, but at most this ratio times the
90th percentile of its lit pixels, so that a small light source does not set it."""


def white_level(color: NDArray[Any]) -> float:
    """Return the white level of an image; it is 1 for 8-bit images.

    The unit of linear light is arbitrary, so the merging threshold must scale with it.
    """
    if color.dtype == np.uint8:
        return 1.0
    light = np.abs(color[::WHITE_STEP_PX, ::WHITE_STEP_PX].astype(np.float64))
    lit = light[(light > 0.0) & np.isfinite(light)]
    if lit.size == 0:
        return 0.0
    return float(min(lit.max(), WHITE_RATIO * np.percentile(lit, WHITE_PERCENTILE)))
