"""The fragments that an engine made of its last frame, read off its memory."""

from typing import NamedTuple

import numpy as np

from filter_service import constants
from filter_service.native.records import BLOCK, FRAGMENT, FRAGMENT_LIGHT


class Fragments(NamedTuple):
    """Fragments in scan order, arrays (n,); rgb (n, 3)."""

    surface: np.ndarray
    x: np.ndarray
    y: np.ndarray
    edge_px: np.ndarray
    rgb: np.ndarray


def made_fragments(bench, width_px, height_px, surface_count=1):
    """Fragments of a frame of that size, border included."""
    columns, rows = (-(-n // constants.TILE_SIZE_PX) for n in (width_px, height_px))
    n_blocks = surface_count * columns * rows
    n_slots = n_blocks * constants.THREADS
    if bench.gpu is None:
        arrays = bench.renderer._arrays
        blocks = _array(arrays, "blocks", n_blocks, BLOCK)
        counts = (blocks["end"] - blocks["first"]).astype(int)
        firsts = blocks["first"].astype(int)
        made = _array(arrays, "fragments", n_slots, FRAGMENT)
        x, y, state = made["x"], made["y"], made["state"]
        rgb = _array(arrays, "lights", n_slots, FRAGMENT_LIGHT)["rgb"]
    else:
        counts = _read(bench.gpu, "BLOCKS", (n_blocks, 4), np.uint32)[:, 0].astype(int)
        firsts = np.arange(n_blocks) * constants.THREADS
        place = _read(bench.gpu, "FRAGMENT_PLACE", (n_slots, 4), np.uint32)
        x = place[:, 0] & constants.PLACE_MASK
        y = place[:, 0] >> constants.PLACE_BITS
        rgb = _read(bench.gpu, "FRAGMENT_COLOR", (n_slots, 4), np.float32)[:, :3]
        state = place[:, 1]
    before = np.cumsum(counts) - counts
    alive = np.arange(counts.sum()) + np.repeat(firsts - before, counts)
    level = (state[alive] >> constants.LEVEL_SHIFT) & constants.LEVEL_MASK
    surface = np.repeat(np.arange(n_blocks) // (columns * rows), counts)
    return Fragments(
        surface,
        x[alive].astype(int),
        y[alive].astype(int),
        2 ** level.astype(int),
        rgb[alive],
    )


def _array(arrays, name, count, dtype):
    return np.frombuffer(arrays._buffers[name].memory, dtype, count)


def _read(gpu, name, shape, dtype):
    with gpu.context:
        return gpu.read(gpu.storage(name, 1), shape, dtype)
