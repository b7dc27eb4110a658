"""Records of a frame's kernels in the layout of the passes, in one array.

The compiled loops are imported when a frame first needs them, as in `frame_kernels`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    KERNEL_WORDS,
    MAX_LEVEL,
    NODE_WORDS,
    PART_WORDS,
    THREADS,
)
from filter_service.rendering.frame_kernels import FrameKernels, pair_index

PART_ALIGNMENT_WORDS = 64
"""256 bytes: every OpenGL device accepts this alignment of a buffer range."""

NODE_WORK = "node work"
LEVEL_WORK = tuple(f"work of level {level}" for level in range(MAX_LEVEL + 1))


@dataclass(frozen=True)
class KernelLevels:
    """Sizes of a frame's kernels.

    Attributes
    ----------
    sizes, starts, step_ratio : (n, levels)
        Texel count, first texel and quantization step of a kernel and of its sums over
        squares of 2, 4 and 8 pixels.
    texel_count : int
        Total of all kernels and levels.
    """

    sizes: NDArray[np.int64]
    starts: NDArray[np.uint32]
    step_ratio: NDArray[np.float32]
    texel_count: int


@dataclass(frozen=True)
class KernelTables:
    """All records of a frame's kernels.

    Attributes
    ----------
    words : (n,), uint32
    parts : dict
        First word and word count by name: ``NODES`` (n, 2, 4) and ``RECIPES`` for
        blend_psfs, ``PARTS`` (n, 5, 4) for blend_cells, ``KERNELS`` (n, 3, 4),
        ``KERNEL_OF`` (n_cells, n_intervals), and, for each pass, the kernel and first
        texel (n, 2) of its work groups.
    node_texel_count : int
    """

    words: NDArray[np.uint32]
    parts: dict[str, tuple[int, int]]
    node_texel_count: int

    def of(self, name: str) -> NDArray[np.uint32]:
        """Return the words of a part."""
        first, count = self.parts[name]
        return self.words[first : first + count]


def kernel_levels(kernels: FrameKernels) -> KernelLevels:
    """Return the sizes of kernels at all levels."""
    from filter_service.rendering.table_loops import fill_levels

    sizes = np.empty((kernels.count, MAX_LEVEL + 1), np.int64)
    starts = np.empty(sizes.shape, np.uint32)
    step_ratio = np.empty(sizes.shape, np.float32)
    texel_count = fill_levels(
        *(kernels.reach_px, kernels.spread_px, kernels.peak_ratio),
        *(sizes, starts, step_ratio),
    )
    return KernelLevels(sizes, starts, step_ratio, texel_count)


def kernel_tables(
    kernels: FrameKernels, levels: KernelLevels, shape: tuple[int, int]
) -> KernelTables:
    """Return the records of kernels; ``shape`` is (n_cells, n_intervals)."""
    from filter_service.rendering.table_loops import (
        count_groups,
        fill_nodes,
        fill_records,
    )

    nodes = kernels.nodes
    groups = np.empty(MAX_LEVEL + 2, np.int64)
    node_texel_count = count_groups(nodes.reach_px, levels.sizes, THREADS, groups)
    counts = {
        "NODES": nodes.near.size * NODE_WORDS * 4,
        "RECIPES": nodes.recipes.size,
        "KERNELS": kernels.count * KERNEL_WORDS * 4,
        "PARTS": kernels.count * PART_WORDS * 4,
        "KERNEL_OF": shape[0] * shape[1],
        **dict(zip((NODE_WORK, *LEVEL_WORK), (2 * groups).tolist(), strict=True)),
    }
    parts, end = {}, 0
    for name, count in counts.items():
        parts[name] = end, count
        end += -(-count // PART_ALIGNMENT_WORDS) * PART_ALIGNMENT_WORDS
    words = np.empty(end, np.uint32)
    tables = KernelTables(words, parts, node_texel_count)
    floats = words.view(np.float32)
    first = {name: at for name, (at, _) in parts.items()}
    fill_nodes(
        *(words, floats, first["NODES"]),
        (nodes.near, nodes.far, nodes.reach_px, nodes.peak_ratio),
        *(THREADS, first[NODE_WORK]),
    )
    fill_records(
        *(words, floats, (first["KERNELS"], first["PARTS"])),
        (
            *(kernels.spread_px, kernels.radius_px, kernels.reach_px),
            *(kernels.parts, kernels.weight_ratio, kernels.maps),
        ),
        (levels.sizes, levels.starts, levels.step_ratio),
        *(THREADS, np.array([first[name] for name in LEVEL_WORK])),
    )
    tables.of("RECIPES")[:] = nodes.recipes.ravel()
    tables.of("KERNEL_OF")[:] = pair_index(kernels, shape).ravel()
    return tables
