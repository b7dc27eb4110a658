"""A photograph with depth that is none of ours: the motorcycle of scikit-image.

Scharstein et al. 2014, Middlebury stereo; with its disparities and the camera's data.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

FOCAL_PX, BASELINE_M, OFFSET_PX = 994.978, 0.193001, 31.086
"""Of the pair as scikit-image holds it."""

FARTHEST_M = 20.0
"""Where no disparity is known."""


@cache
def motorcycle(
    width_px: int, height_px: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Color (h, w, 3) and depth (h, w), m, large enough for a frame of this size."""
    from skimage.data import stereo_motorcycle

    left, _, disparity_px = stereo_motorcycle()
    is_known = np.isfinite(disparity_px) & (disparity_px > 0.0)
    shifted_px = np.where(is_known, disparity_px, 0.0) + OFFSET_PX
    depth_m = np.where(is_known, FOCAL_PX * BASELINE_M / shifted_px, FARTHEST_M)
    scale = max(width_px / left.shape[1], height_px / left.shape[0])
    color = np.clip(zoom(left, (scale, scale, 1), order=1), 0, 255).astype(np.uint8)
    return color, zoom(depth_m, scale, order=0).astype(np.float32)
