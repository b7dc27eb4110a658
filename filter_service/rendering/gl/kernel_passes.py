"""Passes that plan and blend the kernels of an eye from its cached PSFs.

The GPU itself finds which kernels a frame uses, so no frame waits for the CPU.  While
the state of the eye stays, kernels are kept, and frames add those that they lack.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BITS_PER_WORD,
    CELL_WORDS,
    DISPATCH_BYTES,
    FIELD_CORNERS,
    KERNEL_WORDS,
    MAX_LAYERS,
    MAX_LEVEL,
    NODE_WORDS,
    PART_WORDS,
    PLAN_BASE_TEXELS,
    PLAN_FOR_KERNELS,
    PLAN_FOR_NODES,
    PLAN_FOR_WORK,
    PLAN_KERNELS,
    PLAN_NODE_TEXELS,
    PLAN_NODES,
    PLAN_OLD_NODES,
    PLAN_OVERFLOWS,
    PLAN_TEXELS,
    PLAN_WORDS,
    READ_WORDS,
    RECIPE_WORDS,
    RGB,
    STAT_LANES,
    STAT_WORDS,
    THREADS,
)
from filter_service.errors import GridTooLarge
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Atlas, Buffer, BufferPart, Pages
from filter_service.gl.stage_timer import Timer
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.frame_kernels import Fill, interval_count
from filter_service.rendering.gl.gl_store import GlStore
from filter_service.rendering.gl.strip import dispatch_grid, group_count
from filter_service.rendering.image_cells import (
    ImageCells,
    KernelsTooLarge,
    can_coarsen,
    check_texels,
)

MAX_KERNEL_TEXELS = 24 * 2**20
"""Largest texel count of a frame's kernels: 400 MB at 16 bytes per texel."""

FIRST_RECORDS = 2**14
FIRST_TEXELS = 2**20
"""Initial capacity: kernels and node kernels, and the texels of each."""

HEADROOM = 1.25
"""Capacity relative to the need of the frame that did not fit."""

WORK_LISTS = MAX_LEVEL + 2

SOFTWARE_THREADS = 8
"""Threads per work group of the plans on a software renderer: one vector."""

_WORD_BYTES = 4
_UVEC4_BYTES = 16


class FrameState(NamedTuple):
    """State of the eye that the kernels of a frame belong to.

    Attributes
    ----------
    layers : FrameLayers
    image : ImageCells
    change_dpt : (rows + 1, columns + 1), float32
        Change of defocus at the corners of the cells.
    """

    layers: FrameLayers
    image: ImageCells
    change_dpt: NDArray[np.float32]


@dataclass(frozen=True)
class Capacity:
    """Capacities of an eye's kernel buffers.

    Attributes
    ----------
    kernels, nodes : int
        Records of kernels and of node kernels.
    texels, node_texels : int
        Texels of their atlases.
    """

    kernels: int
    nodes: int
    texels: int = FIRST_TEXELS
    node_texels: int = FIRST_TEXELS

    @property
    def work_items(self) -> int:
        """Items of a work list: one for each kernel is partly filled."""
        texels = max(self.texels, self.node_texels)
        return texels // THREADS + max(self.kernels, self.nodes)


