"""Compiled loops of `frame_kernels.py`, which plan a frame's kernels.

They process a few thousand kernels, once per frame whose pupil, focus or gaze has
changed.
"""

import math

import numpy as np
from numba import njit

from filter_service.constants import FIELD_CORNERS, RGB, WEIGHT_MAX
from filter_service.psfs.read_loops import channel_taps
from filter_service.rendering.map_loops import MAX_REACH_PX, mapped_reach, moves


@njit(cache=True, nogil=True, error_model="numpy")
def number_used(place_of):
    """Replace marks by consecutive numbers, in place; return the marked positions."""
    count = 0
    for place in range(place_of.size):
        if place_of[place]:
            place_of[place] = count
            count += 1
        else:
            place_of[place] = -1
    places = np.empty(count, np.int64)
    for place in range(place_of.size):
        if place_of[place] >= 0:
            places[place_of[place]] = place
    return places


@njit(cache=True, nogil=True, error_model="numpy")
def used_nodes(used, nodes, weight_ratio, n_fields):
    """Return kernels' cells, intervals and parts, and nodes' fields and intervals.

    Cells and intervals are (n,), parts (n, 3).  A node of zero weight is replaced by
    the heaviest one.
    """
    n_intervals = used.shape[1]
    count = 0
    for is_used in used.flat:
        count += is_used
    cells, intervals = np.empty(count, np.int64), np.empty(count, np.int64)
    parts = np.empty((count, FIELD_CORNERS), np.int64)
    number = np.zeros(n_fields * n_intervals, np.int64)
    k = 0
    for cell in range(used.shape[0]):
        heaviest = nodes[cell, np.argmax(weight_ratio[cell])]
        for interval in range(n_intervals):
            if not used[cell, interval]:
                continue
            cells[k], intervals[k] = cell, interval
            for j in range(FIELD_CORNERS):
                node = nodes[cell, j] if weight_ratio[cell, j] > 0.0 else heaviest
                parts[k, j] = node * n_intervals + interval
                number[parts[k, j]] = 1
            k += 1
    pairs = number_used(number)
    for k in range(count):
        for j in range(FIELD_CORNERS):
            parts[k, j] = number[parts[k, j]]
    return cells, intervals, parts, pairs // n_intervals, pairs % n_intervals


@njit(cache=True, nogil=True, error_model="numpy")
def used_recipes(fields, intervals, n_fields, n_layers):
    """Return near and far recipes (n,) of nodes, and the recipes' fields and layers."""
    near, far = np.empty(fields.size, np.int64), np.empty(fields.size, np.int64)
    number = np.zeros(n_fields * n_layers, np.int64)
    for n in range(fields.size):
        near[n] = fields[n] * n_layers + min(intervals[n], n_layers - 1)
        far[n] = fields[n] * n_layers + min(intervals[n] + 1, n_layers - 1)
        number[near[n]] = number[far[n]] = 1
    places = number_used(number)
    for n in range(fields.size):
        near[n], far[n] = number[near[n]], number[far[n]]
    return near, far, places // n_layers, places % n_layers


