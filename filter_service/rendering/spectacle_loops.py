"""Compiled loop of `spectacles.py`."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def draw_anew(color, depth_m, place, to_source, drawn, deep_m):
    """Resample an image by a linear map of tangents.

    Color is bilinear; depth is the nearest pixel's, because no surface lies between two
    others.

    Parameters
    ----------
    color, drawn : (h, w, 3), linear
    depth_m, deep_m : (h, w)
    place : (4,)
        Tangents of the left and the upper edge, and a pixel's step to the right and
        down.
    to_source : (2, 2)
        Map from output to source tangents.
    """
    height, width = depth_m.shape
    for y in range(height):
        v = place[1] + (y + 0.5) * place[3]
        for x in range(width):
            u = place[0] + (x + 0.5) * place[2]
            s = to_source[0, 0] * u + to_source[0, 1] * v
            t = to_source[1, 0] * u + to_source[1, 1] * v
            sx = min(max((s - place[0]) / place[2] - 0.5, 0.0), width - 1.0)
            sy = min(max((t - place[1]) / place[3] - 0.5, 0.0), height - 1.0)
            i, j = min(int(sy), max(height - 2, 0)), min(int(sx), max(width - 2, 0))
            below, right = min(i + 1, height - 1), min(j + 1, width - 1)
            p, q = sx - j, sy - i
            deep_m[y, x] = depth_m[
                min(int(sy + 0.5), height - 1), min(int(sx + 0.5), width - 1)
            ]
            for c in range(3):
                over = color[i, j, c] + p * (color[i, right, c] - color[i, j, c])
                under = color[below, j, c] + p * (
                    color[below, right, c] - color[below, j, c]
                )
                drawn[y, x, c] = np.float32(over + q * (under - over))