class KernelPasses:
    """Kernels of one eye on the GPU.

    Parameters
    ----------
    gpu : Gpu
    slot : int
        Number of this instance in its context; each has its own memory.
    """

    def __init__(self, gpu: Gpu, slot: int = 0) -> None:
        self.gpu, self._slot = gpu, slot
        self._memory = f"kernels {slot}"
        self._capacity = Capacity(1, 1)
        self._buffers: dict[str, Buffer | BufferPart] = {}
        self._cells_of: ImageCells | None = None
        self.reset()

    def reset(self) -> None:
        """Discard the kernels."""
        self._made_for: tuple[Any, ...] | None = None

    def begin(self, handle: GlStore, state: FrameState, timer: Timer) -> "KernelRun":
        """Upload the state if it has changed.

        Parameters
        ----------
        handle : GlStore
        state : FrameState
        timer : Timer
        """
        gpu, layers, image = self.gpu, state.layers, state.image
        with timer.stage("upload_ms"):
            pages, tables = handle.sync()
        is_kept = self._keeps(handle, state)
        if not is_kept:
            self._made_for = None  # remains None if the following fails
            gpu.claim(self._memory, self)
            with timer.stage("upload_ms"):
                self._upload_state(handle, state)
            self._reserve(image.count, handle.store.fields_count, layers)
            self._made_for = (handle, layers, image)
        return KernelRun(
            self,
            handle,
            state,
            timer,
            capacity=self._capacity,
            is_kept=is_kept,
            buffers={
                **self._buffers,
                **self._shared_buffers(),
                **tables,
                "STATS": gpu.storage("STATS", _WORD_BYTES * STAT_LANES * STAT_WORDS),
                "USED": gpu.storage("USED", _WORD_BYTES * used_word_count(state)),
            },
            atlas=gpu.atlas(self._memory, self._capacity.texels),
            node_atlas=gpu.atlas(f"nodes {self._slot}", self._capacity.node_texels),
            pages=pages,
        )

    def _keeps(self, handle: GlStore, state: FrameState) -> bool:
        """Return whether the kernels in memory belong to a state.

        Another renderer of this context may have overwritten them, because it uses
        buffers of the same names.
        """
        if self._made_for is None or not self.gpu.is_owner(self._memory, self):
            return False
        key = (handle, state.layers, state.image)
        return all(a is b for a, b in zip(self._made_for, key, strict=True))

    def _upload_state(self, handle: GlStore, state: FrameState) -> None:
        layers, reads = state.layers, state.layers.reads
        records = np.empty((reads.groups.size, READ_WORDS), np.uint32)
        records[:, 0] = reads.groups
        numbers = np.stack([reads.scales, reads.weights], axis=-1)
        records[:, 1:] = numbers.astype(np.float32).view(np.uint32)
        self._buffers |= self.gpu.upload_parts(
            f"state {self._slot}",
            LAYER_DPT=layers.layer_dpt.astype(np.float32),
            FIELD_DEFOCUS=state.change_dpt,
            NODE_DEFOCUS=layers.layer_zero_dpt.astype(np.float32),
            READS=records,
        )
        name, image = f"cells {self._slot}", state.image
        if self.gpu.is_owner(name, self) and self._cells_of is image:
            return
        self.gpu.claim(name, self)
        self._buffers["CELLS"] = self.gpu.upload(name, cell_records(image))
        self._cells_of = image

    def _reserve(self, n_cells: int, n_fields: int, layers: FrameLayers) -> None:
        """Allocate the buffers of a plan, at least for the first kernels."""
        pairs, node_pairs = (n * interval_count(layers) for n in (n_cells, n_fields))
        old = self._capacity
        new = self._capacity = replace(
            old,
            kernels=max(old.kernels, min(pairs, FIRST_RECORDS)),
            nodes=max(old.nodes, min(node_pairs, FIRST_RECORDS)),
        )
        own = {  # kept between frames, so each eye has its own
            "PLAN": _WORD_BYTES * PLAN_WORDS,
            "KERNEL_OF": _WORD_BYTES * pairs,
            "NODE_OF": _WORD_BYTES * node_pairs,
            "KERNELS": _UVEC4_BYTES * KERNEL_WORDS * new.kernels,
            "NODES": _UVEC4_BYTES * NODE_WORDS * new.nodes,
        }
        for name, size in own.items():
            self._buffers[name] = self.gpu.storage(f"{name} {self._slot}", size)

    def _shared_buffers(self) -> dict[str, Buffer]:
        """Return the buffers that are used within a frame, so all eyes share them."""
        capacity = self._capacity
        sizes = {
            "KERNEL_PAIRS": 2 * _WORD_BYTES * capacity.kernels,
            "NODE_PAIRS": 2 * _WORD_BYTES * capacity.nodes,
            "PARTS": _UVEC4_BYTES * PART_WORDS * capacity.kernels,
            "RECIPES": _WORD_BYTES * 2 * RGB * RECIPE_WORDS * capacity.nodes,
            "WORK": 2 * _WORD_BYTES * WORK_LISTS * capacity.work_items,
        }
        return {name: self.gpu.storage(name, size) for name, size in sizes.items()}

    def grow(self, counts: NDArray[np.uint32], headroom: float = HEADROOM) -> None:
        """Enlarge the buffers to a multiple of a plan's counters, if necessary."""

        def enlarged(capacity: int, index: int) -> int:
            count = int(counts[index])
            return max(capacity, int(headroom * count) + 1)

        old = self._capacity
        self._capacity = Capacity(
            kernels=enlarged(old.kernels, PLAN_KERNELS),
            nodes=enlarged(old.nodes, PLAN_NODES),
            texels=enlarged(old.texels, PLAN_TEXELS),
            node_texels=enlarged(old.node_texels, PLAN_NODE_TEXELS),
        )
        self.reset()


