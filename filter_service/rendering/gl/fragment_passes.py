"""The passes that turn one frame or strip of it into fragments."""

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BIN_TILES,
    BYTES_PER_WORD,
    MAX_LEVEL,
    THREADS,
    TILE_SIZE_PX,
)
from filter_service.gl.gpu import Buffer, Gpu, StageTimer
from filter_service.psfs.store import FrameLayers
from filter_service.rendering.gl import list_bands
from filter_service.rendering.gl.kernel_passes import (
    KernelSet,
    used_pairs,
    words_per_cell,
)
from filter_service.rendering.image_cells import ImageCells
from filter_service.rgbd_view import RgbdView

COLOR_VARIANTS = {
    "uint8": None,
    "float32": {"COLOR_IS_LINEAR": 1},
    "float16": {"COLOR_IS_HALF": 1},
}
"""How `build_fragments` reads colour, by its dtype."""


def group_count(count: int, size: int) -> int:
    """Return how many groups of a size hold a count."""
    return (count + size - 1) // size


class FragmentPasses:
    """Fragments of one strip, and its size; buffers are the context's named ones.

    Parameters
    ----------
    view : RgbdView
        The strip, with depth filled in; 0 in its hidden depth is nothing.
    layers : FrameLayers
    image : ImageCells
        Cells of the whole frame.
    corner_change_dpt : (rows + 1, columns + 1), float32
        Change of defocus at the corners of the cells.
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
        view: RgbdView,
        timer: StageTimer,
        *,
        layers: FrameLayers,
        image: ImageCells,
        corner_change_dpt: NDArray[np.float32],
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
        self.corner_change_dpt = corner_change_dpt
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

    def build_fragments(self) -> NDArray[np.bool_]:
        """Linear light, dioptres and layers; returns the used pairs."""
        n_words = words_per_cell(self.layers)
        used = np.zeros((self.image.count, n_words), np.uint32)
        n_pixels = self.surface_count * self.pixel_count
        self._reserve(PIXELS=16 * n_pixels, PIXEL_LAYER=4 * n_pixels)
        self.buffers["LAYER_DPT"] = self.gpu.upload(
            "LAYER_DPT", self.layers.layer_dpt.astype(np.float32)
        )
        self.buffers["FIELD_DEFOCUS"] = self.gpu.upload(
            "FIELD_DEFOCUS", self.corner_change_dpt
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

    @property
    def _max_level(self) -> int:
        """Level up to which fragments merge; the paper merges once."""
        if not self.merge:
            return 0
        most = 1 if self.paper_rule else MAX_LEVEL
        cell_px = self.image.cell_px
        return min(most, cell_px.bit_length() - 1) if cell_px else most

    def fragment_counts(self) -> tuple[int, int]:
        """Fragments after merging, and pixels that went into merged ones."""
        blocks = self.gpu.read(self.buffers["BLOCKS"], (self.block_count, 4), np.uint32)
        return int(blocks[:, 0].sum()), int(blocks[:, 3].sum())
