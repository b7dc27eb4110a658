"""Compiled loops over the (cell, interval) pairs that a frame uses.

The GPU divides each interval into `USED_PARTS` parts, and sets one bit in the words of
a cell for each part that a pixel of the cell uses.
"""

import numpy as np
from numba import njit

from filter_service.constants import BITS_PER_WORD, USED_PARTS


@njit(cache=True, nogil=True, error_model="numpy")
def unpack_pairs(words, interval_count):
    """Unpack bits (n_cells, n_words) to a mask of used pairs (n_cells, n_intervals)."""
    used = np.zeros((words.shape[0], interval_count), np.bool_)
    for cell in range(words.shape[0]):
        for k in range(words.shape[1]):
            word = words[cell, k]
            bit = k * BITS_PER_WORD
            while word:
                if word & 1:
                    used[cell, bit // USED_PARTS] = True
                word >>= 1
                bit += 1
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def predict_pairs(
    words, edge_dpt, change_dpt, new_layer_dpt, new_change_dpt, margin_dpt
):
    """Return the mask (rows, columns, n_intervals) of a static scene in a new state.

    A pixel's position among the layers is its vergence plus the change of defocus over
    the field.  The latter lies between its values at the corners of the cell.

    Parameters
    ----------
    words : (rows, columns, n_words)
    edge_dpt : (n_parts + 1,)
        Bounds of the parts of all intervals in the old state.
    change_dpt, new_change_dpt : (rows + 1, columns + 1)
        Change of defocus at the corners of cells, in the old and in the new state.
    new_layer_dpt : (n_layers,)
    """
    rows, columns, word_count = words.shape
    last = max(new_layer_dpt.size - 1, 1) - 1
    found = np.zeros((rows, columns, last + 1), np.bool_)
    for row in range(rows):
        for column in range(columns):
            least, most = np.inf, -np.inf
            for r in range(row, row + 2):
                for c in range(column, column + 2):
                    moved = np.float64(new_change_dpt[r, c]) - change_dpt[r, c]
                    least, most = min(least, moved), max(most, moved)
            new = 0
            for k in range(word_count):
                word = words[row, column, k]
                part = k * BITS_PER_WORD
                while word:
                    if word & 1:
                        low = edge_dpt[part] + least - margin_dpt
                        high = edge_dpt[part + 1] + most + margin_dpt
                        while new > 0 and new_layer_dpt[new] > low:
                            new -= 1
                        while new < last and new_layer_dpt[new + 1] < low:
                            new += 1
                        found[row, column, new] = True
                        while new < last and new_layer_dpt[new + 1] <= high:
                            new += 1
                            found[row, column, new] = True
                    word >>= 1
                    part += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def dilate(used):
    """Dilate a mask (rows, columns, n_intervals) by one cell in all directions."""
    rows, columns, count = used.shape
    found = np.zeros(used.shape, np.bool_)
    for row in range(rows):
        for column in range(columns):
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    for interval in range(count):
                        found[row, column, interval] |= used[r, c, interval]
    return found
