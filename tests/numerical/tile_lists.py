"""The bins' lists by comparing all pairs: twin of count, scan, scatter and sort."""

from dataclasses import dataclass

import numpy as np

from filter_service.constants import (
    BIN_TILES,
    BRIGHT_BIT,
    EDGE_BIT,
    LEVEL_MASK,
    LEVEL_SHIFT,
    PLACE_BITS,
    PLACE_MASK,
    THREADS,
    TILE_SIZE_PX,
    TILES_PER_BIN,
)


@dataclass(frozen=True)
class Fragments:
    """Fragments of a frame in the order of their slots; all (n,) or as noted.

    ``first`` and ``last`` (n, 2) are the corner pixels x, y of a fragment's square,
    ``sides`` (n, 4) the reach to the left, right, up and down.
    """

    slots: np.ndarray
    first: np.ndarray
    last: np.ndarray
    sides: np.ndarray
    radius_px: np.ndarray
    is_edge: np.ndarray
    is_bright: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class Lists:
    """``entries[b]`` (n,) of bin b; bits of tiles (n_bins,), and starts.

    Order matters in ``ordered_tiles``; light of a hidden surface reaches
    ``hidden_tiles``, and excess light ``bright_tiles``.
    """

    entries: list
    ordered_tiles: np.ndarray
    hidden_tiles: np.ndarray
    bright_tiles: np.ndarray
    offsets: np.ndarray


def unpack_fragments(blocks, place, color):
    """Fragments in the buffers' words: BLOCKS, FRAGMENT_PLACE, FRAGMENT_COLOR."""
    slots = np.arange(len(place))
    slots = slots[slots % THREADS < np.repeat(blocks[:, 0], THREADS)]
    place = place[slots]
    first = np.stack([place[:, 0] & PLACE_MASK, place[:, 0] >> PLACE_BITS], axis=-1)
    extent = (1 << ((place[:, 1] >> LEVEL_SHIFT) & LEVEL_MASK).astype(int)) - 1
    sides = np.ascontiguousarray(place[:, 3]).view(np.uint8).reshape(-1, 4)
    return Fragments(
        slots=slots,
        first=first.astype(int),
        last=first.astype(int) + extent[:, None],
        sides=sides.astype(int),
        radius_px=(place[:, 2] >> PLACE_BITS).astype(int),
        is_edge=(place[:, 1] & EDGE_BIT) != 0,
        is_bright=(place[:, 1] & BRIGHT_BIT) != 0,
        depth=color[slots, 3],
    )


def lights_tile(fragments, left, top):
    """Whether (n,) fragments' boxes and discs reach a tile of output pixels."""
    size = TILE_SIZE_PX
    near = np.array([left, top])
    far = near + size - 1
    low = fragments.first - fragments.sides[:, [0, 2]]
    high = fragments.last + fragments.sides[:, [1, 3]]
    in_box = ((low <= far) & (high >= near)).all(axis=1)
    # the pair of pixels, one of the square and one of the tile, that lie nearest
    gap = np.maximum(near - fragments.last, 0) + np.maximum(fragments.first - far, 0)
    return in_box & ((gap**2).sum(axis=1) <= (fragments.radius_px + 0.5) ** 2)


