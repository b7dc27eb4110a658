"""Input record of the compiled loops, and the plan of kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from estimator.native.records import pointer_to
from filter_service.constants import (
    FIELD_CORNERS,
    MAX_LEVEL,
    MIN_BLUR_RANGE,
    TILE_SIZE_PX,
)
from filter_service.native import Loops, loops
from filter_service.native.records import (
    BLOCK,
    CLUSTER_BYTES,
    FRAGMENT,
    FRAGMENT_EXTRA,
    FRAGMENT_LIGHT,
    KERNEL_IMAGE_BYTES,
    KERNEL_SHAPE,
    RECIPE_IMAGE_BYTES,
    RESOLUTIONS,
    Frame,
    ShrinkJob,
)
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.psfs.frozen_store import FrozenStore
from filter_service.psfs.pack import StoreTables, box_sizes, pack_reach, unpack_reach
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame import Merging
from filter_service.rendering.frame_kernels import (
    Fill,
    FrameKernels,
    MissingPsfs,
    frame_kernels,
    interval_count,
)
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.image_cells import ImageCells, check_texels, image_cells
from filter_service.rendering.native.frame_arrays import Arrays
from filter_service.rgbd_view import RgbdView

COARSE_SPREAD_PX = (0.0, 8.0, 16.0)
"""Smallest spread of kernels that squares splat onto pixels of 1, 2 and 4 px.

