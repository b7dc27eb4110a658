"""What the OpenGL splat pass evaluates for a frame, counted from the frame's fragments.

A tile evaluates each of its fragments at all of its pixels, lit or not; an entry of a
bin's list stands for as many tiles as it has bits.  Fragments are read from the buffers
that the frame left; their entries must be as many as the renderer says.
"""

from dataclasses import dataclass

import numpy as np
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
        That of `ViewResult`.

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
    is_alive = np.arange(THREADS) < blocks[:, :1]
    fragments = place.reshape(-1, THREADS, 4)[is_alive].astype(np.int64)
    return SplatWork(*(int(count) for count in _counts(fragments, tile_grid)))


def _counts(words: NDArray, tile_grid: tuple[int, int]) -> NDArray[np.int64]:
    """Return the entries, evaluations and lit evaluations (3,) of fragments (n, 4)."""
    place, level, reach, sides = words.T
    start = np.stack([place & PLACE_MASK, place >> PLACE_BITS], axis=-1)
    extent = (1 << ((level >> LEVEL_SHIFT) & LEVEL_MASK)) - 1
    end = start + extent[:, None]
    reach_px = (reach >> PLACE_BITS) + 0.5
    left, right, up, down = (
        (sides >> shift * BYTE_BITS) & BYTE_MASK for shift in range(4)
    )
    first_px = start - np.stack([left, up], axis=-1)
    last_px = end + np.stack([right, down], axis=-1)
    bin_px = BIN_TILES * TILE_SIZE_PX
    first_bin = np.maximum(first_px, 0) // bin_px
    last_bin = np.minimum(last_px // bin_px, (np.array(tile_grid) - 1) // BIN_TILES)
    counts = np.zeros(3, np.int64)
    # One bin of every fragment at a time, by its place among the fragment's bins.
    for step in np.ndindex(*np.max(last_bin - first_bin + 1, axis=0, initial=0)):
        own = np.flatnonzero((first_bin + step <= last_bin).all(axis=1))
        tile = (first_bin[own] + step)[..., None] * BIN_TILES + np.arange(BIN_TILES)
        tile_px = tile * TILE_SIZE_PX
        tile_end_px = tile_px + TILE_SIZE_PX - 1
        shared_px = np.minimum(last_px[own][..., None], tile_end_px)
        shared_px = shared_px - np.maximum(first_px[own][..., None], tile_px) + 1
        before_px, after_px = (
            tile_px - end[own][..., None],
            start[own][..., None] - tile_end_px,
        )
        gap_px = np.maximum(np.maximum(before_px, after_px), 0)
        # (fragments, tiles across, tiles along)
        square = gap_px[:, 0, :, None] ** 2 + gap_px[:, 1, None, :] ** 2
        is_lit = square <= reach_px[own, None, None] ** 2
        is_lit &= (shared_px[:, 0, :, None] > 0) & (shared_px[:, 1, None, :] > 0)
        counts[0] += is_lit.any(axis=(1, 2)).sum()
        is_inside = tile < np.array(tile_grid)[:, None]
        is_lit &= is_inside[:, 0, :, None] & is_inside[:, 1, None, :]
        counts[1] += THREADS * is_lit.sum()
        area = shared_px[:, 0, :, None] * shared_px[:, 1, None, :]
        counts[2] += area[is_lit].sum()
    return counts
