"""Size and buffers of a strip of a frame in the passes, and division into strips."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from filter_service.constants import BIN_SIZE_PX, BIN_TILES, MAX_GROUPS, TILE_SIZE_PX
from filter_service.errors import OutOfGpuMemory
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Buffer, BufferPart
from filter_service.gl.stage_timer import Timer
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.frame import map_images
from filter_service.rgbd_view import RgbdView
from filter_service.texture_view import TextureView


def group_count(count: int, size: int) -> int:
    """Return the number of groups of ``size`` elements for ``count`` elements."""
    return (count + size - 1) // size


def dispatch_grid(groups: int) -> tuple[int, int]:
    """Return a dispatch (columns, rows) with at least this many work groups."""
    columns = min(groups, MAX_GROUPS)
    return columns, group_count(groups, columns)


class Strip:
    """State that all passes of a strip share; its buffers belong to the context.

    Parameters
    ----------
    view : RgbdView or TextureView
        The strip; hidden depth is 0 where the hidden layer is empty.
    layers : FrameLayers
    paper_rule : bool
        Whether the paper's rule accumulates the fragments.
    """

    def __init__(
        self,
        gpu: Gpu,
        view: RgbdView | TextureView,
        timer: Timer,
        *,
        layers: FrameLayers,
        paper_rule: bool,
    ):
        self.gpu = gpu
        self.view = view
        self.timer = timer
        self.layers = layers
        self.paper_rule = paper_rule
        self.size = (view.width_px, view.height_px)
        self.pixel_count = view.width_px * view.height_px
        self.grid = tuple(group_count(side, TILE_SIZE_PX) for side in self.size)
        self.tile_count = self.grid[0] * self.grid[1]
        self.surface_count = view.surface_count
        self.block_count = self.surface_count * self.tile_count
        self.bin_grid = tuple(group_count(side, BIN_TILES) for side in self.grid)
        self.bin_count = self.bin_grid[0] * self.bin_grid[1]
        self.buffers: dict[str, Buffer] = {}
        self.kernel_buffers: dict[str, Buffer | BufferPart] = {}

    def reserve(self, **n_bytes: int) -> None:
        """Allocate named buffers of at least these sizes."""
        for name, size in n_bytes.items():
            self.buffers[name] = self.gpu.storage(name, size)

    def run(
        self, name: str, groups: tuple[int, ...], *bindings: str, **uniforms: Any
    ) -> None:
        """Dispatch a pass on the named buffers."""
        defines = uniforms.pop("defines", None)
        textures = uniforms.pop("textures", None)
        indirect = uniforms.pop("indirect", None)
        self.gpu.passes.dispatch(
            name,
            groups,
            buffers={
                binding: self.kernel_buffers.get(binding) or self.buffers[binding]
                for binding in bindings
            },
            uniforms=uniforms,
            defines=defines,
            textures=textures,
            indirect=indirect,
        )

    def refresh(self) -> None:
        """Take the buffers that now have the names of this strip's buffers."""
        self.buffers = {name: self.gpu.buffers[name] for name in self.buffers}


BYTES_PER_PIXEL = 16
"""Bytes per pixel and surface in the largest buffers."""


@dataclass(frozen=True)
class Rows:
    """A strip: rows of a frame that the passes process together.

    Attributes
    ----------
    view : RgbdView
        The strip's part of the image, with a halo: all rows whose light reaches it.
    first_row : int
        First row of ``view`` within the frame.
    output_rows : slice
        Rows of ``view`` without the halo.
    """

    view: RgbdView
    first_row: int
    output_rows: slice


def split_into_strips(
    view: RgbdView, reach_of: Callable[[], int], max_block_bytes: int
) -> list[Rows]:
    """Divide a frame so that each strip's buffers fit a storage block.

    Strips start at multiples of a bin, so that fragment lists and merged squares are
    the same as for the whole frame.

    Parameters
    ----------
    reach_of : callable
        Function that returns the largest reach, px; only called if the frame must be
        divided.
    """
    padded_width = -(-view.width_px // TILE_SIZE_PX) * TILE_SIZE_PX
    rows = max_block_bytes // (view.surface_count * BYTES_PER_PIXEL * padded_width)
    rows = rows // BIN_SIZE_PX * BIN_SIZE_PX
    if rows >= view.height_px:
        return [Rows(view, 0, slice(None))]
    reach_px = reach_of()
    halo = -(-reach_px // BIN_SIZE_PX) * BIN_SIZE_PX
    step = rows - 2 * halo
    if step < BIN_SIZE_PX:
        raise OutOfGpuMemory(
            f"an image {view.width_px} px wide with {reach_px} px of blur: a strip "
            f"does not fit a storage block of {max_block_bytes / 1e6:.0f} MB"
        )
    strips = []
    for top in range(0, view.height_px, step):
        bottom = min(top + step, view.height_px)
        first, last = max(top - halo, 0), min(bottom + halo, view.height_px)
        strips.append(
            Rows(
                view=_rows_of(view, first, last),
                first_row=first,
                output_rows=slice(top - first, bottom - first),
            )
        )
    return strips


def _rows_of(view: RgbdView, first: int, last: int) -> RgbdView:
    """Return rows first..last of a view, with the tangents of their edges."""
    left, right, up, down = view.tangents
    per_row = (down - up) / view.height_px
    return map_images(
        view,
        lambda image: np.ascontiguousarray(image[first:last]),
        (left, right, up + first * per_row, up + last * per_row),
    )


def counted_px(rows: Rows, view: RgbdView, border_px: int) -> tuple[int, int, int, int]:
    """Return the pixels (left, top, right, bottom) of a strip that are counted."""
    top, bottom = (
        border_px - rows.first_row,
        border_px + view.height_px - rows.first_row,
    )
    first, last, _ = rows.output_rows.indices(rows.view.height_px)
    return border_px, max(top, first), border_px + view.width_px, min(bottom, last)
