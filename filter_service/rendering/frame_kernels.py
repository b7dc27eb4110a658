"""Which kernels a frame needs, and what each is blended from; CPU only.

A frame's kernels are (image cell, layer interval) pairs, one for each that its pixels
use.  A kernel holds both ends of its interval.  It is blended from node kernels, which
are (field node, layer interval) pairs, and those from the cache.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    KERNEL_WORDS,
    MAX_LEVEL,
    MERGE_MIN_SPREAD_PX,
    NO_LEVEL,
    NODE_WORDS,
    PART_WORDS,
    RECIPE_TAPS,
    WEIGHT_MAX,
)
from filter_service.psfs.pack import box_sizes, pack_reach
from filter_service.psfs.store import FrameLayers, PsfStore, neighbours
from filter_service.rendering.image_cells import ImageCells


@dataclass(frozen=True)
class NodeKernels:
    """Kernels of field nodes, blended over pupil, accommodation and defocus.

    Attributes
    ----------
    near, far : (n,)
        Recipes of the interval's two ends.
    reach_px : (n, 4)
        Of the interval: left, right, up, down.
    radius_px : (n,)
    peak_ratio : (n,)
        Bound on the weights of the interval.
    recipes : (n_recipes, 3, 24), uint32
        Per channel eight kernel offsets, eight reaches (a byte a side), eight weights
        (float bits) that turn steps of a cached kernel into its share of a layer.
    recipe_spread_px : (n_recipes,)
        Smallest spread over the channels; decides what may merge.
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
        Which pair a kernel serves.
    parts : (n, 4)
        Node kernels it is blended from.
    weight_ratio : (n, 4)
        Share of a part; where its map turns or shears, times the area of a mapped pixel
        over that of its sides.
    maps : (n, 4, 2, 2)
        From offsets in the image's pixels to those of the part; exactly the identity
        where it is as good as that.
    reach_px : (n, 4)
        Left, right, up, down.
    radius_px : (n,)
    peak_ratio : (n,)
        Bound on the weights.
    spread_px : (n, 2)
        At both ends of the interval.
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
    """Intervals between layers; a single layer is its own."""
    return max(len(layers.layer_dpt) - 1, 1)


def frame_kernels(
    store: PsfStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
) -> FrameKernels:
    """Plan the kernels of used (cell, interval) pairs.

    Parameters
    ----------
    used : (n_cells, n_intervals)
    """
    cells, intervals = np.nonzero(used)
    n_intervals = used.shape[1]
    wanted = image.nodes[cells] * n_intervals + intervals[:, None]
    # A node that weighs nothing is replaced by one that does.
    weights = image.weight_ratio[cells]
    heaviest = np.take_along_axis(wanted, weights.argmax(axis=1)[:, None], axis=1)
    wanted = np.where(weights > 0.0, wanted, heaviest)
    pairs, parts = np.unique(wanted, return_inverse=True)
    parts = parts.reshape(wanted.shape)
    nodes = _node_kernels(store, layers, *np.divmod(pairs, n_intervals))
    spread_px = nodes.recipe_spread_px[np.stack([nodes.near, nodes.far], axis=-1)]
    is_moved = image.maps.is_moved(cells, nodes.radius_px[parts])
    area = np.where(is_moved, image.maps.area_ratio[cells], 1.0)
    in_use = weights > 0.0
    reach_px, radius_px = image.maps.mapped_sizes(
        cells, is_moved, nodes.reach_px[parts], nodes.radius_px[parts]
    )
    return FrameKernels(
        nodes=nodes,
        cells=cells,
        intervals=intervals,
        parts=parts,
        weight_ratio=weights * np.where(is_moved, image.maps.box_ratio[cells], 1.0),
        maps=np.where(
            is_moved[..., None, None], image.maps.node_from_cell[cells], np.eye(2)
        ),
        reach_px=np.where(in_use[..., None], reach_px, 0).max(axis=1),
        radius_px=np.where(in_use, radius_px, 0).max(axis=1),
        peak_ratio=(nodes.peak_ratio[parts] * weights * area).sum(axis=1),
        spread_px=(spread_px[parts] * (weights / np.sqrt(area))[..., None]).sum(axis=1),
    )


def _node_kernels(
    store: PsfStore, layers: FrameLayers, fields: NDArray, intervals: NDArray
) -> NodeKernels:
    n_layers = len(layers.layer_dpt)
    ends = np.minimum(np.stack([intervals, intervals + 1]), n_layers - 1)
    wanted, recipe_of = np.unique(fields * n_layers + ends, return_inverse=True)
    near, far = recipe_of.reshape(ends.shape)
    recipe_fields, recipe_layers = np.divmod(wanted, n_layers)
    psfs, weights = neighbours(
        store,
        layers.pupil_diameter_mm,
        layers.corners,
        recipe_fields,
        layers.layer_dpt[recipe_layers, None] + layers.layer_zero_dpt[recipe_fields],
    )
    taken = weights > 0.0
    own_px = np.where(taken[..., None], store.reach_px[psfs], 0).max(axis=(1, 2))
    own_radius_px = np.where(taken, store.radius_px[psfs], 0).max(axis=(1, 2))
    own_peak = (weights * store.peak_ratio[psfs]).sum(axis=2).max(axis=1)
    return NodeKernels(
        near=near,
        far=far,
        reach_px=np.maximum(own_px[near], own_px[far]),
        radius_px=np.maximum(own_radius_px[near], own_radius_px[far]),
        peak_ratio=np.maximum(own_peak[near], own_peak[far]),
        recipes=_recipes(store, psfs, weights),
        recipe_spread_px=(weights * store.spread_px[psfs]).sum(axis=2).min(axis=1),
    )


