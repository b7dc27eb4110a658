"""One frame, or a strip of it, on its way through the passes: its size, its buffers."""

from filter_service.constants import BIN_TILES, TILE_SIZE_PX
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Buffer
from filter_service.gl.stage_timer import StageTimer
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rgbd_view import RgbdView

MAX_GROUPS = 65535
"""Work groups along one axis that every OpenGL 4.3 allows."""


def group_count(count: int, size: int) -> int:
    """Return how many groups of a size hold a count."""
    return (count + size - 1) // size


def grid_of(groups: int) -> tuple[int, int]:
    """Return columns and rows of at least so many groups, of those OpenGL allows."""
    columns = min(groups, MAX_GROUPS)
    return columns, group_count(groups, columns)


class Strip:
    """What all passes of a strip share; buffers are the context's named ones.

    Parameters
    ----------
    view : RgbdView
        The strip, with depth filled in; 0 in its hidden depth is nothing.
    layers : FrameLayers
    paper_rule : bool
        Fragments add up as the paper has it.
    surface_count : int, optional
        Surfaces whose fragments lie one behind the other in the blocks; those of the
        view unless a test makes blocks of its own.
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

    def reserve(self, **n_bytes: int) -> None:
        """Get buffers of these sizes by name."""
        for name, size in n_bytes.items():
            self.buffers[name] = self.gpu.storage(name, size)

    def run(self, name: str, groups: tuple[int, ...], *bindings: str, **uniforms):
        """Dispatch a pass on buffers by name."""
        defines = uniforms.pop("defines", None)
        textures = uniforms.pop("textures", None)
        indirect = uniforms.pop("indirect", None)
        self.gpu.passes.dispatch(
            name,
            groups,
            buffers={binding: self.buffers[binding] for binding in bindings},
            uniforms=uniforms,
            defines=defines,
            textures=textures,
            indirect=indirect,
        )
