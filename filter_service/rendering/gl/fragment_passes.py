"""Passes that convert a frame, or a strip of it, to fragments."""

from typing import Any

import numpy as np

from filter_service.constants import (
    BYTES_PER_WORD,
    MAX_LEVEL,
    STAT_BAD_COLOR,
    STAT_CLAMPED,
    STAT_FRAGMENTS,
    STAT_LANES,
    STAT_MERGED,
    STAT_MISSING,
    STAT_WORDS,
    THREADS,
)
from filter_service.rendering.frame import Merging
from filter_service.rendering.gl.kernel_passes import KernelRun, words_per_cell
from filter_service.rendering.gl.strip import Strip, group_count
from filter_service.rendering.image_cells import ImageCells
from filter_service.rgbd_view import RgbdView

COLOR_VARIANTS = {
    "uint8": None,
    "float32": {"COLOR_IS_LINEAR": 1},
    "float16": {"COLOR_IS_HALF": 1},
}
"""Defines of ``build_fragments`` by the dtype of the color image."""


class FragmentPasses:
    """Passes from the pixels of one strip to its fragments.

    Parameters
    ----------
    strip : Strip
    image : ImageCells
        Cells of the whole frame.
    merging : Merging
    first_row : int
        First row of the strip within the frame.
    frame_pixel_count : int
        Pixel count of the whole frame.
    image_size_px : (width, height)
        Size of the whole image without its border.
    border_px : int
        Columns and rows added on each side of the image.
    counted_px : (left, top, right, bottom)
        Part of the strip whose pixels are counted.
    object_range_dpt : (low, high)
        Prepared distances; pixels outside are counted.
    white_level : float
        Reference of the contrast below which pixels merge.
    is_encoded : bool
        Whether the output is encoded for a display, where contrast in dark areas is
        more visible.

    Attributes
    ----------
    stats : (STAT_LANES, STAT_WORDS), uint32
        Counters of the passes, written by the readback.
    """

    def __init__(
        self,
        strip: Strip,
        *,
        image: ImageCells,
        merging: Merging,
        first_row: int,
        frame_pixel_count: int,
        image_size_px: tuple[int, int],
        border_px: int,
        counted_px: tuple[int, int, int, int],
        object_range_dpt: tuple[float, float],
        white_level: float,
        is_encoded: bool,
    ):
        self.strip = strip
        self.image = image
        self.merging = merging
        self.first_row = first_row
        self.scan = (first_row * strip.size[0], frame_pixel_count)
        self.image_size_px = image_size_px
        self.border_px = border_px
        self.counted_px = counted_px
        self.object_range_dpt = object_range_dpt
        self.stats = np.zeros((STAT_LANES, STAT_WORDS), np.uint32)
        self.white_level = white_level
        self.is_encoded = is_encoded and white_level > 0.0

    def source(self) -> dict[str, Any]:
        """Return how ``build_fragments`` reads the input, as options of `Strip.run`.

        ``bindings`` are the buffers that it reads.
        """
        raise NotImplementedError

    def build_fragments(self, kernels: KernelRun) -> None:
        """Compute linear light, vergence and layer of pixels, and the used pairs."""
        n_pixels = self.strip.surface_count * self.strip.pixel_count
        self.strip.reserve(
            PIXELS=16 * n_pixels,
            PIXEL_LAYER=4 * n_pixels,
            BLOCK_LIGHT=16 * self.strip.tile_count,
        )
        self.strip.kernel_buffers = kernels.buffers
        source = self.source()
        with self.strip.timer.stage("fragments_ms"):
            self.strip.run(
                "build_fragments",
                (*self.strip.grid, self.strip.surface_count),
                *(*source.pop("bindings"), "LAYER_DPT", "FIELD_DEFOCUS"),
                *("PIXELS", "PIXEL_LAYER", "BLOCK_LIGHT", "USED", "STATS"),
                **self._common,
                words_per_cell=words_per_cell(self.strip.layers),
                tangents=self.strip.view.tangents,
                vergence_range_dpt=self.strip.layers.vergence_range_dpt,
                vergence_scale=self.strip.layers.vergence.scale_ratio,
                vergence_offset_m=self.strip.layers.vergence.offset_m,
                depth_is_planar=int(self.strip.view.depth_kind == "planar"),
                blur_px_per_dpt=self.strip.layers.blur_px_per_dpt,
                object_range_dpt=self.object_range_dpt,
                counted_px=self.counted_px,
                **source,
            )

    @property
    def _common(self) -> dict[str, Any]:
        return {
            "frame_size_px": self.strip.size,
            "layer_count": len(self.strip.layers.layer_dpt),
            "cell_px": self.image.cell_px,
            "cell_columns": self.image.grid[0],
            "first_row": self.first_row,
            "border_px": self.border_px,
            "image_size_px": self.image_size_px,
        }

    def merge_fragments(self) -> None:
        """Merge pixels into fragments, and pack the fragments of each block."""
        slots = self.strip.block_count * THREADS
        self.strip.reserve(
            FRAGMENT_COLOR=16 * slots,
            FRAGMENT_PLACE=16 * slots,
            FRAGMENT_EDGE=8 * slots,
            BLOCKS=16 * self.strip.block_count,
        )
        for surface in range(self.strip.surface_count):
            with self.strip.timer.stage("merge_ms"):
                self.strip.run(
                    "merge_fragments",
                    self.strip.grid,
                    *("PIXELS", "PIXEL_LAYER", "KERNELS", "KERNEL_OF"),
                    *("BLOCK_LIGHT", "FRAGMENT_COLOR", "FRAGMENT_PLACE"),
                    *("FRAGMENT_EDGE", "BLOCKS", "STATS", "PLAN"),
                    **self._common,
                    blur_px_per_dpt=self.strip.layers.blur_px_per_dpt,
                    max_level=self._max_level,
                    white_level=self.white_level,
                    is_encoded=int(self.is_encoded),
                    tolerance=self.merging.tolerance,
                    tangents=self.strip.view.tangents,
                    gaze_direction=self.merging.gaze,
                    bright_pixels=int(self.merging.bright_pixels),
                    paper_order=int(self.strip.paper_rule),
                    scan_px=self.scan,
                    surface=surface,
                )

    @property
    def _max_level(self) -> int:
        """Highest level of merging; the paper has one level."""
        if self.merging.tolerance == 0.0:
            return 0
        highest = 1 if self.strip.paper_rule else MAX_LEVEL
        cell_px = self.image.cell_px
        return min(highest, cell_px.bit_length() - 1) if cell_px else highest

    def counts(self) -> dict[str, int]:
        """Return the counts of `ViewResult` by name, after the readback."""
        stats = self.stats.sum(axis=0, dtype=np.int64).tolist()
        return {
            "missing_depth_count": stats[STAT_MISSING],
            "clamped_depth_count": stats[STAT_CLAMPED],
            "bad_color_count": stats[STAT_BAD_COLOR],
            "fragment_count": stats[STAT_FRAGMENTS],
            "merged_count": stats[STAT_MERGED],
        }


class ArrayFragments(FragmentPasses):
    """Fragments of an image in host memory.

    Parameters
    ----------
    view : RgbdView
        The image of the strip.
    """

    def __init__(self, strip: Strip, view: RgbdView, **values: Any) -> None:
        super().__init__(strip, **values)
        self._view = view

    def upload(self) -> None:
        """Upload the image, padded to whole words."""
        colors, depths_m = self._view.surface_colors, self._view.surface_depths_m
        with self.strip.timer.stage("upload_ms"):
            n_bytes = sum(color.nbytes for color in colors)
            n_bytes = group_count(n_bytes, BYTES_PER_WORD) * BYTES_PER_WORD
            self.strip.reserve(COLOR_IN=n_bytes)
            self.strip.buffers["COLOR_IN"] = self.strip.gpu.upload("COLOR_IN", *colors)
            self.strip.buffers["DEPTH_IN"] = self.strip.gpu.upload(
                "DEPTH_IN", *depths_m
            )

    def source(self) -> dict[str, Any]:
        """Return the variant for the type of the color image, and its buffers."""
        return {
            "defines": COLOR_VARIANTS[self._view.color.dtype.name],
            "bindings": ("COLOR_IN", "DEPTH_IN"),
        }
