"""Size and buffers of a frame, or a strip of it, in the passes."""

from typing import Any, Protocol

from filter_service.camera import Tangents
from filter_service.constants import BIN_TILES, MAX_GROUPS, TILE_SIZE_PX
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Buffer, BufferPart
from filter_service.gl.stage_timer import Timer
from filter_service.psfs.frame_layers import FrameLayers


def group_count(count: int, size: int) -> int:
    """Return the number of groups of ``size`` elements for ``count`` elements."""
    return (count + size - 1) // size


def dispatch_grid(groups: int) -> tuple[int, int]:
    """Return a dispatch (columns, rows) with at least this many work groups."""
    columns = min(groups, MAX_GROUPS)
    return columns, group_count(groups, columns)


class StripView(Protocol):
    """What the passes of a strip need to know of its image."""

    @property
    def width_px(self) -> int: ...  # noqa: D102
    @property
    def height_px(self) -> int: ...  # noqa: D102
    @property
    def tangents(self) -> Tangents: ...  # noqa: D102
    @property
    def depth_kind(self) -> str: ...  # noqa: D102
    @property
    def surface_count(self) -> int: ...  # noqa: D102


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
        view: StripView,
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
