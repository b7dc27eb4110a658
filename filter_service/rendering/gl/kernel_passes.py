"""The passes that make a frame's kernels from the cache; kept between frames."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BITS_PER_WORD,
    MAX_LAYERS,
    MAX_LEVEL,
    THREADS,
    USED_PARTS,
)
from filter_service.errors import GridTooLarge
from filter_service.gl.gpu import Atlas, Buffer, Gpu, Pages
from filter_service.gl.stage_timer import StageTimer
from filter_service.psfs.boxes import box_sizes
from filter_service.psfs.store import FrameLayers, PsfStore
from filter_service.rendering.frame_kernels import (
    FrameKernels,
    frame_kernels,
    interval_count,
    kernel_table,
    node_table,
    pair_index,
    part_table,
    work_list,
)
from filter_service.rendering.gl.expected_pairs import ExpectedPairs, FrameState
from filter_service.rendering.gl.strip import grid_of
from filter_service.rendering.image_cells import (
    ImageCells,
    KernelsTooLarge,
    can_coarsen,
    check_texels,
)

MAX_KERNEL_TEXELS = 24 * 2**20
"""Of a frame: 400 MB, 16 bytes each."""


@dataclass(frozen=True)
class KernelSet:
    """Kernels on the GPU.

    Attributes
    ----------
    kernels : FrameKernels
    texel_count : int
        Of all kernels, at all levels.
    buffers : dict
        KERNELS and KERNEL_OF.
    atlas : Atlas
        Their texels.
    have : (n_cells, n_intervals), bool
        Pairs that there are kernels for.
    """

    kernels: FrameKernels
    texel_count: int
    buffers: dict[str, Buffer]
    atlas: Atlas
    have: NDArray[np.bool_]

    def lacks(self, used: NDArray[np.bool_]) -> bool:
        """Return whether a frame uses pairs that there are no kernels for."""
        return bool(np.any(used & ~self.have))


class KernelMaker:
    """Makes the kernels that a frame uses; the last frame's serve if they can.

    Parameters
    ----------
    gpu : Gpu
    slot : int
        Of several makers in one context: each has memory of its own.
    """

    def __init__(self, gpu: Gpu, slot: int = 0):
        self._gpu, self._slot = gpu, slot
        self._memory = f"kernels {slot}"
        self._pairs = ExpectedPairs()
        self.forget()

    def forget(self) -> None:
        """Let go of what the last frame's kernels were made for."""
        self._made_for: tuple | None = None
        self._set: KernelSet | None = None
        self._pairs.forget()

    def note(self, state: FrameState, words: NDArray[np.uint32]) -> None:
        """Take what a whole frame used, by which the next is told."""
        self._pairs.note(state, words)

    def expected(
        self, store: PsfStore, pages: Pages, state: FrameState, timer: StageTimer
    ) -> KernelSet | None:
        """Return kernels that will serve a frame, it seems: the last, or new ones.

        None where nothing is known, or where it pays to ask the GPU: a software
        renderer does not keep one waiting.
        """
        kept = self.kept(pages, state.layers, state.image)
        if kept is not None or self._gpu.is_software:
            return kept
        with timer.wall("psf_plan_ms"):
            used = self._pairs.at(state)
        if used is None:
            return None
        try:
            return self.kernels(store, pages, state.layers, state.image, used, timer)
        except KernelsTooLarge:
            return None  # those that are really used may fit

    def kept(
        self, pages: Pages, layers: FrameLayers, image: ImageCells
    ) -> KernelSet | None:
        """Return the last frame's kernels, if they were made for the same state.

        And are still there: another renderer of this context has memory of that name.
        """
        key = (pages, layers, image)
        if not self._gpu.is_owner(self._memory, self):
            return None
        if self._made_for is None or any(
            a is not b for a, b in zip(self._made_for, key, strict=True)
        ):
            return None
        return self._set

    def kernels(
        self,
        store: PsfStore,
        pages: Pages,
        layers: FrameLayers,
        image: ImageCells,
        used: NDArray[np.bool_],
        timer: StageTimer,
    ) -> KernelSet:
        """Return kernels for all used (cell, interval) pairs (n_cells, n_intervals)."""
        kept = self.kept(pages, layers, image)
        if kept is not None and not kept.lacks(used):
            return kept
        self._made_for = None  # stays so if what follows fails
        with timer.wall("psf_plan_ms"):
            if kept is not None:
                used = self._with_those_before(store, layers, image, used, kept.have)
            kernels = frame_kernels(store.tables, layers, image, used)
            table, sizes = _records(kernels, store, image)
        with timer.stage("psf_blend_ms"):
            self._set = self._blend(kernels, table, sizes, pages, used)
        self._made_for = (pages, layers, image)
        return self._set

    @staticmethod
    def _with_those_before(
        store: PsfStore,
        layers: FrameLayers,
        image: ImageCells,
        used: NDArray[np.bool_],
        have: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Add the pairs of the frame before, if they fit: the next may use them."""
        try:
            both = used | have
            _records(frame_kernels(store.tables, layers, image, both), store, image)
        except KernelsTooLarge:
            return used
        return both

    def _blend(
        self,
        kernels: FrameKernels,
        table: NDArray[np.uint32],
        sizes: NDArray[np.int64],
        pages: Pages,
        used: NDArray[np.bool_],
    ) -> KernelSet:
        gpu = self._gpu
        nodes, node_texels = node_table(kernels.nodes)
        texels = int(sizes.sum())
        node_atlas = gpu.atlas("nodes", node_texels)
        gpu.claim(self._memory, self)
        atlas = gpu.atlas(self._memory, texels)
        buffers = {
            "NODES": gpu.upload("NODES", nodes),
            "RECIPES": gpu.upload("RECIPES", kernels.nodes.recipes),
            "KERNELS": gpu.upload(f"KERNELS {self._slot}", table),
            "PARTS": gpu.upload("PARTS", part_table(kernels)),
            "KERNEL_OF": gpu.upload(
                f"KERNEL_OF {self._slot}", pair_index(kernels, used.shape)
            ),
        }
        node_widths, node_heights = box_sizes(kernels.nodes.reach_px)
        self._run(
            "blend_psfs",
            node_widths * node_heights,
            {name: buffers[name] for name in ("NODES", "RECIPES")},
            images={"NODES": node_atlas},
            textures={"STORE": pages},
        )
        self._run(
            "blend_cells",
            sizes[:, 0],
            {name: buffers[name] for name in ("NODES", "PARTS", "KERNELS")},
            images={"ATLAS": atlas},
            textures={"NODES": node_atlas},
        )
        for level in range(1, MAX_LEVEL + 1):
            self._run(
                "merge_psfs",
                sizes[:, level],
                {"KERNELS": buffers["KERNELS"]},
                images={"ATLAS": atlas},
                uniforms={"level": level},
            )
        kept = {name: buffers[name] for name in ("KERNELS", "KERNEL_OF")}
        return KernelSet(kernels, texels, kept, atlas, used)

    def _run(
        self,
        name: str,
        n_texels: NDArray,
        buffers: dict,
        *,
        uniforms: dict | None = None,
        **bindings,
    ) -> None:
        work = work_list(n_texels, THREADS)
        if not len(work):
            return
        self._gpu.dispatch(
            name,
            grid_of(len(work)),
            buffers={**buffers, "WORK": self._gpu.upload("WORK", work)},
            uniforms={"group_count": len(work), **(uniforms or {})},
            **bindings,
        )


def _records(
    kernels: FrameKernels, store: PsfStore, image: ImageCells
) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Return the records of kernels, and how many texels they have.

    Raises
    ------
    KernelsTooLarge
        Larger cells would have fewer.
    """
    widths, heights = box_sizes(kernels.reach_px)
    check_texels(int((widths * heights).sum()), image, store.spec)
    table, sizes = kernel_table(kernels)
    n_texels = int(sizes.sum())
    if n_texels > MAX_KERNEL_TEXELS and can_coarsen(image):
        raise KernelsTooLarge(
            f"the frame's kernels need {n_texels} texels; allowed are "
            f"{MAX_KERNEL_TEXELS}",
        )
    return table, sizes


def words_per_cell(layers: FrameLayers) -> int:
    """Words that note the used parts of a cell's intervals.

    Raises
    ------
    GridTooLarge
        More layers than a frame may have.
    """
    if len(layers.layer_dpt) > MAX_LAYERS:
        raise GridTooLarge(
            f"{len(layers.layer_dpt)} layers between "
            f"{layers.layer_dpt[0]:g} and {layers.layer_dpt[-1]:g} dpt",
            allowed=f"{MAX_LAYERS} layers: a smaller pupil or fewer pixels per degree",
        )
    return -(-interval_count(layers) * USED_PARTS // BITS_PER_WORD)