@dataclass
class KernelRun:
    """Planning and blending of one frame's kernels.

    Parameters
    ----------
    is_kept : bool
        Whether the kernels of frames before are in memory.
    buffers : dict
        Buffers by binding.
    atlas, node_atlas : Atlas
        Texels of kernels and of node kernels.
    pages : Pages
        Cached PSFs.

    Attributes
    ----------
    counts : (PLAN_WORDS,), uint32
        Counters, after the readback.
    read_words : (n,), uint32
        A bit for each PSF that new kernels read, after the readback.
    """

    owner: KernelPasses
    handle: GlStore
    state: FrameState
    timer: Timer
    capacity: Capacity
    is_kept: bool
    buffers: dict[str, Buffer | BufferPart]
    atlas: Atlas
    node_atlas: Atlas
    pages: Pages

    def __post_init__(self) -> None:
        """Allocate the arrays of the readback."""
        n_read = group_count(self.handle.store.psf_count, BITS_PER_WORD)
        self.counts = np.zeros(PLAN_WORDS, np.uint32)
        self.read_words = np.zeros(n_read, np.uint32)
        self.buffers["READ_PSFS"] = self.owner.gpu.storage(
            "READ_PSFS", self.read_words.nbytes
        )

    @property
    def uniforms(self) -> dict[str, Any]:
        """Uniforms that depend on the state of the eye, of all passes of a frame."""
        layers = self.state.layers
        intervals = interval_count(layers)
        return {
            "used_words": used_word_count(self.state),
            "words_per_cell": words_per_cell(layers),
            "read_words": self.read_words.size,
            "pair_count": self.state.image.count * intervals,
            "node_pair_count": self.handle.store.fields_count * intervals,
            "is_new": int(not self.is_kept),
            "layer_count": len(layers.layer_dpt),
            "neighbor_count": layers.reads.groups.size,
            "merge_spread_px": layers.merge_spread_px,
            "blur_px_per_dpt": layers.blur_px_per_dpt,
        }

    @property
    def group_counts(self) -> tuple[int, int]:
        """Work groups of the passes that clear a plan and list its kernels.

        They are rounded, so that only few states have separate numbers.
        """
        uniforms = self.uniforms
        used_words = uniforms["used_words"]
        sizes = [used_words, self.read_words.size, STAT_LANES * STAT_WORDS, PLAN_WORDS]
        if not self.is_kept:
            sizes += [uniforms["pair_count"], uniforms["node_pair_count"]]
        return (
            rounded_up(group_count(max(sizes), THREADS)),
            rounded_up(group_count(used_words, THREADS)),
        )

    def clear(self) -> None:
        """Clear the marks and counters of a frame."""
        with self.timer.stage("kernel_plan_ms"):
            self._run(
                "begin_plan",
                *("PLAN", "USED", "STATS", "READ_PSFS", "KERNEL_OF", "NODE_OF"),
                groups=dispatch_grid(self.group_counts[0]),
                **self._uniforms_of("used_words", "read_words", "pair_count"),
                **self._uniforms_of("node_pair_count", "is_new"),
            )

    def _uniforms_of(self, *names: str) -> dict[str, Any]:
        uniforms = self.uniforms
        return {name: uniforms[name] for name in names}

    def make(self) -> None:
        """Plan and blend the kernels that the marked pairs lack."""
        capacity = self.capacity
        software = self.owner.gpu.is_software
        group = {"GROUP_THREADS": SOFTWARE_THREADS if software else THREADS}
        with self.timer.stage("kernel_plan_ms"):
            self._run(
                "list_kernels",
                *("USED", "CELLS", "KERNEL_OF", "KERNEL_PAIRS"),
                *("NODE_OF", "NODE_PAIRS", "PLAN"),
                groups=dispatch_grid(self.group_counts[1]),
                **self._uniforms_of("used_words", "words_per_cell", "layer_count"),
                kernel_capacity=capacity.kernels,
                node_capacity=capacity.nodes,
            )
            self._run(
                "plan_nodes",
                *("NODE_PAIRS", "LAYER_DPT", "NODE_DEFOCUS", "READS"),
                *("STORE_VALUES", "STORE_STARTS", "STORE_SHIFTS", "STORE_PSFS"),
                *("RECIPES", "NODES", "WORK", "READ_PSFS", "PLAN"),
                dispatch=PLAN_FOR_NODES,
                defines=group,
                **self._uniforms_of("layer_count", "neighbor_count"),
                node_capacity=capacity.nodes,
                texel_capacity=capacity.node_texels,
                work_capacity=capacity.work_items,
            )
            self._run(
                "plan_kernels",
                *("KERNEL_PAIRS", "CELLS", "NODE_OF", "NODES"),
                *("KERNELS", "PARTS", "WORK", "PLAN"),
                dispatch=PLAN_FOR_KERNELS,
                defines=group,
                **self._uniforms_of("layer_count", "merge_spread_px"),
                kernel_capacity=capacity.kernels,
                texel_capacity=capacity.texels,
                work_capacity=capacity.work_items,
            )
        with self.timer.stage("psf_blend_ms"):
            self._blend(
                0,
                "blend_psfs",
                *("NODES", "RECIPES"),
                images={"NODES": self.node_atlas},
                textures={"STORE": self.pages},
            )
            self._blend(
                1,
                "blend_cells",
                *("NODES", "PARTS", "KERNELS"),
                images={"ATLAS": self.atlas},
                textures={"NODES": self.node_atlas},
            )
            for level in range(1, MAX_LEVEL + 1):
                images = {"ATLAS": self.atlas}
                self._blend(
                    1 + level, "merge_psfs", "KERNELS", images=images, level=level
                )

    def _blend(self, work_list: int, name: str, *bindings: str, **options: Any) -> None:
        self._run(
            name,
            *(*bindings, "WORK", "PLAN"),
            dispatch=PLAN_FOR_WORK + work_list,
            work_list=work_list,
            work_capacity=self.capacity.work_items,
            **options,
        )

    def _run(
        self,
        name: str,
        *bindings: str,
        groups: tuple[int, ...] = (1, 1),
        dispatch: int | None = None,
        defines: dict[str, int] | None = None,
        images: dict[str, Any] | None = None,
        textures: dict[str, Any] | None = None,
        **uniforms: Any,
    ) -> None:
        plan = self.buffers["PLAN"]
        assert isinstance(plan, Buffer)
        indirect = (
            None if dispatch is None else ("PLAN", plan, DISPATCH_BYTES * dispatch)
        )
        self.owner.gpu.passes.dispatch(
            name,
            groups,
            buffers={binding: self.buffers[binding] for binding in bindings},
            uniforms=uniforms,
            defines=defines,
            images=images,
            textures=textures,
            indirect=indirect,
        )

    def to_read(
        self, stats: NDArray[np.uint32]
    ) -> list[tuple[Buffer, int, NDArray[Any]]]:
        """Return the buffers for `Gpu.begin_read`, including the frame's counters."""
        targets = {"STATS": stats, "PLAN": self.counts, "READ_PSFS": self.read_words}
        found = []
        for name, target in targets.items():
            buffer = self.buffers[name]
            assert isinstance(buffer, Buffer)
            found.append((buffer, 0, target))
        return found

    def is_complete(self, fill: Fill) -> bool:
        """Return whether the frame had all its kernels, after the readback.

        Otherwise this computes missing PSFs or enlarges buffers, and the frame must be
        filtered again.

        Parameters
        ----------
        fill : callable
            Function that computes missing PSFs, or some of them.

        Raises
        ------
        KernelsTooLarge
            There are too many texels, and larger cells are possible.
        """
        store, counts = self.handle.store, self.counts
        if counts[PLAN_NODES] > counts[PLAN_OLD_NODES]:
            psfs = marked(self.read_words)
            store.frame_number += 1
            store.tables.last_used[psfs] = store.frame_number
            missing = psfs[~store.tables.is_computed[psfs]]
            if missing.size:
                self.owner.reset()  # recipes lack these PSFs
                fill(missing)
                return False
        image, spec = self.state.image, store.spec
        try:
            check_texels(int(counts[PLAN_BASE_TEXELS]), image, spec)
            if counts[PLAN_TEXELS] > MAX_KERNEL_TEXELS and can_coarsen(image):
                raise KernelsTooLarge(
                    f"the frame's kernels have {counts[PLAN_TEXELS]} texels; expected "
                    f"at most {MAX_KERNEL_TEXELS}",
                )
        except KernelsTooLarge:
            self.owner.reset()
            if self.is_kept:  # without kernels of earlier frames, they may fit
                return False
            raise
        if counts[PLAN_OVERFLOWS]:
            if self.is_kept:
                self.owner.reset()
            else:
                self.owner.grow(counts)
            return False
        return True

    def keep_headroom(self, ratio: float) -> None:
        """Keep the buffers larger than the frame required, for frames that need more.

        Parameters
        ----------
        ratio : float
            Least capacity, relative to the use.
        """
        counts, capacity = self.counts, self.capacity
        needs = {
            PLAN_KERNELS: capacity.kernels,
            PLAN_NODES: capacity.nodes,
            PLAN_TEXELS: capacity.texels,
            PLAN_NODE_TEXELS: capacity.node_texels,
        }
        if all(ratio * int(counts[index]) <= size for index, size in needs.items()):
            return
        if self.is_kept:
            self.owner.reset()  # without the kernels of frames before
        else:
            self.owner.grow(counts, headroom=HEADROOM * ratio)

    def frame_counts(self) -> dict[str, int]:
        """Return the counts of `ViewResult` by name, after the readback."""
        return {
            "kernel_count": int(self.counts[PLAN_KERNELS]),
            "kernel_texel_count": int(self.counts[PLAN_TEXELS]),
        }


def rounded_up(count: int) -> int:
    """Return a number from count to 5/4 of it, one of four between powers of two."""
    step = 1 << max(count.bit_length() - 3, 0)
    return -(-count // step) * step


def marked(words: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Return the numbers (n,) of the bits that are set in words."""
    return np.flatnonzero(np.unpackbits(words.view(np.uint8), bitorder="little"))


def cell_records(image: ImageCells) -> NDArray[np.uint32]:
    """Return the records (n_cells, CELL_WORDS) of cells: nodes, weights and maps."""
    count = image.count
    records = np.empty((count, CELL_WORDS), np.uint32)
    records[:, :FIELD_CORNERS] = image.nodes
    numbers = records.view(np.float32)
    numbers[:, FIELD_CORNERS : 2 * FIELD_CORNERS] = image.weight_ratio
    numbers[:, 2 * FIELD_CORNERS :] = image.maps.node_from_cell.reshape(count, -1)
    return records


def used_word_count(state: FrameState) -> int:
    """Return the number of words with a bit for each cell and interval."""
    return state.image.count * words_per_cell(state.layers)


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
    return group_count(interval_count(layers), BITS_PER_WORD)
