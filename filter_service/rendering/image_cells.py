"""The image in square cells, each with one set of kernels.

PSFs change slowly over the field, so all pixels of a cell share the kernels of the
cell's middle direction, blended there from the four field nodes around it.  That costs
a frame one look-up per fragment and pixel, on axis and off, where blending in the
splatting loop costs four (paper section 6.3).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from filter_service.planning.field_directions import field_deg
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import bracket_axis
from filter_service.planning.plan import CachePlan

CELL_DEG = {"quality": 2.0, "dynamic": 4.0}
"""Largest edge of a cell on the camera's axis.  One kernel set a cell is what limits
frames off the axis: at 640x360 cells of 16 px (2.4 degrees) cost 52 to 55 dB against
cells of 8 px; at 320x180 and the finest field nodes, cells of 8 px (2.3 degrees) leave
49 dB against the exact PSF of every pixel (bench_field), and 4 px would leave 54 dB."""

MIN_CELL_PX = 8
MAX_CELL_PX = 256
"""Cells are powers of two: tiles and merged quads lie in one cell."""

CORNERS = 4


@dataclass(frozen=True)
class ImageCells:
    """Cells of an image, in scan order.

    Attributes
    ----------
    cell_px : int
        Edge; 0 where one cell is the whole image.
    grid : (columns, rows)
    nodes : (n_cells, 4)
        Field nodes around a cell's middle, index into [v, h] in C order.
    weight_ratio : (n_cells, 4)
        Of the nodes; sum 1.
    """

    cell_px: int
    grid: tuple[int, int]
    nodes: NDArray[np.int64]
    weight_ratio: NDArray[np.float64]

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.grid[0] * self.grid[1]

    @property
    def is_single_node(self) -> bool:
        """Whether the whole image has the kernels of one field node."""
        return self.count == 1 and self.weight_ratio[0, 0] == 1.0


def image_cells(
    spec: GridSpec, plan: CachePlan, gaze_deg: tuple[float, float] | None = None
) -> ImageCells:
    """Cells of the spec's camera and their field nodes.

    Parameters
    ----------
    gaze_deg : (h, v), optional
        Where the eye looks; the spec's where it is None.
    """
    if not spec.follows_field:
        return ImageCells(
            cell_px=0,
            grid=(1, 1),
            nodes=np.zeros((1, CORNERS), np.int64),
            weight_ratio=np.array([[1.0, 0.0, 0.0, 0.0]]),
        )
    cell_px = _cell_px(spec)
    camera = spec.camera
    grid = (-(-camera.width_px // cell_px), -(-camera.height_px // cell_px))
    x_px, y_px = np.meshgrid(
        *((np.arange(n) + 0.5) * cell_px for n in grid), indexing="xy"
    )
    # The last cells may reach beyond the image.
    h_deg, v_deg = field_deg(
        camera,
        np.minimum(x_px, camera.width_px).ravel(),
        np.minimum(y_px, camera.height_px).ravel(),
        gaze_deg=spec.gaze_deg if gaze_deg is None else gaze_deg,
    )
    h_low, h_high, h_part = bracket_axis(plan.h_deg, h_deg)
    v_low, v_high, v_part = bracket_axis(plan.v_deg, v_deg)
    n_h = plan.h_deg.size
    nodes = [v * n_h + h for v in (v_low, v_high) for h in (h_low, h_high)]
    weights = [v * h for v in (1 - v_part, v_part) for h in (1 - h_part, h_part)]
    return ImageCells(
        cell_px=cell_px,
        grid=grid,
        nodes=np.stack(nodes, axis=-1),
        weight_ratio=np.stack(weights, axis=-1),
    )


def _cell_px(spec: GridSpec) -> int:
    pixel_deg = math.degrees(min(spec.pixel_pitch_mrad) / 1000.0)
    power = math.floor(math.log2(max(CELL_DEG[spec.mode] / pixel_deg, 1.0)))
    return min(max(2**power, MIN_CELL_PX), MAX_CELL_PX)
