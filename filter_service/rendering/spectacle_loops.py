"""Compiled loop of `spectacles.py`."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def resample(color, depth_m, frame, to_source, resampled, resampled_m):
    """Resample an image by a linear map of tangents.

    Color is interpolated bilinearly.  Depth is that of the nearest pixel, because an
    average of two depths is the depth of neither surface.

    Parameters
    ----------
    color, resampled : (h, w, 3), linear
    depth_m, resampled_m : (h, w)
    frame : (4,)
        Tangents of the left and the upper edge, and their change per pixel to the
        right and downward.
    to_source : (2, 2)
        Map from output to source tangents.
    """
    height, width = depth_m.shape
    for y in range(height):
        v = frame[1] + (y + 0.5) * frame[3]
        for x in range(width):
            u = frame[0] + (x + 0.5) * frame[2]
            s = to_source[0, 0] * u + to_source[0, 1] * v
            t = to_source[1, 0] * u + to_source[1, 1] * v
            sx = min(max((s - frame[0]) / frame[2] - 0.5, 0.0), width - 1.0)
            sy = min(max((t - frame[1]) / frame[3] - 0.5, 0.0), height - 1.0)
            i, j = min(int(sy), max(height - 2, 0)), min(int(sx), max(width - 2, 0))
            below, right = min(i + 1, height - 1), min(j + 1, width - 1)
            p, q = sx - j, sy - i
            resampled_m[y, x] = depth_m[
                min(int(sy + 0.5), height - 1), min(int(sx + 0.5), width - 1)
            ]
            for c in range(3):
                over = color[i, j, c] + p * (color[i, right, c] - color[i, j, c])
                under = color[below, j, c] + p * (
                    color[below, right, c] - color[below, j, c]
                )
                resampled[y, x, c] = np.float32(over + q * (under - over))