def _recipes(store: PsfStore, psfs: NDArray, weights: NDArray) -> NDArray[np.uint32]:
    recipes = np.zeros((*psfs.shape[:2], 3, RECIPE_TAPS), dtype=np.uint32)
    taps = psfs.shape[-1]
    recipes[..., 0, :taps] = store.offsets[psfs]
    recipes[..., 1, :taps] = pack_reach(store.reach_px[psfs])
    per_step = weights * store.peak_ratio[psfs] / WEIGHT_MAX
    recipes[..., 2, :taps] = per_step.astype(np.float32).view(np.uint32)
    return recipes.reshape(*psfs.shape[:2], 3 * RECIPE_TAPS)


def node_table(nodes: NodeKernels) -> tuple[NDArray[np.uint32], int]:
    """Make records (n, 2, 4) of node kernels for blend_psfs; and texels of all."""
    widths, heights = box_sizes(nodes.reach_px)
    sizes = widths * heights
    starts = np.cumsum(sizes) - sizes
    table = np.zeros((nodes.near.size, NODE_WORDS, 4), dtype=np.uint32)
    table[:, 0, 0] = nodes.near
    table[:, 0, 1] = nodes.far
    table[:, 0, 2] = starts
    table[:, 0, 3] = pack_reach(nodes.reach_px)
    table[:, 1, 0] = nodes.peak_ratio.astype(np.float32).view(np.uint32)
    return table, int(sizes.sum())


def kernel_levels(kernels: FrameKernels) -> NDArray[np.int64]:
    """Return the merging level (n,) for which a kernel is wide enough at one end."""
    steps = np.log2(
        np.maximum(kernels.spread_px.max(axis=1), 1e-9) / MERGE_MIN_SPREAD_PX
    )
    return np.clip(np.floor(steps) + 1, 0, MAX_LEVEL).astype(np.int64)


def level_sizes(kernels: FrameKernels, level: int) -> NDArray[np.int64]:
    """Texels (n,) of the kernels of a level; 0 where there is none."""
    widths, heights = box_sizes(kernels.reach_px)
    extent = 2**level - 1
    return np.where(
        level <= kernel_levels(kernels), (widths + extent) * (heights + extent), 0
    )


def kernel_table(kernels: FrameKernels) -> tuple[NDArray[np.uint32], int]:
    """Make records (n, 3, 4) of kernels for common/kernels.glsl; and texels of all.

    Each is followed by its merged forms: the kernel summed over squares of pixels.
    """
    levels = np.arange(MAX_LEVEL + 1)
    sizes = np.stack([level_sizes(kernels, int(level)) for level in levels], axis=-1)
    starts = (np.cumsum(sizes) - sizes.ravel()).reshape(sizes.shape)
    scale = np.minimum(kernels.peak_ratio[:, None] * 4.0**levels, 1.0)
    scale = scale.astype(np.float32)
    scale[:, 0] = kernels.peak_ratio
    spread_px = kernels.spread_px.astype(np.float32)
    table = np.zeros((kernels.count, KERNEL_WORDS, 4), dtype=np.uint32)
    table[:, 0, :2] = spread_px.view(np.uint32)
    table[:, 0, 2] = kernels.radius_px
    table[:, 0, 3] = pack_reach(kernels.reach_px)
    table[:, 1] = np.where(sizes > 0, starts, NO_LEVEL)
    table[:, 2] = scale.view(np.uint32)
    return table, int(sizes.sum())


def part_table(kernels: FrameKernels) -> NDArray[np.uint32]:
    """Make records (n, 6, 4) for blend_cells: four node kernels, weights and maps."""
    table = np.empty((kernels.count, PART_WORDS, 4), dtype=np.uint32)
    table[:, 0] = kernels.parts
    table[:, 1] = kernels.weight_ratio.astype(np.float32).view(np.uint32)
    maps = kernels.maps.reshape(kernels.count, 4, 4)
    table[:, 2:] = maps.astype(np.float32).view(np.uint32)
    return table


def pair_index(kernels: FrameKernels, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Kernel (n_cells, n_intervals) of a pair; 0 where no pixel uses it."""
    index = np.zeros(shape, dtype=np.uint32)
    index[kernels.cells, kernels.intervals] = np.arange(kernels.count)
    return index


def work_list(n_texels: NDArray[np.int64], threads: int) -> NDArray[np.uint32]:
    """Work groups (n, 2) over kernels of different size: kernel, its first texel."""
    groups = -(-n_texels // threads)
    kernel = np.repeat(np.arange(groups.size), groups)
    first = np.arange(kernel.size) - np.repeat(np.cumsum(groups) - groups, groups)
    return np.stack([kernel, first * threads], axis=-1).astype(np.uint32)