Courtyard and photograph, 1280x720, 4.5 mm: the PSNR against full resolution is 71 to
79 dB (myopia, astigmatism, cataract), blending takes 0.5 to 0.67 and splatting 0.7 to
0.9 of the time.  With limits of 6 and 12 px, the PSNR is 65 to 73 dB.
"""

COARSE_SPREAD_RATIO = 0.25
"""Cached kernels are downsampled if their spread is at least this fraction of the
limit: a frame's kernel is a weighted sum of wider and narrower ones.  Narrower cached
kernels become a single coarse pixel."""


class StoredKernels(NamedTuple):
    """Cached kernels at one resolution.

    Attributes
    ----------
    words : (n_texels,), uint16
    first_texel : (n_psfs,), uint64
        First texel of each kernel.
    reach : (n_psfs,), uint32
        Four bytes: left, right, up, down.
    """

    words: NDArray[np.uint16]
    first_texel: NDArray[np.uint64]
    reach: NDArray[np.uint32]

    def with_space_for(self, count: int) -> StoredKernels:
        """Return the kernels with tables for ``count`` more PSFs."""
        return self._replace(
            first_texel=np.append(self.first_texel, np.zeros(count, np.uint64)),
            reach=np.append(self.reach, np.zeros(count, np.uint32)),
        )


class NativeStore(FrameStore):
    """A store with its kernels at all resolutions.

    Attributes
    ----------
    resolutions : list of StoredKernels
        Kernels at each resolution; `sync` adds new ones.
    """

    can_blend = True

    def __init__(self, store: PsfStore) -> None:
        cells = image_cells(store.spec, store.plan, can_blend=self.can_blend)
        super().__init__(store, cells)
        self._psf_numbers = np.zeros(0, np.uint32)
        self._reset()
        _ = store.defocus  # computed here and not by the first frame

    def _reset(self) -> None:
        """Discard all kernels; frames in progress have their own references."""
        self._generation, self._n_seen = self.store.generation, 0
        self._n_texels = [0] * RESOLUTIONS
        self.resolutions = [
            StoredKernels(
                np.empty(0, np.uint16),
                np.zeros(0, np.uint64),
                np.zeros(0, np.uint32),
            )
            for _ in range(RESOLUTIONS)
        ]

    @property
    def tables(self) -> StoreTables:
        """Tables of the store, with kernel numbers in place of offsets."""
        if self._psf_numbers.size != self.store.psf_count:
            self._psf_numbers = np.arange(self.store.psf_count, dtype=np.uint32)
        return self.store.tables._replace(offsets=self._psf_numbers)

    @property
    def memory_mb(self) -> float:
        """Memory of the kernels at all resolutions, MB."""
        return super().memory_mb + 2.0 * sum(self._n_texels[1:]) / 1e6

    def sync(self, library: Loops, threads: int) -> None:
        """Add the kernels that were computed since the last call.

        The caller passes its own threads, because the renderer that loaded the store
        may no longer exist.
        """
        store = self.store
        if store.generation != self._generation:
            self._reset()
        more = store.psf_count - self.resolutions[0].reach.size
        if more:  # nodes of a state that frames use for the first time
            self.resolutions = [own.with_space_for(more) for own in self.resolutions]
        self._n_seen, added = store.added_since(self._n_seen)
        psfs = np.ascontiguousarray(added, np.int64)
        if not psfs.size:
            return
        fine = self.resolutions[0]
        fine.first_texel[psfs] = store.tables.offsets[psfs]
        fine.reach[psfs] = store.tables.reach_words[psfs]
        self.resolutions[0] = fine._replace(words=store.words)
        for resolution in range(1, RESOLUTIONS):
            library.call("shrink", self._shrink_job(resolution, psfs, threads))

    def _shrink_job(
        self, resolution: int, psfs: NDArray[np.int64], threads: int
    ) -> ShrinkJob:
        """Return a job that downsamples kernels (n,), and allocate its output.

        The job points to arrays of the store and to ``psfs``.
        """
        store, coarse = self.store, self.resolutions[resolution]
        size_px = 2**resolution
        reach_px = unpack_reach(store.tables.reach_words[psfs]).astype(np.int64)
        reach_px = (reach_px + size_px // 2) // size_px
        is_wide = (
            store.tables.spread_px[psfs]
            >= COARSE_SPREAD_RATIO * COARSE_SPREAD_PX[resolution]
        )
        reach_px = np.where(is_wide[:, None], reach_px, 0)
        widths, heights = box_sizes(reach_px)
        ends = np.cumsum(widths * heights)
        first, count = self._n_texels[resolution], int(ends[-1])
        if first + count > coarse.words.size:
            grown = np.empty(2 * (first + count), np.uint16)
            grown[:first] = coarse.words[:first]
            coarse = self.resolutions[resolution] = coarse._replace(words=grown)
        coarse.first_texel[psfs] = (first + ends - widths * heights).astype(np.uint64)
        coarse.reach[psfs] = pack_reach(reach_px)
        self._n_texels[resolution] = first + count
        fine = self.resolutions[0]
        return ShrinkJob(
            threads=threads,
            from_words=fine.words.ctypes.data,
            from_first=fine.first_texel.ctypes.data,
            from_reach=fine.reach.ctypes.data,
            to_words=coarse.words.ctypes.data,
            to_first=coarse.first_texel.ctypes.data,
            to_reach=coarse.reach.ctypes.data,
            kernels=psfs.ctypes.data,
            resolution=resolution,
            count=psfs.size,
        )


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
    shapes : (n,), KERNEL_SHAPE
        The stage `merge` writes `levels_used`.
    sources : dict of arrays
        Contiguous inputs of the stages by the names of their pointers in `Frame`.
    """

    state: tuple[NativeStore, FrameLayers, ImageCells]
    used: NDArray[np.bool_]
    kernels: FrameKernels
    shapes: NDArray[np.void]
    sources: dict[str, NDArray[Any]]

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
        handle.store, layers, image, used, tables_of=lambda: handle.tables, fill=fill
    )
    if isinstance(kernels, MissingPsfs):
        return kernels
    if isinstance(handle.store, FrozenStore):
        handle.store.add_low_words(kernels.nodes.recipes)
    shapes = np.empty(kernels.count, KERNEL_SHAPE)
    n_texels = loops().call(
        "fill_shapes",
        *(kernels.spread_px, kernels.radius_px, kernels.reach_px, kernels.count),
        *(layers.merge_spread_px, shapes.view(np.uint8)),
    )
    check_texels(n_texels, image, handle.store.spec)
    nodes = kernels.nodes
    return KernelPlan(
        state=(handle, layers, image),
        used=used,
        kernels=kernels,
        shapes=shapes,
        sources={
            "kernel_of": kernels.kernel_of,
            "shapes": shapes.view(np.uint8),  # structured types take longer to describe
            "kernel_cells": kernels.cells,
            "kernel_parts": kernels.parts,
            "node_near": nodes.near,
            "node_far": nodes.far,
            "part_weights": kernels.weight_ratio,
            "part_maps": kernels.maps,
            "recipes": nodes.recipes,
        },
    )


