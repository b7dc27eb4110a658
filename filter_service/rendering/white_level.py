"""White level: reference of the contrast below which pixels merge."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

WHITE_STEP_PX = 8
"""Stride in pixels at which the white level is sampled."""

LIT_PERCENTILE, PERCENTILE, WHITE_RATIO = 90.0, 99.6, 2.0
"""The white level of a linear image is its maximum, but at most this ratio times the
90th percentile of its lit pixels and the 99.6th percentile of all, so that a small
light source does not set it, even alone in the dark."""


def white_level(color: NDArray[Any]) -> float:
    """Return the white level of an image; it is 1 for 8-bit images.

    The unit of linear light is arbitrary, so the merging threshold must scale with it.
    """
    if color.dtype == np.uint8:
        return 1.0
    light = np.abs(color[::WHITE_STEP_PX, ::WHITE_STEP_PX].astype(np.float64))
    light = light[np.isfinite(light)]
    lit = light[light > 0.0]
    if lit.size == 0:
        return 0.0
    limits = np.percentile(lit, LIT_PERCENTILE), np.percentile(light, PERCENTILE)
    return float(min(lit.max(), WHITE_RATIO * min(limits)))
