"""The passes of one frame or strip of it: what runs when, on which buffers."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BIN_TILES,
    BYTES_PER_WORD,
    HALVES_PER_WORD,
    MAX_LEVEL,
    PAPER_SORT_KEY_BITS,
    RGB,
    SORT_CAPACITIES,
    SORT_KEY_BITS,
    THREADS,
    TILE_SIZE_PX,
    TILES_PER_BIN,
    TOTAL_WORDS,
)
from filter_service.gl.gpu import Buffer, Gpu, StageTimer
from filter_service.psfs.store import FrameLayers
from filter_service.rendering import list_bands
from filter_service.rendering.frame import View
from filter_service.rendering.image_cells import ImageCells
from filter_service.rendering.kernel_passes import (
    KernelSet,
    used_pairs,
    words_per_cell,
)

SOFTWARE_PIXELS_PER_THREAD = 8
"""2.8 times the evaluations per second of 1 on llvmpipe (8 float lanes)."""

SOFTWARE_LIST_THREADS = 8
"""Threads that make and sort a bin's list on a software renderer: one vector."""


COLOR_VARIANTS = {
    "uint8": None,
    "float32": {"COLOR_IS_LINEAR": 1},
    "float16": {"COLOR_IS_HALF": 1},
}
"""How `build_fragments` reads colour, by its dtype."""

ENCODERS = {
    "srgb8": ("encode_srgb", BYTES_PER_WORD, np.uint8),
    "linear16": ("encode_half", HALVES_PER_WORD, np.float16),
}
"""Outputs that are packed on the GPU: pass, pixels a thread (for RGB words), dtype."""


def group_count(count: int, size: int) -> int:
    """Return how many groups of a size hold a count."""
    return (count + size - 1) // size


