"""Plan of a frame's kernels: which kernels it needs, and the taps of each; CPU only.

A frame has one kernel for each (cell, interval) pair that its pixels use.  A kernel
contains the weights at both ends of its interval.  It is a weighted sum of the node
kernels of three field nodes, and each node kernel is a weighted sum of cached kernels.
The compiled loops are imported when a frame first needs them: importing numba takes
0.3 s.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import RECIPE_TAPS, RECIPE_WORDS, RGB
from filter_service.errors import NotPrepared
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.psfs.read_kernels import StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.rendering.image_cells import ImageCells

Fill = Callable[[NDArray[np.int64]], None]


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
) -> FrameKernels:
    """Plan the kernels of used (cell, interval) pairs, and compute missing PSFs.

    Parameters
    ----------
    store : PsfStore
    used : (n_cells, n_intervals)
    tables : StoreTables, optional
        Tables to use instead of the store's; their offsets are written to the recipes.
    fill : callable, optional
        Function that computes missing PSFs (n,); `PsfStore.fill` by default.

    Raises
    ------
    NotPrepared
        The deadline of ``fill`` has passed.
    """
    from filter_service.rendering.kernel_loops import fill_kernels, list_nodes

    n_fields, maps = len(layers.layer_zero_dpt), image.maps.tables
    weight_ratio = np.ascontiguousarray(image.weight_ratio)
    cells, intervals, parts, *pairs = list_nodes(
        np.ascontiguousarray(used),
        np.ascontiguousarray(image.nodes),
        weight_ratio,
        n_fields,
    )
    nodes = _node_kernels(
        store, tables or store.tables, fill or store.fill, layers, *pairs
    )
    spread_px = nodes.recipe_spread_px[np.stack([nodes.near, nodes.far], axis=-1)]
    arrays = {
        "weight_ratio": np.empty(parts.shape),
        "maps": np.empty((*parts.shape, 2, 2)),
        "reach_px": np.empty((cells.size, 4), np.int64),
        "radius_px": np.empty(cells.size, np.int64),
        "peak_ratio": np.empty(cells.size),
        "spread_px": np.empty((cells.size, 2)),
    }
    fill_kernels(
        maps,
        weight_ratio,
        cells,
        parts,
        (nodes.reach_px, nodes.radius_px, nodes.peak_ratio, spread_px),
        tuple(arrays.values()),
    )
    return FrameKernels(
        nodes=nodes, cells=cells, intervals=intervals, parts=parts, **arrays
    )


def missing_psfs(
    store: PsfStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Return the indices (n,) of needed PSFs that have not been computed yet."""
    from filter_service.rendering.kernel_loops import list_nodes

    *_, fields, intervals = list_nodes(
        np.ascontiguousarray(used),
        np.ascontiguousarray(image.nodes),
        np.ascontiguousarray(image.weight_ratio),
        len(layers.layer_zero_dpt),
    )
    found: list[NDArray[np.int64]] = []

    def note(psfs: NDArray[np.int64]) -> None:
        found.append(psfs)
        raise NotPrepared

    with suppress(NotPrepared):
        _node_kernels(store, store.tables, note, layers, fields, intervals)
    return found[0] if found else np.zeros(0, np.int64)


def _node_kernels(
    store: PsfStore,
    tables: StoreTables,
    fill: Fill,
    layers: FrameLayers,
    fields: NDArray[Any],
    intervals: NDArray[Any],
) -> NodeKernels:
    from filter_service.rendering.kernel_loops import fill_recipes, list_recipes

    near, far, recipe_fields, recipe_layers = list_recipes(
        fields, intervals, len(layers.layer_zero_dpt), len(layers.layer_dpt)
    )
    count = recipe_fields.size
    recipes = np.zeros((count, RGB, 3, RECIPE_TAPS), dtype=np.uint32)
    reach_px, radius_px = np.empty((count, 4), np.int64), np.empty(count, np.int64)
    peak_ratio, spread_px = np.empty(count), np.empty(count)
    missing = np.empty(store.psf_count, np.int64)
    while True:
        store.frame_number += 1
        n_missing = fill_recipes(
            tables,
            layers.reads,
            recipe_fields,
            layers.layer_dpt[recipe_layers, None]
            + layers.layer_zero_dpt[recipe_fields],
            recipes,
            recipes.view(np.float32),
            (reach_px, radius_px, peak_ratio, spread_px),
            missing,
            np.uint32(store.frame_number),
        )
        if not n_missing:
            break
        fill(missing[:n_missing].copy())
    return NodeKernels(
        near=near,
        far=far,
        reach_px=np.maximum(reach_px[near], reach_px[far]),
        radius_px=np.maximum(radius_px[near], radius_px[far]),
        peak_ratio=np.maximum(peak_ratio[near], peak_ratio[far]),
        recipes=recipes.reshape(count, RGB, RECIPE_WORDS),
        recipe_spread_px=spread_px,
    )


def pair_index(kernels: FrameKernels, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Return the kernel index (n_cells, n_intervals) of each pair; 0 if unused."""
    index = np.zeros(shape, dtype=np.uint32)
    index[kernels.cells, kernels.intervals] = np.arange(kernels.count)
    return index
