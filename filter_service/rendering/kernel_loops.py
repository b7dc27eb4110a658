"""Compiled loops of `frame_kernels.py`, which plan a frame's kernels.

They process a few thousand kernels whenever pupil, focus or gaze changes.
"""

import math

import numpy as np
from numba import njit

from filter_service.constants import FIELD_CORNERS, MAX_REACH_PX, RGB, WEIGHT_MAX
from filter_service.psfs.read_loops import channel_taps
from filter_service.rendering.map_loops import mapped_reach, needs_map


@njit(cache=True, nogil=True, error_model="numpy")
def number_marked(marks):
    """Replace nonzero elements by consecutive numbers; return their positions.

    Zeros are replaced by -1.
    """
    count = 0
    for position in range(marks.size):
        if marks[position]:
            marks[position] = count
            count += 1
        else:
            marks[position] = -1
    positions = np.empty(count, np.int64)
    for position in range(marks.size):
        if marks[position] >= 0:
            positions[marks[position]] = position
    return positions


@njit(cache=True, nogil=True, error_model="numpy")
def list_nodes(used, nodes, weight_ratio, n_fields):
    """List the kernels of used pairs, and the node kernels that they consist of.

    A node with zero weight is replaced by the node with the largest weight.

    Returns
    -------
    cells, intervals : (n,)
        Pairs of the kernels.
    parts : (n, 3)
        Their node kernels.
    fields, node_intervals : (m,)
        Field node and interval of each node kernel.
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
    pairs = number_marked(number)
    for k in range(count):
        for j in range(FIELD_CORNERS):
            parts[k, j] = number[parts[k, j]]
    return cells, intervals, parts, pairs // n_intervals, pairs % n_intervals


@njit(cache=True, nogil=True, error_model="numpy")
def list_recipes(fields, intervals, n_fields, n_layers):
    """List the recipes of node kernels: one for each field node and layer.

    Returns
    -------
    near, far : (n,)
        Recipes of each node kernel.
    recipe_fields, recipe_layers : (m,)
        Field node and layer of each recipe.
    """
    near, far = np.empty(fields.size, np.int64), np.empty(fields.size, np.int64)
    number = np.zeros(n_fields * n_layers, np.int64)
    for n in range(fields.size):
        near[n] = fields[n] * n_layers + min(intervals[n], n_layers - 1)
        far[n] = fields[n] * n_layers + min(intervals[n] + 1, n_layers - 1)
        number[near[n]] = number[far[n]] = 1
    positions = number_marked(number)
    for n in range(fields.size):
        near[n], far[n] = number[near[n]], number[far[n]]
    return near, far, positions // n_layers, positions % n_layers


@njit(cache=True, nogil=True, error_model="numpy")
def fill_recipes(
    tables, reads, fields, total_dpt, words, steps, sizes, missing, frame_number
):
    """Write recipes, and the sizes of the resulting kernels.

    Returns the number of missing PSFs.  If it is not zero, the recipes are not valid.

    Parameters
    ----------
    fields : (n,)
        Field nodes; equal ones are adjacent.
    total_dpt : (n, 3)
        Ascending within a field node.
    words : (n, 3, 3, RECIPE_TAPS), uint32
        See `NodeKernels.recipes`.
    steps : (n, 3, 3, RECIPE_TAPS), float32
        The same memory.
    sizes : reach_px (n, 4), radius_px (n,), peak_ratio (n,), spread_px (n,)
    missing : (n_psfs,)
        Output: unique indices of the missing PSFs.
    frame_number : int
        Written to ``tables.last_used`` of each PSF that is read.
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
            outputs = uppers[channel], psfs, weights
            channel_taps(tables, reads, fields[n], channel, total, *outputs)
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
def fill_kernels(maps, weight_ratio, cells, parts, nodes, outputs):
    """Write the maps, weights and sizes of kernels.

    Parameters
    ----------
    maps : MapTables
    weight_ratio : (n_cells, 3)
    cells : (n,)
    parts : (n, 3)
    nodes : reach_px (m, 4), radius_px (m,), peak_ratio (m,), spread_px (m, 2)
        Sizes of the node kernels.
    outputs : weight_ratio, maps, reach_px, radius_px, peak_ratio, spread_px
        See `FrameKernels`.
    """
    node_reach_px, node_radius_px, node_peak, node_spread_px = nodes
    part_ratio, part_maps, reach_px, radius_px, peak_ratio, spread_px = outputs
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
            is_mapped = needs_map(maps.change_ratio[cell, j], widest_px)
            for row in range(2):
                for column in range(2):
                    own = maps.node_from_cell[cell, j, row, column]
                    part_maps[k, j, row, column] = own if is_mapped else row == column
            if is_mapped:
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