@njit(cache=True, nogil=True, error_model="numpy")
def fill_recipes(
    tables, reads, fields, total_dpt, words, steps, sizes, missing, frame_number
):
    """Write recipes, and the sizes of the kernels that they make.

    Returns the number of missing PSFs; if it is not zero, the recipes are invalid until
    those PSFs are computed.

    Parameters
    ----------
    fields : (n,)
        Grouped by field.
    total_dpt : (n, 3)
        Ascending within a field.
    words : (n, 3, 3, RECIPE_TAPS), uint32
        See `NodeKernels.recipes`.
    steps : (n, 3, 3, RECIPE_TAPS), float32
        The same memory.
    sizes : reach_px (n, 4), radius_px (n,), peak_ratio (n,), spread_px (n,)
    missing : (n_psfs,)
        Output: indices of PSFs that have no kernel, each once.
    frame_number : int
        Number written to ``tables.last_used`` of each PSF that is read.
    """
    reach_px, radius_px, peak_ratio, spread_px = sizes
    n_missing = 0
    n_taps = 2 * reads.groups.size
    psfs, weights = np.empty(n_taps, np.int64), np.empty(n_taps)
    uppers = np.empty((RGB, reads.groups.size), np.int64)
    for n in range(fields.size):
        if n == 0 or fields[n] != fields[n - 1]:
            for corner in range(reads.groups.size):
                first = tables.starts[reads.groups[corner] + fields[n]]
                for channel in range(RGB):
                    uppers[channel, corner] = first
        left = right = up = down = widest_px = 0
        highest, narrowest_px = 0.0, np.inf
        for channel in range(RGB):
            total = total_dpt[n, channel]
            taken = uppers[channel], psfs, weights
            channel_taps(tables, reads, fields[n], channel, total, *taken)
            peak = spread = 0.0
            for tap in range(n_taps):
                psf, weight = psfs[tap], weights[tap]
                if weight > 0.0:
                    is_new = tables.last_used[psf] != frame_number
                    tables.last_used[psf] = frame_number
                    if not tables.is_computed[psf]:
                        if is_new:
                            missing[n_missing] = psf
                            n_missing += 1
                        continue
                word, per_peak = (
                    tables.reach_words[psf],
                    weight * tables.peak_ratio[psf],
                )
                peak += per_peak
                spread += weight * tables.spread_px[psf]
                words[n, channel, 0, tap] = tables.offsets[psf]
                words[n, channel, 1, tap] = word
                steps[n, channel, 2, tap] = per_peak / WEIGHT_MAX
                if weight > 0.0:
                    widest_px = max(widest_px, tables.radius_px[psf])
                    left, right = max(left, word & 255), max(right, (word >> 8) & 255)
                    up, down = max(up, (word >> 16) & 255), max(down, word >> 24)
            highest, narrowest_px = max(highest, peak), min(narrowest_px, spread)
        reach_px[n, 0], reach_px[n, 1] = left, right
        reach_px[n, 2], reach_px[n, 3] = up, down
        radius_px[n], peak_ratio[n], spread_px[n] = widest_px, highest, narrowest_px
    return n_missing


@njit(cache=True, nogil=True, error_model="numpy")
def fill_kernels(maps, weight_ratio, cells, parts, nodes, made):
    """Fill in the maps, weights and sizes of kernels.

    Parameters
    ----------
    maps : MapTables
    weight_ratio : (n_cells, 3)
    cells : (n,)
    parts : (n, 3)
    nodes : reach_px (m, 4), radius_px (m,), peak_ratio (m,), spread_px (m, 2)
        Sizes of the node kernels.
    made : weights, maps, reach_px, radius_px, peak_ratio, spread_px
        See `FrameKernels`.
    """
    node_reach_px, node_radius_px, node_peak, node_spread_px = nodes
    part_ratio, part_maps, reach_px, radius_px, peak_ratio, spread_px = made
    side_px = np.empty(4, np.int64)
    for k in range(cells.size):
        cell = cells[k]
        reach_px[k], radius_px[k] = 0, 0
        peak_ratio[k], spread_px[k] = 0.0, 0.0
        for j in range(FIELD_CORNERS):
            part, weight = parts[k, j], weight_ratio[cell, j]
            widest_px = node_radius_px[part]
            for side in range(4):
                side_px[side] = node_reach_px[part, side]
            area = box = 1.0
            is_moved = moves(maps.change_ratio[cell, j], widest_px)
            for row in range(2):
                for column in range(2):
                    own = maps.node_from_cell[cell, j, row, column]
                    part_maps[k, j, row, column] = own if is_moved else row == column
            if is_moved:
                area, box = maps.area_ratio[cell, j], maps.box_ratio[cell, j]
                mapped_reach(maps.cell_from_node, cell, j, side_px)
                wider_px = maps.stretch_ratio[cell, j] * (widest_px + 1.0)
                widest_px = int(min(math.ceil(wider_px), MAX_REACH_PX))
            part_ratio[k, j] = weight * box
            peak_ratio[k] += node_peak[part] * weight * area
            share = weight / math.sqrt(area)
            spread_px[k, 0] += node_spread_px[part, 0] * share
            spread_px[k, 1] += node_spread_px[part, 1] * share
            if weight > 0.0:
                radius_px[k] = max(radius_px[k], widest_px)
                for side in range(4):
                    reach_px[k, side] = max(reach_px[k, side], side_px[side])
