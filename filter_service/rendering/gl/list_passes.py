"""Passes that build the fragment lists, sort them and splat the fragments."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BATCH,
    BIN_TILES,
    DISPATCH_BYTES,
    DISPATCH_COUNT,
    DISPATCH_SCATTER,
    DISPATCH_SORT,
    DISPATCH_SPLAT,
    MAX_GROUPS,
    PAPER_SORT_KEY_BITS,
    SORT_CAPACITIES,
    SORT_KEY_BITS,
    THREADS,
    TILE_KINDS,
    TILE_SIZE_PX,
    TILES_PER_BIN,
    TOTAL_ENTRIES,
    TOTAL_ENTRIES_FLOAT,
    TOTAL_LONGEST,
    TOTAL_LOST,
    TOTAL_TILES,
    TOTAL_WORDS,
)
from filter_service.gl.passes import Atlas, Buffer
from filter_service.rendering.gl.strip import Strip, group_count

ENTRY_BYTES = 4
MAX_BAND_ENTRIES = 16 * 2**20
"""Largest number of list entries in one band.  A list buffer has at most 64 MB, half of
the smallest storage block that the service supports.  This is also the capacity of
one bin's list.  A bin has fewer than 2**19 pixels within the reach of a kernel, so
entries can only be lost (and counted) if there are many surfaces or a smaller limit."""

MAX_BAND_BINS = MAX_GROUPS
"""Bins in one band: the passes dispatch a row of work groups, one for each bin."""


@dataclass(frozen=True)
class ListTotals:
    """Totals of the prefix sum over the lists.

    Attributes
    ----------
    entry_count : int
        Entries of all lists; exact below 2**32, rounded to seven digits above.
    overflow_count : int
        Entries that did not fit a bin's list.
    longest : int
        Entries of the longest list.
    tiles : tuple of int
        Number of tiles of each kind.
    """

    entry_count: int = 0
    overflow_count: int = 0
    longest: int = 0
    tiles: tuple[int, ...] = (0,) * TILE_KINDS


def read_totals(whole: NDArray[np.uint32]) -> ListTotals:
    """Return the totals from the words that follow the bins' offsets."""
    as_float = whole[TOTAL_ENTRIES_FLOAT : TOTAL_ENTRIES_FLOAT + 1].view(np.float32)
    rounded = round(float(as_float[0]))
    return ListTotals(
        entry_count=rounded if rounded > 2**31 else int(whole[TOTAL_ENTRIES]),
        overflow_count=int(whole[TOTAL_LOST]),
        longest=int(whole[TOTAL_LONGEST]),
        tiles=tuple(whole[TOTAL_TILES : TOTAL_TILES + TILE_KINDS].tolist()),
    )


def split(counts: NDArray[np.int64], limit: int) -> tuple[NDArray[np.int64], list[Any]]:
    """Divide lists into bands of at most ``limit`` entries and MAX_BAND_BINS bins.

    Returns
    -------
    offsets : (n_bins,)
        First entry of each list within its band.
    bands : list of (first bin, bin count, entries)
    """
    bands, offsets = [], np.zeros(len(counts), dtype=np.int64)
    first = 0
    while first < len(counts):
        sums = np.cumsum(counts[first : first + MAX_BAND_BINS])
        bins = max(int(np.searchsorted(sums, limit, side="right")), 1)
        offsets[first : first + bins] = sums[:bins] - counts[first : first + bins]
        bands.append((first, bins, int(sums[bins - 1])))
        first += bins
    return offsets, bands


SOFTWARE_SPLAT = {
    "PIXELS_PER_THREAD": 8,
    "GROUP_ROWS": 1,
    "FRAGMENTS_A_TURN": 1,
}
"""On llvmpipe (8 floats per vector), 2.8 times as many evaluations per second as with
one pixel per thread."""

HARDWARE_SPLAT = {
    "PIXELS_PER_THREAD": 2,
    "GROUP_ROWS": TILE_SIZE_PX // 2,
    "FRAGMENTS_A_TURN": 2,
    "BATCH": 32,
    "HIT_WORDS": 1,
}
"""One warp per tile and little shared memory, so that occupancy is high and hides the
latency of fetches.  On an H100, this is 1.4 to 1.9 times as fast as groups of 64
threads that load 128 fragments to shared memory and fetch one texel at a time."""

HARDWARE_RANGE_SLOTS = 16
"""Slots of a block per thread.  A bin has more threads than blocks in its window, so
that blocks are divided; a software renderer processes whole blocks."""

