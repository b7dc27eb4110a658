"""Compiled loops of `kernel_tables.py`, which write the kernel records."""

import math

from numba import njit

from filter_service.constants import (
    FIELD_CORNERS,
    KERNEL_WORDS,
    MAX_LEVEL,
    MERGE_MIN_SPREAD_PX,
    NO_LEVEL,
    NODE_WORDS,
    PART_WORDS,
)
from filter_service.psfs.read_loops import clipped

MIN_SPREAD_PX = 1e-9
VECTOR = 4
"""Words of a uvec4."""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def box(reach_px, k):
    """Return the width and height of a kernel's box."""
    width = reach_px[k, 0] + reach_px[k, 1] + 1
    return width, reach_px[k, 2] + reach_px[k, 3] + 1


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def packed(reach_px, k):
    """Return the four reaches of a kernel as bytes of a word."""
    across = reach_px[k, 0] | reach_px[k, 1] << 8
    return across | reach_px[k, 2] << 16 | reach_px[k, 3] << 24


@njit(cache=True, nogil=True, error_model="numpy")
def fill_levels(reach_px, spread_px, peak_ratio, sizes, starts, scale):
    """Write texel counts, first texels and quantization steps (n, levels) of kernels.

    A kernel has no texels at levels whose squares are too large for its spread.
    Returns the total texel count.
    """
    start = 0
    for k in range(peak_ratio.size):
        widest_px = max(spread_px[k, 0], spread_px[k, 1], MIN_SPREAD_PX)
        steps = math.floor(math.log2(widest_px / MERGE_MIN_SPREAD_PX)) + 1
        highest = int(clipped(steps, 0, MAX_LEVEL))
        width, height = box(reach_px, k)
        for level in range(MAX_LEVEL + 1):
            scale[k, level] = min(peak_ratio[k] * 4.0**level, 1.0)
            starts[k, level], sizes[k, level] = NO_LEVEL, 0
            if level <= highest:
                beyond = 2**level - 1
                sizes[k, level] = (width + beyond) * (height + beyond)
                starts[k, level] = start
                start += sizes[k, level]
        scale[k, 0] = peak_ratio[k]
    return start


@njit(cache=True, nogil=True, error_model="numpy")
def count_groups(node_reach_px, sizes, threads, counts):
    """Count the work groups of nodes and of each level; return the nodes' texel count.

    ``counts`` has 1 + levels elements.
    """
    counts[:] = 0
    texels = 0
    for k in range(node_reach_px.shape[0]):
        width, height = box(node_reach_px, k)
        texels += width * height
        counts[0] += (width * height + threads - 1) // threads
    for k in range(sizes.shape[0]):
        for level in range(MAX_LEVEL + 1):
            counts[1 + level] += (sizes[k, level] + threads - 1) // threads
    return texels


@njit(cache=True, nogil=True, error_model="numpy")
def fill_nodes(words, floats, first, nodes, threads, work):
    """Write node records from word ``first`` and work groups from word ``work`` on."""
    near, far, reach_px, peak_ratio = nodes
    start = 0
    for k in range(near.size):
        at = first + k * NODE_WORDS * VECTOR
        words[at : at + NODE_WORDS * VECTOR] = 0
        words[at], words[at + 1], words[at + 2] = near[k], far[k], start
        words[at + 3] = packed(reach_px, k)
        floats[at + VECTOR] = peak_ratio[k]
        width, height = box(reach_px, k)
        start += width * height
        for texel in range(0, width * height, threads):
            words[work], words[work + 1] = k, texel
            work += 2


@njit(cache=True, nogil=True, error_model="numpy")
def fill_records(words, floats, firsts, kernels, levels, threads, works):
    """Write the records of kernels and parts, and the work groups of each level.

    Parameters
    ----------
    words, floats : (n,)
        The same memory.
    firsts : (2,)
        First words of the records and of the parts.
    kernels : spread_px, radius_px, reach_px, parts, weights, maps
    levels : sizes, starts, scale
    works : (levels,)
        First word of each level's work groups; on return, the word after the last.
    """
    spread_px, radius_px, reach_px, parts, weight_ratio, maps = kernels
    sizes, starts, scale = levels
    for k in range(radius_px.size):
        at = firsts[0] + k * KERNEL_WORDS * VECTOR
        floats[at], floats[at + 1] = spread_px[k, 0], spread_px[k, 1]
        words[at + 2], words[at + 3] = radius_px[k], packed(reach_px, k)
        for level in range(MAX_LEVEL + 1):
            words[at + VECTOR + level] = starts[k, level]
            floats[at + 2 * VECTOR + level] = scale[k, level]
            for texel in range(0, sizes[k, level], threads):
                words[works[level]], words[works[level] + 1] = k, texel
                works[level] += 2
        at = firsts[1] + k * PART_WORDS * VECTOR
        words[at + VECTOR - 1] = words[at + 2 * VECTOR - 1] = 0
        for j in range(FIELD_CORNERS):
            words[at + j] = parts[k, j]
            floats[at + VECTOR + j] = weight_ratio[k, j]
            to = at + (2 + j) * VECTOR
            floats[to], floats[to + 1] = maps[k, j, 0, 0], maps[k, j, 0, 1]
            floats[to + 2], floats[to + 3] = maps[k, j, 1, 0], maps[k, j, 1, 1]
