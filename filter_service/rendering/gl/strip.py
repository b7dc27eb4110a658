"""Size and buffers of a frame, or a strip of it, in the passes."""

from typing import Any

from filter_service.constants import BIN_TILES, TILE_SIZE_PX
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Buffer, BufferPart
from filter_service.gl.stage_timer import StageTimer
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rgbd_view import RgbdView

MAX_GROUPS = 65535
"""Work groups along one axis that every OpenGL 4.3 implementation allows."""


def group_count(count: int, size: int) -> int:
    """Return the number of groups of a size that hold a count."""
    return (count + size - 1) // size


def dispatch_grid(groups: int) -> tuple[int, int]:
    """Return columns and rows of at least this many groups, within OpenGL's limits."""
    columns = min(groups, MAX_GROUPS)
    return columns, group_count(groups, columns)


class Strip:
    """State shared by all passes of a strip; buffers are the context's named ones.

    Parameters
    ----------
    view : RgbdView
        The strip, with depth filled in; hidden depth is 0 where nothing is hidden.
    layers : FrameLayers
    paper_rule : bool
        Whether fragments are accumulated by the paper's rule.
    surface_count : int, optional
        Surfaces whose fragments follow each other in the blocks; by default those of
        the view, unless a test makes its own blocks.
    """

    def __init__(
        self,
        gpu: Gpu,
        view: RgbdView,
        timer: StageTimer,
        *,
        layers: FrameLayers,
        paper_rule: bool,
        surface_count: int | None = None,
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
        self.surface_count = surface_count or view.surface_count
        self.block_count = self.surface_count * self.tile_count
        self.bin_grid = tuple(group_count(side, BIN_TILES) for side in self.grid)
        self.bin_count = self.bin_grid[0] * self.bin_grid[1]
        self.buffers: dict[str, Buffer] = {}
        self.kernel_buffers: dict[str, BufferPart] = {}

    def reserve(self, **n_bytes: int) -> None:
        """Reserve buffers of these sizes by name."""
        for name, size in n_bytes.items():
            self.buffers[name] = self.gpu.storage(name, size)

    def run(
        self, name: str, groups: tuple[int, ...], *bindings: str, **uniforms: Any
    ) -> None:
        """Dispatch a pass on buffers given by name."""
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