class FramePasses:
    """The passes of one strip, in order; buffers are the context's named ones.

    Parameters
    ----------
    view : View
        The strip, with depth filled in; 0 in its hidden depth is nothing.
    layers : FrameLayers
    image : ImageCells
        Cells of the whole frame.
    surface_count : int, optional
        Surfaces whose fragments lie one behind the other in the blocks; those of the
        view unless a test makes blocks of its own.
    first_row : int
        Of the strip within the frame.
    frame_pixel_count : int, optional
        Of the whole frame, where it is larger than the strip.
    image_size_px : (width, height), optional
        Of the whole image, where the frame has a border around it.
    border_px : int
        Columns and rows around the image.
    white_level : float
        Light against which the contrast of a merged quad counts.
    """

    def __init__(
        self,
        gpu: Gpu,
        view: View,
        timer: StageTimer,
        *,
        layers: FrameLayers,
        image: ImageCells,
        paper_rule: bool,
        merge: bool,
        surface_count: int | None = None,
        first_row: int = 0,
        frame_pixel_count: int | None = None,
        image_size_px: tuple[int, int] | None = None,
        border_px: int = 0,
        white_level: float = 1.0,
    ):
        self.gpu = gpu
        self.view = view
        self.paper_rule = paper_rule
        self.merge = merge
        self.timer = timer
        self.size = (view.width_px, view.height_px)
        self.pixel_count = view.width_px * view.height_px
        self.grid = tuple(group_count(side, TILE_SIZE_PX) for side in self.size)
        self.tile_count = self.grid[0] * self.grid[1]
        self.surface_count = surface_count or view.surface_count
        self.block_count = self.surface_count * self.tile_count
        self.bin_grid = tuple(group_count(side, BIN_TILES) for side in self.grid)
        self.bin_count = self.bin_grid[0] * self.bin_grid[1]
        self.buffers: dict[str, Buffer] = {}
        self.layers = layers
        self.image = image
        self.first_row = first_row
        self.scan = (
            first_row * view.width_px,
            frame_pixel_count or self.pixel_count,
        )
        self.image_size_px = image_size_px or self.size
        self.border_px = border_px
        self.white_level = white_level
        self.lists = list_bands.ListTotals()
        self.kernel_count = 0
        self.kernel_texel_count = 0

    def _reserve(self, **n_bytes: int) -> None:
        for name, size in n_bytes.items():
            self.buffers[name] = self.gpu.storage(name, size)

    def _run(
        self, name: str, groups: tuple[int, ...], *bindings: str, **uniforms
    ) -> None:
        defines = uniforms.pop("defines", None)
        textures = uniforms.pop("textures", None)
        self.gpu.dispatch(
            name,
            groups,
            buffers={binding: self.buffers[binding] for binding in bindings},
            uniforms=uniforms,
            defines=defines,
            textures=textures,
        )

    def upload(self) -> None:
        """Send the strip; bytes are padded to whole words."""
        colors, depths_m = self.view.surface_colors, self.view.surface_depths_m
        with self.timer.stage("upload_ms"):
            n_bytes = sum(color.nbytes for color in colors)
            n_bytes = group_count(n_bytes, BYTES_PER_WORD) * BYTES_PER_WORD
            self._reserve(COLOR_IN=n_bytes)
            self.buffers["COLOR_IN"] = self.gpu.upload("COLOR_IN", *colors)
            self.buffers["DEPTH_IN"] = self.gpu.upload("DEPTH_IN", *depths_m)

    def run(self, kernels: Callable[[NDArray[np.bool_]], KernelSet]) -> None:
        """Filter the strip; `read_back` fetches the picture.

        Parameters
        ----------
        kernels : callable
            From the used (cell, interval) pairs to the kernels for them.
        """
        self.upload()
        self.merge_fragments(kernels(self.build_fragments()))
        self.count_bins()
        self.splat_bands()

    def build_fragments(self) -> NDArray[np.bool_]:
        """Linear light, dioptres and layers; returns the used pairs."""
        n_words = words_per_cell(self.layers)
        used = np.zeros((self.image.count, n_words), np.uint32)
        n_pixels = self.surface_count * self.pixel_count
        self._reserve(PIXELS=16 * n_pixels, PIXEL_LAYER=4 * n_pixels)
        self.buffers["LAYER_DPT"] = self.gpu.upload(
            "LAYER_DPT", self.layers.layer_dpt.astype(np.float32)
        )
        change_dpt = self.layers.field.at(
            self.image.corner_h_deg, self.image.corner_v_deg
        )
        self.buffers["FIELD_DEFOCUS"] = self.gpu.upload(
            "FIELD_DEFOCUS", change_dpt.astype(np.float32)
        )
        self.buffers["USED"] = self.gpu.upload("USED", used)
        with self.timer.stage("fragments_ms"):
            self._run(
                "build_fragments",
                (*self.grid, self.surface_count),
                *("COLOR_IN", "DEPTH_IN", "LAYER_DPT", "FIELD_DEFOCUS"),
                *("PIXELS", "PIXEL_LAYER", "USED"),
                **self._common,
                words_per_cell=n_words,
                tangents=self.view.tangents,
                object_range_dpt=self.layers.object_range_dpt,
                depth_is_planar=int(self.view.depth_kind == "planar"),
                blur_px_per_dpt=self.layers.blur_px_per_dpt,
                defines=COLOR_VARIANTS[self.view.color.dtype.name],
            )
        with self.timer.wall("psf_plan_ms"):
            words = self.gpu.read(self.buffers["USED"], used.shape, np.uint32)
            return used_pairs(words, self.layers)

    @property
    def _common(self) -> dict:
        return {
            "frame_size_px": self.size,
            "layer_count": len(self.layers.layer_dpt),
            "cell_px": self.image.cell_px,
            "cell_columns": self.image.grid[0],
            "first_row": self.first_row,
            "border_px": self.border_px,
            "image_size_px": self.image_size_px,
        }

    def merge_fragments(self, kernels: KernelSet) -> None:
        """Merge pixels into fragments, in blocks."""
        slots = self.block_count * THREADS
        largest_reach_px = int(kernels.kernels.reach_px.max()) + 1.5
        self.buffers.update(kernels.buffers)
        self.kernel_count = kernels.kernels.count
        self.kernel_texel_count = kernels.texel_count
        self._reserve(
            FRAGMENT_COLOR=16 * slots,
            FRAGMENT_PLACE=16 * slots,
            BLOCKS=16 * self.block_count,
        )
        for surface in range(self.surface_count):
            with self.timer.stage("merge_ms"):
                self._run(
                    "merge_fragments",
                    self.grid,
                    *("PIXELS", "PIXEL_LAYER", "KERNELS", "KERNEL_OF"),
                    *("FRAGMENT_COLOR", "FRAGMENT_PLACE", "BLOCKS"),
                    **self._common,
                    blur_px_per_dpt=self.layers.blur_px_per_dpt,
                    max_level=self._max_level,
                    white_level=self.white_level,
                    paper_order=int(self.paper_rule),
                    scan_px=self.scan,
                    surface=surface,
                    largest_reach_px=largest_reach_px,
                )
        self.search_blocks = min(
            group_count(int(np.ceil(largest_reach_px)), TILE_SIZE_PX), max(self.grid)
        )

    def count_bins(self) -> None:
        """Lengths and offsets of the lists, and the bands they are made in."""
        self._reserve(
            BIN_COUNTS=16 * self.bin_count,
            WINDOWS=16 * self.bin_count,
            BIN_OFFSETS=4 * (self.bin_count + TOTAL_WORDS),
        )
        with self.timer.stage("bin_ms"):
            self._run(
                "count_bins",
                self.bin_grid,
                *("FRAGMENT_PLACE", "BLOCKS", "WINDOWS", "BIN_COUNTS"),
                **self._walk,
                order_always=int(self.paper_rule),
                defines=self._list_threads,
            )
            self._run(
                "scan_bins",
                (1, 1),
                *("BIN_COUNTS", "BIN_OFFSETS"),
                bin_count=self.bin_count,
            )
        with self.timer.wall("plan_ms"):
            self.bands = self._plan_bands()

    @property
    def _walk(self) -> dict:
        """Uniforms of common/binning.glsl, and where a list ends."""
        return {
            "tile_grid": self.grid,
            "search_blocks": self.search_blocks,
            "surface_count": self.surface_count,
            "list_capacity": self._list_limit,
        }

    @property
    def _list_limit(self) -> int:
        """Entries of a band, and of the longest list that is kept."""
        fit = self.gpu.max_block_bytes // list_bands.ENTRY_BYTES
        return min(list_bands.MAX_BAND_ENTRIES, fit)

    def _plan_bands(self) -> list[tuple[int, int, int]]:
        """Bands as (first bin, bin count, entries)."""
        words = self.buffers["BIN_OFFSETS"].read(
            4 * TOTAL_WORDS, offset=4 * self.bin_count
        )
        self.lists = list_bands.read_totals(words)
        limit = self._list_limit
        if self.lists.entry_count <= limit and self.bin_count <= list_bands.MAX_GROUPS:
            return [(0, self.bin_count, self.lists.entry_count)]
        counts = self.gpu.read(
            self.buffers["BIN_COUNTS"], (self.bin_count, 4), np.uint32
        )[:, 0].astype(np.int64)
        offsets, bands = list_bands.split(counts, limit)
        self.buffers["BIN_OFFSETS"].write(offsets.astype(np.uint32))
        return bands

    def reserve_lists(self) -> None:
        """Buffers for the lists of the longest band."""
        n_bytes = list_bands.ENTRY_BYTES * max(entries for _, _, entries in self.bands)
        self._reserve(ENTRIES=n_bytes)
        needs_spare = self.lists.longest > SORT_CAPACITIES[-1]
        self._reserve(ENTRIES_SPARE=n_bytes if needs_spare else 0)

    def splat_bands(self) -> None:
        """Scatter, sort and splat, band by band."""
        self.reserve_lists()
        self._reserve(COLOR_OUT=16 * self.pixel_count)
        for first_bin, bin_count, _ in self.bands:
            self.make_lists(first_bin, bin_count)
            self._splat(first_bin, bin_count)

    def make_lists(self, first_bin: int, bin_count: int) -> None:
        """Scatter and sort the lists of a band."""
        with self.timer.stage("bin_ms"):
            self._run(
                "scatter_fragments",
                (bin_count, 1),
                *("FRAGMENT_PLACE", "BLOCKS", "WINDOWS", "BIN_OFFSETS", "ENTRIES"),
                **self._walk,
                bin_columns=self.bin_grid[0],
                first_bin=first_bin,
                defines=self._list_threads,
            )
        with self.timer.stage("sort_ms"):
            self._sort(first_bin, bin_count)

    def _splat(self, first_bin: int, bin_count: int) -> None:
        with self.timer.stage("splat_ms"):
            self._run(
                "splat_tiles",
                (TILES_PER_BIN, bin_count),
                *("FRAGMENT_COLOR", "FRAGMENT_PLACE", "BIN_COUNTS", "BIN_OFFSETS"),
                *("ENTRIES", "KERNELS", "PIXELS", "COLOR_OUT"),
                textures={"ATLAS": self.gpu.atlas("kernels", 1)},
                frame_size_px=self.size,
                tile_grid=self.grid,
                bin_columns=self.bin_grid[0],
                first_bin=first_bin,
                blur_px_per_dpt=self.layers.blur_px_per_dpt,
                defines=self._splat_variant(),
            )

    def _sort(self, first_bin: int, bin_count: int) -> None:
        """Sort the lists of a band, a size class at a time.

        A frame of one bin meets every class, so that a warm-up compiles them all.
        """
        key_bits = PAPER_SORT_KEY_BITS if self.paper_rule else SORT_KEY_BITS
        longest_before = 1
        for capacity in (*SORT_CAPACITIES, 0):
            if self.lists.longest <= longest_before and bin_count > 1:
                return
            spare = () if capacity else ("ENTRIES_SPARE",)
            self._run(
                "sort_bins",
                (bin_count, 1),
                *("FRAGMENT_COLOR", "BIN_COUNTS", "BIN_OFFSETS", "ENTRIES", *spare),
                longest_before=longest_before,
                first_bin=first_bin,
                defines={
                    **self._list_threads,
                    **self._rule,
                    "CAPACITY": capacity,
                    "KEY_BITS": key_bits,
                },
            )
            longest_before = capacity

    @property
    def _rule(self) -> dict[str, int]:
        return {"PAPER_RULE": 1} if self.paper_rule else {}

    @property
    def _list_threads(self) -> dict[str, int]:
        software = self.gpu.is_software
        return {"GROUP_THREADS": SOFTWARE_LIST_THREADS if software else THREADS}

    def _splat_variant(self) -> dict[str, int]:
        pixels = SOFTWARE_PIXELS_PER_THREAD if self.gpu.is_software else 1
        rows = TILE_SIZE_PX // pixels
        return {"PIXELS_PER_THREAD": pixels, "GROUP_ROWS": rows, **self._rule}

    def read_back(self, output: str) -> NDArray:
        """Fetch the filtered picture, encoded as asked."""
        width, height = self.size
        if output == "linear":
            with self.timer.wall("readback_ms"):
                pixels = self.gpu.read(
                    self.buffers["COLOR_OUT"], (height, width, 4), np.float32
                )
                return np.ascontiguousarray(pixels[..., :RGB])
        name, pixels_per_thread, dtype = ENCODERS[output]
        with self.timer.stage("encode_ms"):
            threads = group_count(self.pixel_count, pixels_per_thread)
            self._reserve(COLOR_IN=threads * RGB * BYTES_PER_WORD)  # its light is used
            self._run(
                name,
                (group_count(threads, THREADS), 1),
                *("COLOR_OUT", "COLOR_IN"),
                pixel_count=self.pixel_count,
            )
        with self.timer.wall("readback_ms"):
            return self.gpu.read(self.buffers["COLOR_IN"], (height, width, RGB), dtype)

    @property
    def _max_level(self) -> int:
        """Level up to which fragments merge; the paper merges once."""
        if not self.merge:
            return 0
        most = 1 if self.paper_rule else MAX_LEVEL
        cell_px = self.image.cell_px
        return min(most, cell_px.bit_length() - 1) if cell_px else most

    def counts(self) -> dict[str, int]:
        """Return counts of `Rendered` by name."""
        fragment_count, merged_count = self.fragment_counts()
        return {
            "fragment_count": fragment_count,
            "merged_count": merged_count,
            "entry_count": self.lists.entry_count,
            "overflow_count": self.lists.overflow_count,
            "kernel_count": self.kernel_count,
            "kernel_texel_count": self.kernel_texel_count,
        }

    def fragment_counts(self) -> tuple[int, int]:
        """Fragments after merging, and pixels that went into merged ones."""
        blocks = self.gpu.read(self.buffers["BLOCKS"], (self.block_count, 4), np.uint32)
        return int(blocks[:, 0].sum()), int(blocks[:, 3].sum())