SPARE_ENTRIES = BATCH
"""Entries of a list buffer that lists never fill.  ``splat_tiles`` reads a batch of
entries up to the end of its list, but zink loads all of the batch."""

SOFTWARE_LIST_THREADS = 8
"""Threads per bin on a software renderer: one vector."""


class ListPasses:
    """Fragment lists of one strip's bins: building, sorting and splatting.

    Parameters
    ----------
    strip : Strip
    atlas : Atlas, optional
        Texels of the fragments' kernels.
    is_late : bool
        Whether the totals are read after later frames have started, so that lists are
        made once, in one band, and frames without some PSFs are shown.
    """

    def __init__(
        self, strip: Strip, atlas: Atlas | None = None, *, is_late: bool = False
    ):
        self.strip = strip
        self.atlas = atlas
        self._is_late = is_late
        self.lists = ListTotals()
        self._capacities = (0, 0)
        self.bands: list[tuple[int, int, int]] = []
        self._tile_sums = np.zeros((0, TILE_KINDS), np.int64)

    def run(self) -> None:
        """Build, sort and splat the lists in the existing buffers, without a readback.

        If the lists do not fit, the passes after the count do nothing, and
        `record_totals` returns False.
        """
        self.strip.reserve(COLOR_OUT=16 * self.strip.pixel_count)
        self.count_bins()
        if self.strip.bin_count <= MAX_BAND_BINS:
            self._make_lists_and_splat(0, self.strip.bin_count, indirect=True)

    @property
    def totals(self) -> tuple[Buffer, int]:
        """Location of the totals: buffer and offset in bytes."""
        return self.strip.buffers["BIN_OFFSETS"], 4 * self.strip.bin_count

    def record_totals(self, words: NDArray[np.uint32]) -> bool:
        """Record the totals that were read back; return whether all lists did fit.

        Otherwise `splat_bands` must run.
        """
        self.lists = read_totals(words)
        entries, spare = self._capacities
        needs_spare = self.lists.longest > SORT_CAPACITIES[-1]
        return (
            self.strip.bin_count <= MAX_BAND_BINS
            and self.lists.entry_count <= entries
            and (not needs_spare or self.lists.entry_count <= spare)
        )

    def _capacities_now(self) -> tuple[int, int]:
        """Return the capacities of the two list buffers, in entries, for a single band.

        Another frame may release these buffers before the totals of this one are read.
        """
        entries, spare = (
            min(
                self.strip.buffers[name].size // ENTRY_BYTES - SPARE_ENTRIES,
                self._list_limit,
            )
            for name in ("ENTRIES", "ENTRIES_SPARE")
        )
        return entries, spare

    def count_bins(self) -> None:
        """Compute the lengths of the lists and, by a prefix sum, their offsets."""
        self.strip.reserve(
            BIN_COUNTS=16 * self.strip.bin_count,
            WINDOWS=16 * self.strip.bin_count,
            BIN_OFFSETS=4 * (self.strip.bin_count + TOTAL_WORDS),
            TILES=4 * TILE_KINDS * self._tile_room,
            DISPATCHES=DISPATCH_BYTES * DISPATCH_COUNT,
            ENTRIES=_list_bytes(0),
            ENTRIES_SPARE=_list_bytes(0),
        )
        self._capacities = entry_capacity, spare_capacity = self._capacities_now()
        with self.strip.timer.stage("bin_ms"):
            self.strip.run(
                "count_bins",
                self.strip.bin_grid,
                *("FRAGMENT_PLACE", "BLOCKS", "WINDOWS", "BIN_COUNTS", "PLAN"),
                **self._bin_uniforms,
                order_always=int(self.strip.paper_rule),
                defines=self._list_threads,
            )
            self.strip.run(
                "scan_bins",
                (1, 1),
                *("BIN_COUNTS", "BIN_OFFSETS", "DISPATCHES", "TILES", "PLAN"),
                tile_grid=self.strip.grid,
                bin_columns=self.strip.bin_grid[0],
                bin_count=self.strip.bin_count,
                entry_capacity=entry_capacity,
                spare_capacity=spare_capacity,
                needs_all_psfs=int(not self._is_late),
            )

    @property
    def _tile_room(self) -> int:
        """Capacity of the list of the tiles of each kind."""
        return TILES_PER_BIN * self.strip.bin_count

    @property
    def _bin_uniforms(self) -> dict[str, Any]:
        """Uniforms of ``common/binning.glsl``, and the capacity of a list."""
        return {
            "tile_grid": self.strip.grid,
            "surface_count": self.strip.surface_count,
            "list_capacity": self._list_limit,
        }

    @property
    def _list_limit(self) -> int:
        """Capacity of a band, and of one list, in entries."""
        fit = self.strip.gpu.max_block_bytes // ENTRY_BYTES - SPARE_ENTRIES
        return fit if self._is_late else min(MAX_BAND_ENTRIES, fit)

    def _plan_bands(self) -> list[tuple[int, int, int]]:
        """Return the bands as (first bin, bin count, entries)."""
        limit = self._list_limit
        if self.lists.entry_count <= limit and self.strip.bin_count <= MAX_BAND_BINS:
            return [(0, self.strip.bin_count, self.lists.entry_count)]
        counts = self.strip.gpu.read(
            self.strip.buffers["BIN_COUNTS"], (self.strip.bin_count, 4), np.uint32
        )
        self._tile_sums = self._sum_tiles(counts)
        offsets, bands = split(counts[:, 0].astype(np.int64), limit)
        self.strip.gpu.write(
            self.strip.buffers["BIN_OFFSETS"], offsets.astype(np.uint32)
        )
        return bands

    def reserve_lists(self) -> None:
        """Divide the lists into bands, and allocate buffers for the longest."""
        with self.strip.timer.wall("plan_ms"):
            self.bands = self._plan_bands()
        n_bytes = _list_bytes(max(entries for _, _, entries in self.bands))
        self.strip.reserve(ENTRIES=n_bytes)
        needs_spare = self.lists.longest > SORT_CAPACITIES[-1]
        if needs_spare:
            self.strip.reserve(ENTRIES_SPARE=n_bytes)

    def reserve_more(self, ratio: float) -> None:
        """Enlarge the buffers to a multiple of the recorded totals, if necessary."""
        entries = min(int(ratio * self.lists.entry_count), self._list_limit)
        self.strip.reserve(ENTRIES=_list_bytes(entries))
        if self.lists.longest > SORT_CAPACITIES[-1]:
            self.strip.reserve(ENTRIES_SPARE=_list_bytes(entries))

    def splat_bands(self) -> None:
        """Build, sort and splat the lists, band by band."""
        self.reserve_lists()
        for first_bin, bin_count, _ in self.bands:
            self._make_lists_and_splat(first_bin, bin_count)

    def _make_lists_and_splat(
        self, first_bin: int, bin_count: int, *, indirect: bool = False
    ) -> None:
        self.make_lists(first_bin, bin_count, indirect=indirect)
        self._splat(first_bin, bin_count, indirect=indirect)

    def _groups_on_gpu(
        self, index: int, indirect: bool
    ) -> tuple[str, Buffer, int] | None:
        """Return the location of a dispatch size that ``scan_bins`` has written."""
        name = "DISPATCHES"
        location = name, self.strip.buffers[name], DISPATCH_BYTES * index
        return location if indirect else None

    def make_lists(
        self, first_bin: int, bin_count: int, *, indirect: bool = False
    ) -> None:
        """Build and sort the lists of a band."""
        with self.strip.timer.stage("bin_ms"):
            self.strip.run(
                "scatter_fragments",
                (bin_count, 1),
                *("FRAGMENT_PLACE", "BLOCKS", "WINDOWS", "BIN_OFFSETS", "ENTRIES"),
                **self._bin_uniforms,
                bin_columns=self.strip.bin_grid[0],
                first_bin=first_bin,
                defines=self._list_threads,
                indirect=self._groups_on_gpu(DISPATCH_SCATTER, indirect),
            )
        with self.strip.timer.stage("sort_ms"):
            self._sort(first_bin, bin_count, indirect)

    def _splat(self, first_bin: int, bin_count: int, *, indirect: bool) -> None:
        """Splat the tiles of a band, one kind of tiles at a time."""
        ranges = self._tile_ranges(first_bin, bin_count, indirect=indirect)
        for kind, variant in self._splat_variants.items():
            first, end = ranges[kind]
            with self.strip.timer.stage("splat_ms"):
                self.strip.run(
                    "splat_tiles",
                    (TILES_PER_BIN, group_count(end - first, TILES_PER_BIN)),
                    *("FRAGMENT_COLOR", "FRAGMENT_PLACE", "FRAGMENT_EDGE", "TILES"),
                    *("BIN_COUNTS", "BIN_OFFSETS", "ENTRIES", "KERNELS", "PIXELS"),
                    "COLOR_OUT",
                    textures={"ATLAS": self.atlas},
                    frame_size_px=self.strip.size,
                    tile_grid=self.strip.grid,
                    bin_columns=self.strip.bin_grid[0],
                    first_tile=kind * self._tile_room + first,
                    tile_end=kind * self._tile_room + end,
                    blur_px_per_dpt=self.strip.layers.blur_px_per_dpt,
                    defines=variant,
                    indirect=self._groups_on_gpu(DISPATCH_SPLAT + kind, indirect),
                )

    def _tile_ranges(
        self, first_bin: int, bin_count: int, *, indirect: bool
    ) -> list[tuple[int, int]]:
        """Return the ranges of a band's tiles within the lists of each kind."""
        if indirect:
            return [(0, self._tile_room)] * TILE_KINDS
        if bin_count == self.strip.bin_count:
            return [(0, count) for count in self.lists.tiles]
        sums = self._tile_sums
        ends = sums[first_bin], sums[first_bin + bin_count]
        return [(int(first), int(end)) for first, end in zip(*ends, strict=True)]

    def _sum_tiles(self, counts: NDArray[np.uint32]) -> NDArray[np.int64]:
        """Return the numbers of tiles of each kind (bins + 1, kinds) before each bin.

        Parameters
        ----------
        counts : (n_bins, 4)
            Words of BIN_COUNTS.
        """
        bins = np.arange(len(counts))[:, None]
        tiles = np.arange(TILES_PER_BIN)
        columns, rows = self.strip.grid
        x = bins % self.strip.bin_grid[0] * BIN_TILES + tiles % BIN_TILES
        y = bins // self.strip.bin_grid[0] * BIN_TILES + tiles // BIN_TILES
        ordered, hidden = (counts[:, [word]] >> tiles & 1 for word in (1, 3))
        bright = counts[:, [3]] >> TILES_PER_BIN >> tiles & 1
        kind = np.where(ordered > 0, 1 + hidden, bright * (TILE_KINDS - 1))
        kind = np.where((x < columns) & (y < rows), kind, TILE_KINDS)
        of_bin = (kind[..., None] == np.arange(TILE_KINDS)).sum(axis=1)
        return np.concatenate([np.zeros((1, TILE_KINDS), np.int64), of_bin.cumsum(0)])

    def _sort(self, first_bin: int, bin_count: int, indirect: bool) -> None:
        """Sort the lists of a band, one size class at a time."""
        key_bits = PAPER_SORT_KEY_BITS if self.strip.paper_rule else SORT_KEY_BITS
        longest_before = 1
        for index, capacity in enumerate((*SORT_CAPACITIES, 0)):
            if not indirect and self.lists.longest <= longest_before:
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
                indirect=self._groups_on_gpu(DISPATCH_SORT + index, indirect),
            )
            longest_before = capacity

    @property
    def _rule(self) -> dict[str, int]:
        return {"PAPER_RULE": 1} if self.strip.paper_rule else {}

    @property
    def _list_threads(self) -> dict[str, int]:
        if self.strip.gpu.is_software:
            return {"GROUP_THREADS": SOFTWARE_LIST_THREADS, "RANGE_SLOTS": THREADS}
        return {"GROUP_THREADS": THREADS, "RANGE_SLOTS": HARDWARE_RANGE_SLOTS}

    @property
    def _splat_variants(self) -> dict[int, dict[str, int]]:
        """Variants of the pass by the kind of tiles."""
        software = self.strip.gpu.is_software
        common = SOFTWARE_SPLAT if software else HARDWARE_SPLAT
        if self.strip.paper_rule:
            return {1: {**common, **self._rule}}
        bright = {**common, "HAS_EXCESS": 1}
        ordered = {**bright, "IN_ORDER": 1}
        hidden = {**ordered, "HAS_HIDDEN": 1}
        return {0: common, 1: ordered, 2: hidden, 3: bright}

    def counts(self) -> dict[str, int]:
        """Return the counts of `ViewResult` by name."""
        return {
            "entry_count": self.lists.entry_count,
            "overflow_count": self.lists.overflow_count,
        }


def _list_bytes(n_entries: int) -> int:
    """Return the size of a buffer for lists of a number of entries."""
    return ENTRY_BYTES * (n_entries + SPARE_ENTRIES)
