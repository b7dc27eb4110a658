"""Plan of a frame's kernels for the compiled loops, cached between frames."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import MAX_LEVEL, MIN_SPREAD_PX
from filter_service.native.records import KERNEL_SHAPE
from filter_service.psfs.boxes import box_sizes
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.frame_kernels import (
    Fill,
    FrameKernels,
    MissingPsfs,
    frame_kernels,
    pair_index,
)
from filter_service.rendering.image_cells import ImageCells, check_texels
from filter_service.rendering.native.native_store import NativeStore


@dataclass(frozen=True)
class KernelPlan:
    """Kernels of a frame in one state.

    Attributes
    ----------
    state : (NativeStore, FrameLayers, ImageCells)
        State that the kernels belong to.
    used : (n_cells, n_intervals), bool
        Pairs that have a kernel.
    kernels : FrameKernels
    kernel_of : (n_cells, n_intervals), uint32
    shapes : (n,), KERNEL_SHAPE
        The stage `merge` writes `levels_used`.
    sources : tuple of arrays
        Contiguous inputs of the stage `blend`: cells, parts, near and far recipes,
        weights, maps, recipes.
    """

    state: tuple[NativeStore, FrameLayers, ImageCells]
    used: NDArray[np.bool_]
    kernels: FrameKernels
    kernel_of: NDArray[np.uint32]
    shapes: NDArray[np.void]
    sources: tuple[NDArray[Any], ...]

    def serves(self, state: tuple[object, ...], used: NDArray[np.bool_]) -> bool:
        """Return whether the plan is for this state and has a kernel for each pair."""
        if any(own is not other for own, other in zip(self.state, state, strict=True)):
            return False
        return not np.any(used & ~self.used)


def plan_kernels(
    handle: NativeStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
    fill: Fill,
) -> KernelPlan | MissingPsfs:
    """Plan the kernels of used pairs, and compute missing PSFs.

    Raises
    ------
    KernelsTooLarge
        There are too many texels, and larger cells are possible.
    """
    kernels = frame_kernels(
        handle.store, layers, image, used, tables=handle.tables, fill=fill
    )
    if isinstance(kernels, MissingPsfs):
        return kernels
    widths, heights = box_sizes(kernels.reach_px)
    check_texels(int((widths * heights).sum()), image, handle.store.spec)
    nodes = kernels.nodes
    sources = (kernels.cells, kernels.parts, nodes.near, nodes.far)
    return KernelPlan(
        state=(handle, layers, image),
        used=used,
        kernels=kernels,
        kernel_of=pair_index(kernels, used.shape),
        shapes=_shapes(kernels, layers.merge_spread_px),
        sources=(
            *(np.ascontiguousarray(numbers, np.int64) for numbers in sources),
            np.ascontiguousarray(kernels.weight_ratio, np.float64),
            np.ascontiguousarray(kernels.maps, np.float64),
            np.ascontiguousarray(nodes.recipes, np.uint32),
        ),
    )


def _shapes(kernels: FrameKernels, merge_spread_px: float) -> NDArray[np.void]:
    shapes = np.zeros(kernels.count, KERNEL_SHAPE)
    shapes["spread_px"] = kernels.spread_px
    shapes["radius_px"] = kernels.radius_px
    shapes["reach_px"] = kernels.reach_px
    widest_px = np.maximum(kernels.spread_px.max(axis=1), MIN_SPREAD_PX)
    steps = np.floor(np.log2(widest_px / merge_spread_px)) + 1
    shapes["highest_level"] = np.clip(steps, 0, MAX_LEVEL)
    return shapes
