"""How a frame is planned, stated plainly: arrays of everything, numpy alone.

Twins of `psfs/pack.py`, of `rendering` (`frame_kernels.py`, `image_cells.py`), of
the passes that plan kernels, and of the layers' distances.
"""

import numpy as np

from filter_service.constants import (
    KERNEL_TAIL_PX,
    MAX_LEVEL,
    MAX_REACH_PX,
    MERGE_MIN_SPREAD_PX,
    MIN_SHIFT_FADE_PX,
    MIN_SHIFT_FADE_RATIO,
    MIN_SHIFT_PX,
    MIN_SHIFT_RATIO,
    NO_LEVEL,
    RECIPE_TAPS,
    RGB,
    WEIGHT_MAX,
)
from filter_service.planning.grid import BASE_OBJECT_STEP_DPT, GREEN
from filter_service.psfs.frame_layers import LAYER_SPACING
from filter_service.psfs.pack import box_sizes, pack_reach


def neighbors(store, reads, fields, total_dpt):
    """PSFs and weights (n, 3, 2 n_corners) of states (n, 3) at fields (n,)."""
    nodes = store.nodes
    channels = np.arange(RGB)
    psfs, weights = [], []
    for group, scale, weight in zip(*reads, strict=True):
        groups = fields + group
        lower, upper, share = nodes.defocus.bracket(
            groups[:, None], total_dpt * scale - nodes.channel_shift_dpt[groups]
        )
        psfs += [RGB * lower + channels, RGB * upper + channels]
        weights += [weight * (1.0 - share), weight * share]
    return np.stack(psfs, axis=-1), np.stack(weights, axis=-1)


def layer_blur_px(store, reads, zero_dpt, at_dpt):
    n_fields = len(zero_dpt)
    fields = np.tile(np.arange(n_fields), len(at_dpt))
    total_dpt = at_dpt[:, None, None] + zero_dpt
    psfs, weights = neighbors(store, reads, fields, total_dpt.reshape(-1, RGB))
    blur_px = (store.blur_px[psfs] * weights).sum(axis=-1)
    return blur_px.reshape(len(at_dpt), n_fields * RGB)


def layer_distances_dpt(
    object_range_dpt,
    *,
    ends_dpt,
    in_focus_dpt,
    blur_radius_px,
    blur_px_per_dpt,
    blur_ratio,
):
    """Walk from node to node; a layer wherever a step from the focus has gone by."""
    low_dpt, high_dpt = object_range_dpt
    inside = [d for d in (*ends_dpt, *in_focus_dpt) if low_dpt < d < high_dpt]
    regular = np.arange(low_dpt, high_dpt, BASE_OBJECT_STEP_DPT)
    nodes = sorted({*regular, *inside, high_dpt})
    blur_px = blur_radius_px(np.array(nodes))
    gone_by = [0.0]
    for k in range(len(nodes) - 1):
        steps = []
        for a, b in zip(blur_px[k], blur_px[k + 1], strict=True):
            least_px = min(a, b)
            gap_px = 2.0 * blur_ratio * least_px
            gap_dpt = max(gap_px / blur_px_per_dpt, BASE_OBJECT_STEP_DPT)
            steps.append(abs(a - b) / max(blur_ratio * least_px, 0.25))
            steps.append((nodes[k + 1] - nodes[k]) / gap_dpt)
        gone_by.append(gone_by[-1] + max(steps))
    steps = (gone_by - np.interp(in_focus_dpt[GREEN], nodes, gone_by)) / LAYER_SPACING
    layers = np.interp(np.arange(np.ceil(steps[0]), steps[-1]), steps, nodes)
    ends = [d for d in ends_dpt if low_dpt < d < high_dpt]
    return np.array(sorted({*layers, *ends, low_dpt, high_dpt}))


def map_tables(node_from_cell):
    """Inverse, area, box, stretch and change of maps (n, 3, 2, 2)."""
    inverse = np.linalg.inv(node_from_cell)
    area = np.abs(np.linalg.det(node_from_cell))
    diagonal = np.diagonal(node_from_cell, axis1=-2, axis2=-1)
    return (
        inverse,
        area,
        area / np.abs(diagonal.prod(axis=-1)),
        np.linalg.norm(inverse, ord=2, axis=(-2, -1)),
        np.linalg.norm(node_from_cell - np.eye(2), axis=(-2, -1)),
    )


def needed_maps(maps, spread_px):
    """Maps as far as kernels (...) of a spread need them."""
    change = map_tables(maps)[-1]
    shift_px = change * (spread_px + KERNEL_TAIL_PX)
    share = np.clip((change - MIN_SHIFT_RATIO) / MIN_SHIFT_FADE_RATIO, 0.0, 1.0)
    share *= np.clip((shift_px - MIN_SHIFT_PX) / MIN_SHIFT_FADE_PX, 0.0, 1.0)
    return np.eye(2) + share[..., None, None] * (maps - np.eye(2))


def mapped_sizes(inverse, stretch, is_moved, reach_px, radius_px):
    """Reaches (n, 3, 4) and radii (n, 3) of parts in the image's pixels."""
    row, corner = np.nonzero(is_moved)
    out = inverse[row, corner]
    left, right, up, down = (reach_px[row, corner] + 1.0).T
    sides = []
    for axis in range(2):
        a, b = out[:, axis, 0], out[:, axis, 1]
        low = np.minimum(-a * left, a * right) + np.minimum(-b * up, b * down)
        high = np.maximum(-a * left, a * right) + np.maximum(-b * up, b * down)
        sides += [-low, high]
    reach_px, radius_px = reach_px.copy(), radius_px.copy()
    mapped_px = np.ceil(np.stack(sides, axis=-1) - 1e-9) - 1
    reach_px[row, corner] = np.clip(mapped_px, 0, MAX_REACH_PX)
    wider_px = stretch[row, corner] * (radius_px[row, corner] + 1.0)
    radius_px[row, corner] = np.minimum(np.ceil(wider_px), MAX_REACH_PX)
    return reach_px, radius_px


