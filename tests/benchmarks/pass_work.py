"""What the passes of a frame have to do, counted, and the least time that it takes.

A pass's bytes are those of memory that it reads and writes, each datum once; fetched
bytes are those that its threads read, mostly from caches; operations are on floats, a
fused multiply-add counts as two; atomics are those on counters that all threads share,
which a GPU performs one after the other.  The bound of a pass is the longest of the
four at the rates of the GPU.  No pass reaches it: scattered reads move more bytes, and
each dispatch takes some microseconds.
"""

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BIN_TILES,
    PLAN_BASE_TEXELS,
    PLAN_KERNELS,
    PLAN_NODE_TEXELS,
    PLAN_NODES,
    PLAN_REACH,
    PLAN_TEXELS,
    PLAN_WORDS,
    REACH_MARGIN_PX,
    TILE_SIZE_PX,
)
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.splat_work import splat_work

STATE_STAGES = ("kernel_plan", "psf_blend")
"""Passes that only a changed state needs; the plan clears counters otherwise."""

SAMPLED_RATIO = 1.0 / 256.0


@dataclass(frozen=True)
class Rates:
    """Rates of a GPU, each a second."""

    bytes: float
    fetched_bytes: float
    flops: float
    atomics: float


_CLOCK_HZ, _CORES = 1.98e9, 132
RATES = {
    name: Rates(
        bytes=memory,
        fetched_bytes=_CORES * 128 * _CLOCK_HZ,
        flops=_CORES * 128 * 2 * _CLOCK_HZ,
        atomics=_CLOCK_HZ,
    )
    for name, memory in (("H100", 3.35e12), ("H200", 4.8e12))
}
"""By a part of the renderer's name; data sheets, at the highest clock."""


@dataclass(frozen=True)
class PassWork:
    """Work of a pass."""

    bytes: float = 0.0
    fetched_bytes: float = 0.0
    flops: float = 0.0
    atomics: float = 0.0

    def bound_ms(self, rates: Rates) -> float:
        """Return the least time at the rates of a GPU."""
        pairs = zip(astuple(self), astuple(rates), strict=True)
        return 1e3 * max(count / rate for count, rate in pairs)


@dataclass(frozen=True)
class FrameWork:
    """Counts of a frame whose state has changed, all its views together.

    Attributes
    ----------
    views, pixels, fragments : float
    searched : float
        Blocks that the bins search for those in reach.
    tests : float
        Fragments in the windows of all bins, which a binning pass tests.
    entries, sorted_entries : float
        Entries of the lists, and those of lists that are sorted.
    evaluations : float
        Pixels of tiles times their fragments.
    kernels, nodes : float
    texels, base_texels, node_texels : float
        Texels of kernels at all levels and at level 0, and of node kernels.
    """

    views: float
    pixels: float
    fragments: float
    searched: float
    tests: float
    entries: float
    sorted_entries: float
    evaluations: float
    kernels: float
    nodes: float
    texels: float
    base_texels: float
    node_texels: float

    def times(self, count: float) -> "FrameWork":
        """Return the work of several such views."""
        return FrameWork(*(count * value for value in astuple(self)))

    def of(self, names: tuple[str, ...]) -> list[float]:
        """Return counts by name."""
        return [getattr(self, name) for name in names]

    def passes(self) -> dict[str, PassWork]:
        """Return the work of each stage, by the names of the stage timer."""
        pixels, blocks, bins = self.pixels, self.pixels / 64, self.pixels / 256
        merged_texels = self.texels - self.base_texels
        places = 16 * self.fragments + 16 * blocks
        return {
            # Color and depth; linear light, vergence and layer.
            "fragments": PassWork(27 * pixels, flops=100 * pixels),
            "merge": PassWork(20 * pixels + 32 * self.fragments, 40 * pixels),
            # Three runs over the fragments in reach: one counts, two write.
            "bin": PassWork(
                2 * places + 64 * bins + 4 * self.entries,
                16 * self.searched + 3 * 16 * self.tests,
                20 * self.searched + 3 * 30 * self.tests,
            ),
            # Depths are read twice, each from a sector of 32 bytes.
            "sort": PassWork(8 * self.sorted_entries, 64 * self.sorted_entries),
            "splat": PassWork(
                16 * self.texels + 32 * self.fragments + 4 * self.entries + 32 * pixels,
                16 * self.evaluations,
                24 * self.evaluations,
            ),
            "encode": PassWork(19 * pixels, flops=60 * pixels),
            "show": PassWork(24 * pixels, flops=60 * pixels),
            "sample": PassWork(16 * SAMPLED_RATIO * pixels),
            "kernel_plan": PassWork(
                180 * self.kernels + 500 * self.nodes,
                atomics=13 * self.kernels + 6 * self.nodes,
            ),
            # 36 cached weights a node texel, three node texels a texel, four a merged
            # one.
            "psf_blend": PassWork(
                32 * self.node_texels + 32 * self.texels,
                72 * self.node_texels + 48 * self.base_texels + 64 * merged_texels,
                72 * self.node_texels + 40 * self.base_texels + 50 * merged_texels,
            ),
        }


