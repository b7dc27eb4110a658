"""Passes that blend a frame's kernels from cached PSFs; frames can reuse kernels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import BITS_PER_WORD, MAX_LAYERS, USED_PARTS
from filter_service.errors import GridTooLarge
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Atlas, BufferPart, Pages
from filter_service.gl.stage_timer import StageTimer
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame_kernels import (
    Fill,
    FrameKernels,
    frame_kernels,
    interval_count,
)
from filter_service.rendering.gl.expected_pairs import ExpectedPairs, FrameState
from filter_service.rendering.gl.gl_store import GlStore
from filter_service.rendering.gl.strip import dispatch_grid
from filter_service.rendering.image_cells import (
    ImageCells,
    KernelsTooLarge,
    can_coarsen,
    check_texels,
)
from filter_service.rendering.kernel_tables import (
    LEVEL_WORK,
    NODE_WORK,
    KernelLevels,
    KernelTables,
    kernel_levels,
    kernel_tables,
)

MAX_KERNEL_TEXELS = 24 * 2**20
"""Largest texel count of a frame's kernels: 400 MB at 16 bytes per texel."""

_WORD_BYTES = 4


@dataclass(frozen=True)
class KernelSet:
    """Kernels on the GPU.

    Attributes
    ----------
    kernels : FrameKernels
    texel_count : int
        Total of all kernels, at all levels.
    buffers : dict
        KERNELS and KERNEL_OF.
    atlas : Atlas
        Texels of the kernels.
    available : (n_cells, n_intervals), bool
        Pairs that have a kernel.
    """

    kernels: FrameKernels
    texel_count: int
    buffers: dict[str, BufferPart]
    atlas: Atlas
    available: NDArray[np.bool_]

    def lacks(self, used: NDArray[np.bool_]) -> bool:
        """Return whether a frame uses pairs without a kernel."""
        return bool(np.any(used & ~self.available))


