"""Pairs of cell and interval that a frame uses, and those predicted for the next frame.

A *cell* is a part of the image with its own kernels (`ImageCells`).  An *interval* is
the range between two consecutive layers, the object distances that have kernels; the
kernel of a pixel is interpolated between those of both layers.  The *state* of an eye,
its pupil and focus, determines the layers.  An interval has `USED_PARTS` parts, and the
GPU marks the parts that a frame uses as bits in the words of a cell.
"""

import numpy as np
from numba import njit

from filter_service.constants import BITS_PER_WORD, USED_PARTS


@njit(cache=True, nogil=True, error_model="numpy")
def used_pairs(words, interval_count):
    """Return the pairs (n_cells, n_intervals) that words (n_cells, n_words) mark."""
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
def carry_over(words, edge_dpt, change_dpt, new_layer_dpt, new_change_dpt, margin_dpt):
    """Return the pairs (rows, columns, n_intervals) of the same scene in a new state.

    The position of a pixel among the layers is its vergence plus the change of defocus
    over the field, which is interpolated between the corners of its cell.

    Parameters
    ----------
    words : (rows, columns, n_words)
        Marks of the previous frame.
    edge_dpt : (n_parts + 1,)
        Edges of the parts of all intervals in the previous state.
    change_dpt, new_change_dpt : (rows + 1, columns + 1)
        Change of defocus at the corners of cells, in the previous and in the new state.
    new_layer_dpt : (n_layers,)
        Layers of the new state.
    margin_dpt : float
        Widening of each marked part on both sides, for rounding errors of the GPU.
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
def spread(used):
    """Return pairs (rows, columns, n_intervals) including those of adjacent cells."""
    rows, columns, count = used.shape
    found = np.zeros(used.shape, np.bool_)
    for row in range(rows):
        for column in range(columns):
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    for interval in range(count):
                        found[row, column, interval] |= used[r, c, interval]
    return found