def expected_lists(fragments, size_px, *, hidden_from, order_always=False):
    """Unsorted lists of a frame; slots from ``hidden_from`` on are hidden surfaces."""
    tiles = [-(-side // TILE_SIZE_PX) for side in size_px]
    columns, rows = (-(-side // BIN_TILES) for side in tiles)
    hidden = fragments.slots >= hidden_from
    entries, ordered, covered, bright = [], [], [], []
    for bin_index in range(columns * rows):
        masks = np.zeros(len(fragments.slots), np.uint32)
        for i in range(TILES_PER_BIN):
            x = (bin_index % columns) * BIN_TILES + i % BIN_TILES
            y = (bin_index // columns) * BIN_TILES + i // BIN_TILES
            lit = lights_tile(fragments, x * TILE_SIZE_PX, y * TILE_SIZE_PX)
            masks |= np.uint32(1 << i) * lit.astype(np.uint32)
        kept = masks > 0
        slots = fragments.slots[kept].astype(np.uint32)
        entries.append((slots << np.uint32(TILES_PER_BIN)) | masks[kept])
        matters = fragments.is_edge | hidden
        ordered.append(np.bitwise_or.reduce(masks[matters], initial=0))
        covered.append(np.bitwise_or.reduce(masks[hidden], initial=0))
        bright.append(np.bitwise_or.reduce(masks[fragments.is_bright], initial=0))
    counts = [len(of_bin) for of_bin in entries]
    ordered = np.array(ordered, np.uint32)
    return Lists(
        entries=entries,
        ordered_tiles=ordered | (2**TILES_PER_BIN - 1 if order_always else 0),
        hidden_tiles=np.array(covered, np.uint32) * (not order_always),
        bright_tiles=np.array(bright, np.uint32) * (not order_always),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
    )


def expected_tiles(lists, size_px):
    """Tiles without order, in order, with a hidden surface; bright without order."""
    tiles = [-(-side // TILE_SIZE_PX) for side in size_px]
    columns = -(-tiles[0] // BIN_TILES)
    kinds = [[], [], [], []]
    for bin_index, ordered in enumerate(lists.ordered_tiles):
        for i in range(TILES_PER_BIN):
            x = (bin_index % columns) * BIN_TILES + i % BIN_TILES
            y = (bin_index // columns) * BIN_TILES + i // BIN_TILES
            if x < tiles[0] and y < tiles[1]:
                hidden, bright = (
                    int(bits[bin_index]) >> i & 1
                    for bits in (lists.hidden_tiles, lists.bright_tiles)
                )
                kind = 1 + hidden if int(ordered) >> i & 1 else 3 * bright
                kinds[kind].append(bin_index * TILES_PER_BIN + i)
    return kinds


def expected_windows(blocks, tile_grid, surface_count):
    """First column and row of the blocks that reach a bin, last ones plus one."""
    columns, rows = tile_grid
    reach = blocks[:, 1].view(np.float32).reshape(surface_count, rows, columns)
    reach = np.where(blocks[:, 0].reshape(reach.shape) > 0, reach, -1.0).max(axis=0)
    y, x = np.mgrid[0:rows, 0:columns] * TILE_SIZE_PX
    windows = []
    for bin_y in range(0, rows, BIN_TILES):
        for bin_x in range(0, columns, BIN_TILES):
            last = BIN_TILES * TILE_SIZE_PX - 1
            gaps = [
                np.maximum(first - at - TILE_SIZE_PX + 1, 0)
                + np.maximum(at - first - last, 0)
                for at, first in ((x, bin_x * TILE_SIZE_PX), (y, bin_y * TILE_SIZE_PX))
            ]
            near = (reach >= 0) & (gaps[0] ** 2 + gaps[1] ** 2 <= reach**2)
            if near.any():
                in_y, in_x = np.nonzero(near)
                ends = [in_x.min(), in_y.min(), in_x.max() + 1, in_y.max() + 1]
                windows.append(ends)
            else:
                windows.append([columns, rows, 0, 0])
    return np.array(windows)


def entry_depths(entries, color):
    """Sort depths (n,) of a list."""
    return color[entries >> TILES_PER_BIN, 3]


def depth_keys(depth, key_bits, *, paper_rule):
    """Whole-number keys (n,) of float32 depths within their own range."""
    if not paper_rule:
        span = max(float(depth.max()) - float(depth.min()), 1e-12)
        share = (depth.astype(float) - float(depth.min())) / span
        return np.floor(share * (2**key_bits - 1)).astype(np.int64)
    # floats of one sign order like their bits
    bits = np.ascontiguousarray(depth, np.float32).view(np.int32).astype(np.int64)
    bits = np.where(bits < 0, -(bits & 0x7FFFFFFF), bits)
    bits -= bits.min()
    spare_bits = max(int(bits.max()).bit_length() - key_bits, 0)
    return bits >> spare_bits