class KernelMaker:
    """Blend the kernels that frames use, and cache those of the last frame.

    Parameters
    ----------
    gpu : Gpu
    slot : int
        Number of this instance in its context; each has its own atlas.
    """

    def __init__(self, gpu: Gpu, slot: int = 0):
        self._gpu, self._slot = gpu, slot
        self._memory = f"kernels {slot}"
        self._pairs = ExpectedPairs()
        self.reset()

    def reset(self) -> None:
        """Discard the last frame's kernels and the prediction."""
        self._made_for: tuple[Any, ...] | None = None
        self._set: KernelSet | None = None
        self._pairs.reset()

    def record_pairs(self, state: FrameState, words: NDArray[np.uint32]) -> None:
        """Record the pairs that a frame used, from which the next are predicted."""
        self._pairs.record(state, words)

    def predicted(
        self, handle: GlStore, state: FrameState, timer: StageTimer, fill: Fill
    ) -> KernelSet | None:
        """Return kernels for the predicted pairs of a frame.

        Returns None if there is no prediction, or if a readback of the used pairs costs
        nothing, as on a software renderer.
        """
        cached = self.cached(handle, state.layers, state.image)
        if cached is not None or self._gpu.is_software:
            return cached
        with timer.wall("psf_plan_ms"):
            used = self._pairs.predict(state)
        if used is None:
            return None
        try:
            return self.kernels(handle, state.layers, state.image, used, timer, fill)
        except KernelsTooLarge:
            return None  # the pairs that the frame actually uses may fit

    def cached(
        self, handle: GlStore, layers: FrameLayers, image: ImageCells
    ) -> KernelSet | None:
        """Return the last frame's kernels if they are for the same state.

        Another renderer of this context may have overwritten them, because it uses
        buffers of the same names; None is returned then, too.
        """
        key = (handle, layers, image)
        if not self._gpu.is_owner(self._memory, self):
            return None
        if self._made_for is None or any(
            a is not b for a, b in zip(self._made_for, key, strict=True)
        ):
            return None
        return self._set

    def kernels(
        self,
        handle: GlStore,
        layers: FrameLayers,
        image: ImageCells,
        used: NDArray[np.bool_],
        timer: StageTimer,
        fill: Fill,
    ) -> KernelSet:
        """Return kernels for all used pairs (n_cells, n_intervals)."""
        cached = self.cached(handle, layers, image)
        if cached is not None and not cached.lacks(used):
            return cached
        self._made_for = None  # remains None if the following fails
        with timer.wall("psf_plan_ms"):
            planned = None
            if (
                cached is not None
            ):  # the next frame may use the last frame's pairs again
                planned = _plan_or_none(
                    handle.store, layers, image, used | cached.available, fill
                )
            plan = planned or _plan(handle.store, layers, image, used, fill)
            pages = handle.sync()
            tables = kernel_tables(plan.kernels, plan.levels, used.shape)
        with timer.stage("psf_blend_ms"):
            self._set = self._blend(plan, tables, pages)
        self._made_for = (handle, layers, image)
        return self._set

    def _blend(self, plan: "_Plan", tables: KernelTables, pages: Pages) -> KernelSet:
        gpu = self._gpu
        node_atlas = gpu.atlas("nodes", tables.node_texel_count)
        gpu.claim(self._memory, self)
        atlas = gpu.atlas(self._memory, plan.levels.texel_count)
        memory = gpu.upload(f"KERNELS {self._slot}", tables.words)
        parts = {
            name: BufferPart(memory, _WORD_BYTES * first, _WORD_BYTES * count)
            for name, (first, count) in tables.parts.items()
        }

        def run(name: str, work: str, *bindings: str, **options: Any) -> None:
            count = tables.parts[work][1] // 2
            if not count:
                return
            gpu.passes.dispatch(
                name,
                dispatch_grid(count),
                buffers={"WORK": parts[work], **{key: parts[key] for key in bindings}},
                uniforms={"group_count": count, **options.pop("uniforms", {})},
                **options,
            )

        run(
            *("blend_psfs", NODE_WORK, "NODES", "RECIPES"),
            images={"NODES": node_atlas},
            textures={"STORE": pages},
        )
        run(
            *("blend_cells", LEVEL_WORK[0], "NODES", "PARTS", "KERNELS"),
            images={"ATLAS": atlas},
            textures={"NODES": node_atlas},
        )
        for level, work in enumerate(LEVEL_WORK[1:], start=1):
            run(
                *("merge_psfs", work, "KERNELS"),
                images={"ATLAS": atlas},
                uniforms={"level": level},
            )
        cached = {name: parts[name] for name in ("KERNELS", "KERNEL_OF")}
        return KernelSet(
            plan.kernels, plan.levels.texel_count, cached, atlas, plan.used
        )


@dataclass(frozen=True)
class _Plan:
    """Kernels of used pairs, and their sizes."""

    used: NDArray[np.bool_]
    kernels: FrameKernels
    levels: KernelLevels


def _plan(
    store: PsfStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
    fill: Fill,
) -> _Plan:
    """Plan the kernels of pairs.

    Raises
    ------
    KernelsTooLarge
        There are too many texels, and larger cells are possible.
    """
    kernels = frame_kernels(store, layers, image, used, fill=fill)
    levels = kernel_levels(kernels)
    check_texels(int(levels.sizes[:, 0].sum()), image, store.spec)
    if levels.texel_count > MAX_KERNEL_TEXELS and can_coarsen(image):
        raise KernelsTooLarge(
            f"the frame's kernels have {levels.texel_count} texels; expected at most "
            f"{MAX_KERNEL_TEXELS}",
        )
    return _Plan(used, kernels, levels)


def _plan_or_none(*arguments: Any) -> _Plan | None:
    try:
        return _plan(*arguments)
    except KernelsTooLarge:
        return None


def words_per_cell(layers: FrameLayers) -> int:
    """Return the number of words with the bits of a cell's intervals.

    Raises
    ------
    GridTooLarge
        There are more than `MAX_LAYERS`.
    """
    if len(layers.layer_dpt) > MAX_LAYERS:
        raise GridTooLarge(
            f"{len(layers.layer_dpt)} layers between "
            f"{layers.layer_dpt[0]:g} and {layers.layer_dpt[-1]:g} dpt",
            allowed=f"{MAX_LAYERS} layers: a smaller pupil or fewer pixels per degree",
        )
    return -(-interval_count(layers) * USED_PARTS // BITS_PER_WORD)
