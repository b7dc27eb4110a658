"""Compiled loops of `haze.py`: downsampling to a grid of angles, and upsampling.

Each loop processes a range of rows, so that `haze` can run it in its own threads:
numba's threads may crash a process in which two threads start them at the same time.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def mean_light(start, end, image, rows, row_shares, columns, column_shares, coarse):
    """Write the mean of the pixels of each coarse cell (n, m, 3).

    Parameters
    ----------
    rows, columns : (n,), (m,)
        First pixel of each cell.
    row_shares, column_shares : (n, k), (m, l)
        Fraction of a cell that this pixel and the following ones cover; the sum is 1.
    """
    for i in range(start, end):
        for j in range(coarse.shape[1]):
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(row_shares.shape[1]):
                if row_shares[i, k] == 0.0:
                    continue
                y = rows[i] + k
                for n in range(column_shares.shape[1]):
                    share = row_shares[i, k] * column_shares[j, n]
                    if share == 0.0:
                        continue
                    x = columns[j] + n
                    red += share * image[y, x, 0]
                    green += share * image[y, x, 1]
                    blue += share * image[y, x, 2]
            coarse[i, j, 0] = red
            coarse[i, j, 1] = green
            coarse[i, j, 2] = blue


@njit(cache=True, nogil=True, error_model="numpy")
def add_scattered(
    start, end, image, coarse, row_at, column_at, unscattered_ratio, gains
):
    """Attenuate an image (h, w, 3) and add the scattered light, in place.

    Parameters
    ----------
    coarse : (n, m, 3)
        Scattered light.
    row_at, column_at : (h,), (w,)
        Pixel centers in units of cells; cell centers are at integers.
    unscattered_ratio : float
        Fraction of the light that is not scattered.
    gains : (3,)
        Transmittance of the media in each channel.
    """
    last_row, last_column = coarse.shape[0] - 1, coarse.shape[1] - 1
    for y in range(start, end):
        i = min(int(row_at[y]), max(last_row - 1, 0))
        below = min(i + 1, last_row)
        v = row_at[y] - i
        for x in range(image.shape[1]):
            j = min(int(column_at[x]), max(last_column - 1, 0))
            right = min(j + 1, last_column)
            u = column_at[x] - j
            for c in range(3):
                over = coarse[i, j, c] + u * (coarse[i, right, c] - coarse[i, j, c])
                under = coarse[below, j, c] + u * (
                    coarse[below, right, c] - coarse[below, j, c]
                )
                light = unscattered_ratio * image[y, x, c] + over + v * (under - over)
                image[y, x, c] = np.float32(gains[c] * light)
