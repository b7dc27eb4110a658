"""Plan of a frame's kernels: which kernels it needs, and the taps of each; CPU only.

A frame has one kernel for each (cell, interval) pair that its pixels use.  A kernel
contains the weights at both ends of its interval.  It is a weighted sum of the node
kernels of three field nodes, and each node kernel is a weighted sum of cached kernels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import RECIPE_WORDS, RGB
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.psfs.read_kernels import StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.rendering.image_cells import ImageCells

Fill = Callable[[NDArray[np.int64]], NDArray[np.int64]]
"""Compute PSFs (n,); return those (m,) that are still missing at a deadline."""


@dataclass(frozen=True)
class MissingPsfs:
    """PSFs (n,) that a frame needs and that were not computed before its deadline."""

    psfs: NDArray[np.int64]


@dataclass(frozen=True)
class NodeKernels:
    """Kernels of field nodes, blended over pupil, accommodation and defocus.

    Attributes
    ----------
    near, far : (n,)
        Recipes at the two ends of the interval.
    reach_px : (n, 4)
        Largest reach in the interval: left, right, up, down.
    radius_px : (n,)
    peak_ratio : (n,)
        Upper bound on the weights in the interval.
    recipes : (n_recipes, 3, 18), uint32
        Taps of a field node at a layer.  For each channel: six offsets of cached
        kernels, their six reaches (one byte per side), and six factors (bits of a
        float32) by which their 16-bit weights are multiplied.
    recipe_spread_px : (n_recipes,)
        Smallest spread of the three channels; it limits merging.
    """

    near: NDArray[np.int64]
    far: NDArray[np.int64]
    reach_px: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    recipes: NDArray[np.uint32]
    recipe_spread_px: NDArray[np.float64]


@dataclass(frozen=True)
class FrameKernels:
    """Kernels of a frame.

    Attributes
    ----------
    cells, intervals : (n,)
        The pair of each kernel.
    parts : (n, 3)
        Node kernels whose weighted sum is the kernel.
    weight_ratio : (n, 3)
        Weight of each part.  If its map rotates or shears, the weight is multiplied by
        the area of a mapped pixel over the area of a box with its sides.
    maps : (n, 3, 2, 2)
        Linear maps from offsets in pixels of the image to those of the part; the exact
        identity where the difference is negligible.
    reach_px : (n, 4)
        Left, right, up, down.
    radius_px : (n,)
    peak_ratio : (n,)
        Upper bound on the weights.
    spread_px : (n, 2)
        Spread at the two ends of the interval.
    """

    nodes: NodeKernels
    cells: NDArray[np.int64]
    intervals: NDArray[np.int64]
    parts: NDArray[np.int64]
    weight_ratio: NDArray[np.float64]
    maps: NDArray[np.float64]
    reach_px: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    spread_px: NDArray[np.float64]

    @property
    def count(self) -> int:
        """Number of kernels."""
        return self.cells.size


def interval_count(layers: FrameLayers) -> int:
    """Return the number of intervals; a single layer counts as one interval."""
    return max(len(layers.layer_dpt) - 1, 1)


def frame_kernels(
    store: PsfStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
    *,
    tables: StoreTables | None = None,
    fill: Fill | None = None,
) -> FrameKernels | MissingPsfs:
    """Plan the kernels of used (cell, interval) pairs, and compute missing PSFs.

    Parameters
    ----------
    store : PsfStore
    used : (n_cells, n_intervals)
    tables : StoreTables, optional
        Tables to use instead of the store's; their offsets are written to the recipes.
    fill : callable, optional
        Function that computes missing PSFs; `PsfStore.fill` by default.
    """
    n_fields, maps = len(layers.layer_zero_dpt), image.maps.tables
    cells, intervals, parts, *pairs = _list_nodes(used, image, n_fields)
    nodes = _node_kernels(
        store, tables or store.tables, fill or store.fill, layers, *pairs
    )
    if isinstance(nodes, MissingPsfs):
        return nodes
    inputs = {
        "cell_weight_ratio": np.ascontiguousarray(image.weight_ratio),
        "cells": cells,
        "parts": parts,
        "node_reach_px": nodes.reach_px,
        "node_radius_px": nodes.radius_px,
        "node_peak_ratio": nodes.peak_ratio,
        "near_spread_px": nodes.recipe_spread_px[nodes.near],
        "far_spread_px": nodes.recipe_spread_px[nodes.far],
    }
    found = {
        "weight_ratio": np.empty(parts.shape),
        "maps": np.empty((*parts.shape, 2, 2)),
        "reach_px": np.zeros((cells.size, 4), np.int64),
        "radius_px": np.zeros(cells.size, np.int64),
        "peak_ratio": np.zeros(cells.size),
        "spread_px": np.zeros((cells.size, 2)),
    }
    job = records.SizeJob(
        cell_maps=records.MapTables(**pointers(**maps._asdict())),
        count=cells.size,
        **pointers(**inputs, **found),
    )
    loops().call("fill_sizes", job)
    return FrameKernels(
        nodes=nodes, cells=cells, intervals=intervals, parts=parts, **found
    )


def missing_psfs(
    store: PsfStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Return the indices (n,) of needed PSFs that have not been computed yet."""
    *_, fields, intervals = _list_nodes(used, image, len(layers.layer_zero_dpt))
    found = _node_kernels(
        store, store.tables, lambda psfs: psfs, layers, fields, intervals
    )
    return found.psfs if isinstance(found, MissingPsfs) else np.zeros(0, np.int64)