def rates_of(renderer_name: str) -> Rates | None:
    """Return the rates of a GPU by the name that OpenGL tells; None if unknown."""
    found = (rates for name, rates in RATES.items() if name in renderer_name)
    return next(found, None)


def counted_work(renderer: FilterRenderer, view: RgbdView, handle) -> FrameWork:
    """Count the work of a renderer's last frame, which was the first of its state.

    Raises
    ------
    ValueError
        As `splat_work`.
    """
    gpu, size_px = renderer._gpu, (view.width_px, view.height_px)
    kernels = renderer._eyes.of(handle).kernels
    tiles = tuple(-(-side // TILE_SIZE_PX) for side in size_px)
    bins = tuple(-(-side // BIN_TILES) for side in tiles)
    bin_count, block_count = bins[0] * bins[1], tiles[0] * tiles[1]
    with gpu.entered():
        plan = gpu.read(kernels._buffers["PLAN"], (PLAN_WORDS,), np.uint32)
        lists, windows, blocks = (
            gpu.read(gpu.storage(name, 16), (count, 4), np.int32)
            for name, count in (
                ("BIN_COUNTS", bin_count),
                ("WINDOWS", bin_count),
                ("BLOCKS", block_count),
            )
        )
    lengths = lists[:, 0].astype(np.int64)
    return FrameWork(
        views=1.0,
        pixels=size_px[0] * size_px[1],
        fragments=float(blocks[:, 0].sum()),
        searched=searched_blocks(int(plan[PLAN_REACH]), bins, tiles),
        tests=_tested(windows, blocks[:, 0].reshape(tiles[1], tiles[0])),
        entries=float(lengths.sum()),
        sorted_entries=float(lengths[(lists[:, 1] != 0) & (lengths > 1)].sum()),
        evaluations=splat_work(gpu, size_px, int(lengths.sum())).evaluation_count,
        kernels=float(plan[PLAN_KERNELS]),
        nodes=float(plan[PLAN_NODES]),
        texels=float(plan[PLAN_TEXELS]),
        base_texels=float(plan[PLAN_BASE_TEXELS]),
        node_texels=float(plan[PLAN_NODE_TEXELS]),
    )


def searched_blocks(
    reach_px: int, bins: tuple[int, ...], tiles: tuple[int, ...]
) -> float:
    """Return the blocks that `count_bins` searches, of all bins."""
    steps = -(-int(np.ceil(reach_px + REACH_MARGIN_PX)) // TILE_SIZE_PX)
    sides = []
    for bin_side, tile_side in zip(bins, tiles, strict=True):
        first = BIN_TILES * np.arange(bin_side)
        end = np.minimum(first + BIN_TILES + steps, tile_side)
        sides.append(float((end - np.maximum(first - steps, 0)).sum()))
    return sides[0] * sides[1]


def _tested(windows: NDArray[np.int32], alive: NDArray[np.int32]) -> float:
    """Return the fragments in windows: left, top, right, bottom in blocks."""
    sums = np.zeros(tuple(np.add(alive.shape, 1)), np.int64)
    sums[1:, 1:] = alive.cumsum(0, dtype=np.int64).cumsum(1)
    left, top, right, bottom = windows.T
    right, bottom = np.maximum(right, left), np.maximum(bottom, top)
    inside = sums[bottom, right] - sums[top, right] - sums[bottom, left]
    return float((inside + sums[top, left]).sum())
