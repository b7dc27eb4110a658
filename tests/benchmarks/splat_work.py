"""What the OpenGL splat pass evaluates for a frame, counted from the frame's fragments.

A tile evaluates each of its fragments at all of its pixels, lit or not; an entry of a
bin's list stands for as many tiles as it has bits.  Fragments are read from the buffers
that the frame left; their entries must be as many as the renderer says.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from filter_service.constants import (
    BIN_TILES,
    BYTE_BITS,
    BYTE_MASK,
    LEVEL_MASK,
    LEVEL_SHIFT,
    PLACE_BITS,
    PLACE_MASK,
    THREADS,
    TILE_SIZE_PX,
)
from filter_service.gl.gpu import Gpu


@dataclass(frozen=True)
class SplatWork:
    """Counts of one frame.

    Attributes
    ----------
    entry_count : int
        Of the bins' lists.
    evaluation_count : int
        Kernel texels read: (fragment, tile) pairs times the pixels of a tile.
    lit_count : int
        Those of them within the box of their kernel.
    """

    entry_count: int
    evaluation_count: int
    lit_count: int


def splat_work(gpu: Gpu, size_px: tuple[int, int], entry_count: int) -> SplatWork:
    """Count the work of the last frame of a context, of one surface and one strip.

    Parameters
    ----------
    size_px : (width, height)
    entry_count : int
        That of `FilteredView`.

    Raises
    ------
    ValueError
        The buffers hold another frame, or not the whole of it.
    """
    tiles = tuple(-(-side // TILE_SIZE_PX) for side in size_px)
    block_count = tiles[0] * tiles[1]
    with gpu.context:
        blocks, place = (
            gpu.read(gpu.storage(name, 1), (count, 4), np.uint32)
            for name, count in (
                ("BLOCKS", block_count),
                ("FRAGMENT_PLACE", block_count * THREADS),
            )
        )
    work = work_of(blocks, place, tiles)
    if work.entry_count != entry_count:
        raise ValueError(
            f"{work.entry_count} entries of the fragments in the buffers, the frame "
            f"had {entry_count}"
        )
    return work


def work_of(blocks: NDArray, place: NDArray, tile_grid: tuple[int, int]) -> SplatWork:
    """Count the work of fragments in the words of BLOCKS and FRAGMENT_PLACE."""
    counts = np.zeros((len(blocks), 3), np.int64)
    _count(blocks[:, 0].astype(np.int64), place.astype(np.int64), *tile_grid, counts)
    return SplatWork(*(int(count) for count in counts.sum(axis=0)))


@njit(parallel=True, cache=True)
def _count(alive, place, columns, rows, counts):
    for block in prange(alive.size):
        for slot in range(block * THREADS, block * THREADS + alive[block]):
            _count_fragment(place[slot], columns, rows, counts[block])


@njit(cache=True)
def _count_fragment(words, columns, rows, counts):
    """Add the entries, evaluations and lit evaluations of a fragment."""
    x, y = words[0] & PLACE_MASK, words[0] >> PLACE_BITS
    extent = (1 << ((words[1] >> LEVEL_SHIFT) & LEVEL_MASK)) - 1
    reach_px = (words[2] >> PLACE_BITS) + 0.5
    left, right, up, down = (
        words[3] & BYTE_MASK,
        (words[3] >> BYTE_BITS) & BYTE_MASK,
        (words[3] >> 2 * BYTE_BITS) & BYTE_MASK,
        words[3] >> 3 * BYTE_BITS,
    )
    bin_px = BIN_TILES * TILE_SIZE_PX
    last_column, last_row = (columns - 1) // BIN_TILES, (rows - 1) // BIN_TILES
    for bin_y in range(
        max(y - up, 0) // bin_px, min((y + extent + down) // bin_px, last_row) + 1
    ):
        for bin_x in range(
            max(x - left, 0) // bin_px,
            min((x + extent + right) // bin_px, last_column) + 1,
        ):
            is_entry = False
            for tile_y in range(bin_y * BIN_TILES, (bin_y + 1) * BIN_TILES):
                for tile_x in range(bin_x * BIN_TILES, (bin_x + 1) * BIN_TILES):
                    across = _overlap(x - left, x + extent + right, tile_x)
                    along = _overlap(y - up, y + extent + down, tile_y)
                    gap_x = _gap(x, x + extent, tile_x)
                    gap_y = _gap(y, y + extent, tile_y)
                    is_near = gap_x * gap_x + gap_y * gap_y <= reach_px * reach_px
                    if across <= 0 or along <= 0 or not is_near:
                        continue
                    is_entry = True
                    if tile_x < columns and tile_y < rows:
                        counts[1] += THREADS
                        counts[2] += across * along
            counts[0] += is_entry


@njit(cache=True)
def _overlap(first, last, tile):
    """Pixels that a range shares with a tile, along one axis."""
    start = tile * TILE_SIZE_PX
    return min(last, start + TILE_SIZE_PX - 1) - max(first, start) + 1


@njit(cache=True)
def _gap(first, last, tile):
    """Pixels from a range to a tile; 0 where they meet."""
    start = tile * TILE_SIZE_PX
    return max(start - last, first - start - TILE_SIZE_PX + 1, 0)
