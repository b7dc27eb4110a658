"""The passes that make lists of fragments, order and splat them."""

import numpy as np

from filter_service.constants import (
    PAPER_SORT_KEY_BITS,
    SORT_CAPACITIES,
    SORT_KEY_BITS,
    THREADS,
    TILE_SIZE_PX,
    TILES_PER_BIN,
    TOTAL_WORDS,
)
from filter_service.rendering.gl import list_bands
from filter_service.rendering.gl.strip import Strip

SOFTWARE_PIXELS_PER_THREAD = 8
"""2.8 times the evaluations per second of 1 on llvmpipe (8 float lanes)."""

SOFTWARE_LIST_THREADS = 8
"""Threads that make and sort a bin's list on a software renderer: one vector."""


class ListPasses:
    """Lists of one strip's bins, from its fragments to light.

    Parameters
    ----------
    strip : Strip
    search_blocks : int
        How far a bin looks for fragments that reach it.
    """

    def __init__(self, strip: Strip, search_blocks: int):
        self.strip = strip
        self.search_blocks = search_blocks
        self.lists = list_bands.ListTotals()
        self.bands: list[tuple[int, int, int]] = []

    def run(self) -> None:
        """Count, list, sort and splat."""
        self.count_bins()
        self.splat_bands()

    def count_bins(self) -> None:
        """Lengths and offsets of the lists, and the bands they are made in."""
        self.strip.reserve(
            BIN_COUNTS=16 * self.strip.bin_count,
            WINDOWS=16 * self.strip.bin_count,
            BIN_OFFSETS=4 * (self.strip.bin_count + TOTAL_WORDS),
        )
        with self.strip.timer.stage("bin_ms"):
            self.strip.run(
                "count_bins",
                self.strip.bin_grid,
                *("FRAGMENT_PLACE", "BLOCKS", "WINDOWS", "BIN_COUNTS"),
                **self._walk,
                order_always=int(self.strip.paper_rule),
                defines=self._list_threads,
            )
            self.strip.run(
                "scan_bins",
                (1, 1),
                *("BIN_COUNTS", "BIN_OFFSETS"),
                bin_count=self.strip.bin_count,
            )
        with self.strip.timer.wall("plan_ms"):
            self.bands = self._plan_bands()

    @property
    def _walk(self) -> dict:
        """Uniforms of common/binning.glsl, and where a list ends."""
        return {
            "tile_grid": self.strip.grid,
            "search_blocks": self.search_blocks,
            "surface_count": self.strip.surface_count,
            "list_capacity": self._list_limit,
        }

    @property
    def _list_limit(self) -> int:
        """Entries of a band, and of the longest list that is kept."""
        fit = self.strip.gpu.max_block_bytes // list_bands.ENTRY_BYTES
        return min(list_bands.MAX_BAND_ENTRIES, fit)

    def _plan_bands(self) -> list[tuple[int, int, int]]:
        """Bands as (first bin, bin count, entries)."""
        words = self.strip.buffers["BIN_OFFSETS"].read(
            4 * TOTAL_WORDS, offset=4 * self.strip.bin_count
        )
        self.lists = list_bands.read_totals(words)
        limit = self._list_limit
        if (
            self.lists.entry_count <= limit
            and self.strip.bin_count <= list_bands.MAX_GROUPS
        ):
            return [(0, self.strip.bin_count, self.lists.entry_count)]
        counts = self.strip.gpu.read(
            self.strip.buffers["BIN_COUNTS"], (self.strip.bin_count, 4), np.uint32
        )[:, 0].astype(np.int64)
        offsets, bands = list_bands.split(counts, limit)
        self.strip.buffers["BIN_OFFSETS"].write(offsets.astype(np.uint32))
        return bands

    def reserve_lists(self) -> None:
        """Buffers for the lists of the longest band."""
        n_bytes = list_bands.ENTRY_BYTES * max(entries for _, _, entries in self.bands)
        self.strip.reserve(ENTRIES=n_bytes)
        needs_spare = self.lists.longest > SORT_CAPACITIES[-1]
        self.strip.reserve(ENTRIES_SPARE=n_bytes if needs_spare else 0)

    def splat_bands(self) -> None:
        """Scatter, sort and splat, band by band."""
        self.reserve_lists()
        self.strip.reserve(COLOR_OUT=16 * self.strip.pixel_count)
        for first_bin, bin_count, _ in self.bands:
            self.make_lists(first_bin, bin_count)
            self._splat(first_bin, bin_count)

    def make_lists(self, first_bin: int, bin_count: int) -> None:
        """Scatter and sort the lists of a band."""
        with self.strip.timer.stage("bin_ms"):
            self.strip.run(
                "scatter_fragments",
                (bin_count, 1),
                *("FRAGMENT_PLACE", "BLOCKS", "WINDOWS", "BIN_OFFSETS", "ENTRIES"),
                **self._walk,
                bin_columns=self.strip.bin_grid[0],
                first_bin=first_bin,
                defines=self._list_threads,
            )
        with self.strip.timer.stage("sort_ms"):
            self._sort(first_bin, bin_count)

    def _splat(self, first_bin: int, bin_count: int) -> None:
        with self.strip.timer.stage("splat_ms"):
            self.strip.run(
                "splat_tiles",
                (TILES_PER_BIN, bin_count),
                *("FRAGMENT_COLOR", "FRAGMENT_PLACE", "BIN_COUNTS", "BIN_OFFSETS"),
                *("ENTRIES", "KERNELS", "PIXELS", "COLOR_OUT"),
                textures={"ATLAS": self.strip.gpu.atlas("kernels", 1)},
                frame_size_px=self.strip.size,
                tile_grid=self.strip.grid,
                bin_columns=self.strip.bin_grid[0],
                first_bin=first_bin,
                blur_px_per_dpt=self.strip.layers.blur_px_per_dpt,
                defines=self._splat_variant(),
            )

    def _sort(self, first_bin: int, bin_count: int) -> None:
        """Sort the lists of a band, a size class at a time.

        A frame of one bin meets every class, so that a warm-up compiles them all.
        """
        key_bits = PAPER_SORT_KEY_BITS if self.strip.paper_rule else SORT_KEY_BITS
        longest_before = 1
        for capacity in (*SORT_CAPACITIES, 0):
            if self.lists.longest <= longest_before and bin_count > 1:
                return
            spare = () if capacity else ("ENTRIES_SPARE",)
            self.strip.run(
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
        return {"PAPER_RULE": 1} if self.strip.paper_rule else {}

    @property
    def _list_threads(self) -> dict[str, int]:
        software = self.strip.gpu.is_software
        return {"GROUP_THREADS": SOFTWARE_LIST_THREADS if software else THREADS}

    def _splat_variant(self) -> dict[str, int]:
        pixels = SOFTWARE_PIXELS_PER_THREAD if self.strip.gpu.is_software else 1
        rows = TILE_SIZE_PX // pixels
        return {"PIXELS_PER_THREAD": pixels, "GROUP_ROWS": rows, **self._rule}

    def counts(self) -> dict[str, int]:
        """Return counts of `Rendered` by name."""
        return {
            "entry_count": self.lists.entry_count,
            "overflow_count": self.lists.overflow_count,
        }