def _list_nodes(
    used: NDArray[np.bool_], image: ImageCells, n_fields: int
) -> tuple[NDArray[np.int64], ...]:
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
    nodes, weight_ratio = image.nodes, image.weight_ratio
    heaviest = np.take_along_axis(nodes, weight_ratio.argmax(axis=1)[:, None], axis=1)
    nodes = np.where(weight_ratio > 0.0, nodes, heaviest)
    n_intervals = used.shape[1]
    cells, intervals = np.divmod(np.flatnonzero(used), n_intervals)
    pairs = nodes[cells] * n_intervals + intervals[:, None]
    found, parts = _numbered(pairs, n_fields * n_intervals)
    return cells, intervals, parts, *np.divmod(found, n_intervals)


def _numbered(
    values: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct values (m,), ascending, and each value's number among them.

    `numpy.unique` sorts; this takes a table of ``count`` possible values.
    """
    number = np.zeros(count, np.int64)
    number[values] = 1
    found = np.flatnonzero(number)
    number[found] = np.arange(found.size)
    return found, number[values]


def _node_kernels(
    store: PsfStore,
    tables: StoreTables,
    fill: Fill,
    layers: FrameLayers,
    fields: NDArray[Any],
    intervals: NDArray[Any],
) -> NodeKernels | MissingPsfs:
    """Plan node kernels (n,), with a recipe for each field node and layer in use."""
    n_layers = len(layers.layer_dpt)
    ends = np.minimum(np.stack([intervals, intervals + 1]), n_layers - 1)
    ends += fields * n_layers
    found, (near, far) = _numbered(ends, len(layers.layer_zero_dpt) * n_layers)
    recipe_fields, recipe_layers = np.divmod(found, n_layers)
    count = found.size
    recipes = np.zeros((count, RGB, RECIPE_WORDS), np.uint32)
    reach_px, radius_px = np.empty((count, 4), np.int64), np.empty(count, np.int64)
    peak_ratio, spread_px = np.empty(count), np.empty(count)
    missing = np.empty(store.psf_count, np.int64)
    total_dpt = layers.layer_dpt[recipe_layers, None]
    total_dpt = total_dpt + layers.layer_zero_dpt[recipe_fields]
    job = records.RecipeJob(
        tables=tables.record(),
        reads=layers.reads.record(),
        count=count,
        **pointers(
            fields=recipe_fields,
            total_dpt=total_dpt,
            words=recipes,
            reach_px=reach_px,
            radius_px=radius_px,
            peak_ratio=peak_ratio,
            spread_px=spread_px,
            missing=missing,
        ),
    )
    while True:
        store.frame_number += 1
        job.frame_number = store.frame_number
        n_missing = loops().call("fill_recipes", job)
        if not n_missing:
            break
        left = fill(missing[:n_missing].copy())
        if left.size:
            return MissingPsfs(left)
    return NodeKernels(
        near=near,
        far=far,
        reach_px=np.maximum(reach_px[near], reach_px[far]),
        radius_px=np.maximum(radius_px[near], radius_px[far]),
        peak_ratio=np.maximum(peak_ratio[near], peak_ratio[far]),
        recipes=recipes,
        recipe_spread_px=spread_px,
    )


def pair_index(kernels: FrameKernels, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Return the kernel index (n_cells, n_intervals) of each pair; 0 if unused."""
    index = np.zeros(shape, dtype=np.uint32)
    index[kernels.cells, kernels.intervals] = np.arange(kernels.count)
    return index