@lru_cache(maxsize=8)
def _columns(
    width: int, border_px: int, image_width: int, cell_px: int
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the cell (width,) of each column, and its place in the cell, 0 to 1."""
    column = np.clip(np.arange(width) - border_px, 0, image_width - 1)
    cell, place = np.divmod(column, cell_px)
    share = (place + np.float32(0.5)) / np.float32(cell_px)
    return cell.astype(np.int32), share.astype(np.float32)


COLOR_KINDS = {"uint8": 0, "float32": 1, "float16": 2}
BLOCK_PIXELS = TILE_SIZE_PX**2
BOX_PADDING_COUNT = 16
CLAMP_MARGIN_RATIO = 1e-6
COARSE_MARGIN_PX = 8.0
"""Additional reach of coarse kernels, see merge.h."""

REACH_MARGIN_PX = 1.5


class BlendSizes(NamedTuple):
    """Output sizes of the stage `blend`, which the stage `place` computes."""

    recipe_texels: int
    kernel_texels: int
    scratch_floats: int

    @classmethod
    def of(cls, c: Frame) -> BlendSizes:
        """Return the sizes in a record."""
        return cls(
            c.recipe_texel_count,
            c.kernel_texel_count,
            c.blend_scratch_floats,
        )


@dataclass
class FrameRecord:
    """Record of one frame, which keeps the arrays alive that it points to.

    Attributes
    ----------
    c : Frame
    """

    c: Frame
    n_threads: int
    arrays: Arrays
    eye_arrays: Arrays  # the next frame of this eye may reuse their contents
    referenced: list[NDArray[Any]]

    @classmethod
    def new(
        cls, threads: int, n_threads: int, arrays: Arrays, eye_arrays: Arrays
    ) -> FrameRecord:
        """Return an empty record for loops on a pool of threads."""
        return cls(Frame(threads=threads), n_threads, arrays, eye_arrays, [])

    def _pointer_to(self, array: NDArray[Any]) -> int:
        """Return the address of an array, and keep the array alive with the record."""
        self.referenced.append(array)
        return pointer_to(array)

    def _buffer(self, name: str, count: int, dtype: DTypeLike = np.uint8) -> int:
        return self.arrays.address(name, count, dtype)

    def set_view(self, view: RgbdView, border_px: int) -> None:
        """Set pointers to the images of a view, which may have a border."""
        c = self.c
        c.width, c.height = view.width_px, view.height_px
        c.surface_count, c.border_px = view.surface_count, border_px
        c.image_width = view.width_px - 2 * border_px
        c.image_height = view.height_px - 2 * border_px
        c.block_columns = -(-view.width_px // TILE_SIZE_PX)
        c.block_rows = -(-view.height_px // TILE_SIZE_PX)
        c.color_kind = COLOR_KINDS[view.color.dtype.name]
        for s, (color, depth_m) in enumerate(
            zip(view.surface_colors, view.surface_depths_m, strict=True)
        ):
            c.color[s] = self._pointer_to(np.ascontiguousarray(color))
            c.depth_m[s] = self._pointer_to(np.ascontiguousarray(depth_m))
        c.depth_is_planar = view.depth_kind == "planar"
        c.tangents[:] = view.tangents
        n_pixels = view.surface_count * view.width_px * view.height_px
        c.dpt = self._buffer("dpt", n_pixels, np.float32)
        c.position = self._buffer("position", n_pixels, np.float32)

    def set_state(
        self,
        layers: FrameLayers,
        image: ImageCells,
        corner_change_dpt: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Set pointers to layers and cells; return the array for the used pairs."""
        c = self.c
        far_dpt, near_dpt = layers.vergence_range_dpt
        c.vergence_low_dpt, c.vergence_high_dpt = far_dpt, near_dpt
        c.vergence_margin_dpt = CLAMP_MARGIN_RATIO * max(near_dpt, 1.0)
        c.vergence_scale = layers.vergence.scale_ratio
        c.vergence_offset_m = layers.vergence.offset_m
        c.blur_px_per_dpt = layers.blur_px_per_dpt
        layer_dpt = layers.layer_dpt.astype(np.float32)
        c.layer_dpt = self._pointer_to(layer_dpt)
        steps_dpt = np.maximum(np.diff(layer_dpt), MIN_BLUR_RANGE)
        c.layer_per_dpt = self._pointer_to((1.0 / steps_dpt).astype(np.float32))
        c.layer_count = len(layers.layer_dpt)
        c.interval_count = interval_count(layers)
        c.cell_px, c.cell_columns = image.cell_px, image.grid[0]
        c.corner_dpt = self._pointer_to(
            np.ascontiguousarray(corner_change_dpt, np.float32)
        )
        c.row_scratch = self._buffer(
            "row_scratch", self.n_threads * (c.cell_columns + 1), np.float32
        )
        if image.cell_px:
            cell, share = _columns(c.width, c.border_px, c.image_width, image.cell_px)
            c.column_cell = self._pointer_to(cell)
            c.column_share = self._pointer_to(share)
        c.block_slots = BLOCK_PIXELS
        if image.blends:
            c.block_slots *= FIELD_CORNERS
            for axis, names in enumerate(
                (("blend_column", "blend_across"), ("blend_row", "blend_down"))
            ):
                first, share = self._blending(image, axis)
                setattr(c, names[0], self._pointer_to(first))
                setattr(c, names[1], self._pointer_to(share))
        used = np.zeros((image.count, c.interval_count), np.bool_)
        c.used = self._pointer_to(used)
        return used

    def _blending(
        self, image: ImageCells, axis: int
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the first cell (n,) of columns or rows, and the share of the next."""
        c = self.c
        size = (c.width, c.height)[axis]
        image_size = (c.image_width, c.image_height)[axis]
        places = np.clip(np.arange(size) - c.border_px, 0, image_size - 1)
        return image.blending(axis, places)

    def set_kernels(self, plan: KernelPlan) -> None:
        """Set pointers to the planned kernels and to buffers for fragments."""
        c = self.c
        c.kernel_count = plan.kernels.count
        reach_px = float(plan.kernels.reach_px.max())
        c.largest_reach_px = reach_px + REACH_MARGIN_PX + COARSE_MARGIN_PX
        n_blocks = c.block_columns * c.block_rows
        c.block_light = self._buffer("block_light", 4 * n_blocks, np.float32)
        n_blocks *= c.surface_count
        c.fragments = self._buffer("fragments", n_blocks * c.block_slots, FRAGMENT)
        c.lights = self._buffer("lights", n_blocks * c.block_slots, FRAGMENT_LIGHT)
        c.extras = self._buffer("extras", n_blocks * c.block_slots, FRAGMENT_EXTRA)
        if c.blend_column:
            count = n_blocks * c.block_slots
            c.blend_shares = self._buffer("blend_shares", count, np.float32)
        n_clusters = n_blocks * c.block_slots
        c.clusters = self._buffer("clusters", n_clusters * CLUSTER_BYTES, np.uint8)
        for side in range(4):
            c.boxes[side] = self._buffer(
                f"boxes {side}", n_clusters + BOX_PADDING_COUNT, np.int16
            )
        c.blocks = self._buffer("blocks", n_blocks, BLOCK)
        for name, array in plan.sources.items():
            setattr(c, name, self._pointer_to(array))
        c.recipe_count = len(plan.kernels.nodes.recipes)
        n_images = RESOLUTIONS * c.recipe_count
        eye_buffer = self.eye_arrays.address
        n_bytes = n_images * RECIPE_IMAGE_BYTES
        c.recipe_images = eye_buffer("recipe_images", n_bytes, np.uint8)
        c.kernels = eye_buffer("kernels", c.kernel_count * KERNEL_IMAGE_BYTES, np.uint8)

    def set_merging(
        self, merging: Merging, *, white_level: float, is_encoded: bool
    ) -> None:
        """Set how the frame is merged; the paper has one level."""
        c, tolerance, paper_rule = self.c, merging.tolerance, merging.paper_rule
        c.paper_rule, c.white_level = paper_rule, white_level
        c.bright_pixels = merging.bright_pixels
        c.is_encoded = is_encoded and white_level > 0.0
        most = 1 if paper_rule else MAX_LEVEL
        if c.cell_px:
            most = min(most, c.cell_px.bit_length() - 1)
        c.max_level = most if tolerance > 0.0 else 0
        c.tolerance = tolerance
        c.gaze_direction[:] = merging.gaze
        for r in range(1, RESOLUTIONS):
            spread_px = COARSE_SPREAD_PX[r] / tolerance if tolerance > 0.0 else math.inf
            c.coarse_spread_px[r] = max(spread_px, COARSE_SPREAD_PX[r])

    def set_store(self, handle: NativeStore) -> None:
        """Set pointers to the cached kernels."""
        self.c.has_fine_kernels = isinstance(handle.store, FrozenStore)
        for r, stored in enumerate(handle.resolutions):
            self.c.store[r] = self._pointer_to(stored.words)
            self.c.store_first[r] = self._pointer_to(stored.first_texel)
            self.c.store_reach[r] = self._pointer_to(stored.reach)
            self.c.store_words[r] = stored.words.size

    def set_blend_buffers(self, sizes: BlendSizes) -> None:
        """Set pointers to buffers for blended kernels, or with such kernels."""
        c = self.c
        buffer = self.eye_arrays.address
        c.recipe_texels = buffer("recipe_texels", 4 * sizes.recipe_texels, np.float32)
        c.kernel_texels = buffer("kernel_texels", 4 * sizes.kernel_texels, np.uint32)
        c.blend_scratch_floats = sizes.scratch_floats
        n_floats = self.n_threads * sizes.scratch_floats
        c.blend_scratch = self._buffer("blend_scratch", n_floats, np.float32)

    def set_picture(self, picture: NDArray[Any]) -> None:
        """Set the pointer to the output image."""
        self.c.picture = self._pointer_to(picture)
        self.c.output_kind = COLOR_KINDS[picture.dtype.name]

    def set_added_light(self, squares: NDArray[np.float32]) -> None:
        """Set light (rows, columns, 8) that is added, see `KernelTails`."""
        self.c.added.squares = self._pointer_to(squares)
        self.c.added.rows, self.c.added.columns = squares.shape[:2]