def frame_kernels(store, layers, image, used):
    """Node kernels and kernels of used (cell, interval) pairs, as two dicts by name."""
    cells, intervals = np.nonzero(used)
    n_intervals = used.shape[1]
    wanted = image.nodes[cells] * n_intervals + intervals[:, None]
    weights = image.weight_ratio[cells]
    heaviest = np.take_along_axis(wanted, weights.argmax(axis=1)[:, None], axis=1)
    wanted = np.where(weights > 0.0, wanted, heaviest)
    pairs, parts = np.unique(wanted, return_inverse=True)
    parts = parts.reshape(wanted.shape)
    nodes = node_kernels(store, layers, *np.divmod(pairs, n_intervals))
    spread_px = nodes["recipe_spread_px"][np.stack([nodes["near"], nodes["far"]], -1)]
    ends = []
    for end in range(2):
        maps = needed_maps(image.maps.node_from_cell[cells], spread_px[parts, end])
        inverse, area, box, stretch, change = map_tables(maps)
        reach_px, radius_px = mapped_sizes(
            inverse,
            stretch,
            change > 0.0,
            nodes["reach_px"][parts],
            nodes["radius_px"][parts],
        )
        ends.append((maps, weights * box, area, reach_px, radius_px))
    maps, weight_ratio, area, reach_px, radius_px = (
        np.stack(values, axis=1) for values in zip(*ends, strict=True)
    )
    spreads_px = np.moveaxis(spread_px[parts], -1, 1) * weights[:, None]
    in_use = (weights > 0.0)[:, None]
    return nodes, {
        "cells": cells,
        "intervals": intervals,
        "parts": parts,
        "weight_ratio": weight_ratio,
        "maps": maps,
        "reach_px": np.where(in_use[..., None], reach_px, 0).max(axis=(1, 2)),
        "radius_px": np.where(in_use, radius_px, 0).max(axis=(1, 2)),
        "peak_ratio": (nodes["peak_ratio"][parts] * weights * area.max(axis=1)).sum(
            axis=1
        ),
        "spread_px": (spreads_px / np.sqrt(area)).sum(axis=-1),
    }


def node_kernels(store, layers, fields, intervals):
    n_layers = len(layers.layer_dpt)
    ends = np.minimum(np.stack([intervals, intervals + 1]), n_layers - 1)
    wanted, recipe_of = np.unique(fields * n_layers + ends, return_inverse=True)
    near, far = recipe_of.reshape(ends.shape)
    recipe_fields, recipe_layers = np.divmod(wanted, n_layers)
    psfs, weights = neighbors(
        store,
        layers.reads,
        recipe_fields,
        layers.layer_dpt[recipe_layers, None] + layers.layer_zero_dpt[recipe_fields],
    )
    taken = weights > 0.0
    own_px = np.where(taken[..., None], store.reach_px[psfs], 0).max(axis=(1, 2))
    own_radius_px = np.where(taken, store.radius_px[psfs], 0).max(axis=(1, 2))
    own_peak = (weights * store.peak_ratio[psfs]).sum(axis=2).max(axis=1)
    recipes = np.zeros((*psfs.shape[:2], 3, RECIPE_TAPS), dtype=np.uint32)
    taps = psfs.shape[-1]
    recipes[..., 0, :taps] = store.offsets[psfs]
    recipes[..., 1, :taps] = pack_reach(store.reach_px[psfs])
    per_step = weights * store.peak_ratio[psfs] / WEIGHT_MAX
    recipes[..., 2, :taps] = per_step.astype(np.float32).view(np.uint32)
    return {
        "near": near,
        "far": far,
        "reach_px": np.maximum(own_px[near], own_px[far]),
        "radius_px": np.maximum(own_radius_px[near], own_radius_px[far]),
        "peak_ratio": np.maximum(own_peak[near], own_peak[far]),
        "recipes": recipes.reshape(*psfs.shape[:2], 3 * RECIPE_TAPS),
        "recipe_spread_px": (weights * store.spread_px[psfs]).sum(axis=2).min(axis=1),
    }


def kernel_levels(reach_px, spread_px, peak_ratio):
    """Texels, first texels and scales (n, levels) of kernels and merged forms."""
    levels = np.arange(MAX_LEVEL + 1)
    widest_px = np.maximum(spread_px.max(axis=1), 1e-9)
    highest = np.floor(np.log2(widest_px / MERGE_MIN_SPREAD_PX)) + 1
    highest = np.clip(highest, 0, MAX_LEVEL)
    widths, heights = (size[:, None] + 2**levels - 1 for size in box_sizes(reach_px))
    sizes = np.where(levels <= highest[:, None], widths * heights, 0)
    starts = (np.cumsum(sizes) - sizes.ravel()).reshape(sizes.shape)
    scale = np.minimum(peak_ratio[:, None] * 4.0**levels, 1.0)
    scale[:, 0] = peak_ratio
    return sizes, np.where(sizes > 0, starts, NO_LEVEL), scale.astype(np.float32)
