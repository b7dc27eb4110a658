"""Square cells of the image, whose pixels share kernels, and their linear maps.

PSFs change slowly over the field, so all pixels of a cell use the kernels of the cell's
center, a weighted sum of the kernels of the three field nodes around it.  Splatting
then needs one kernel lookup per fragment and pixel, on axis and off axis; blending
inside the splatting loop needs four (paper section 6.3).  Two faster changes over the
field are treated separately: a linear map converts each node's kernel from the pixels
it is stored in to the pixels of the cell, and each pixel has its own defocus, by its
layer.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import FIELD_CORNERS
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.planning.grid import GridSpec, field_deg
from filter_service.planning.nodes import PlanAxes, bracket_axis, triangle


class MapTables(NamedTuple):
    """Maps of cells, and quantities derived from the maps.

    Attributes
    ----------
    node_from_cell, cell_from_node : (n_cells, 3, 2, 2)
        The map and its inverse.
    area_ratio : (n_cells, 3)
        Area of a pixel of the cell in stored pixels.
    box_ratio : (n_cells, 3)
        That area over the area of a box with the mapped pixel's sides.
    stretch_ratio : (n_cells, 3)
        Largest elongation of a kernel relative to its stored form.
    change_ratio : (n_cells, 3)
        Displacement of light over its distance from the kernel's center.
    """

    node_from_cell: NDArray[np.float64]
    cell_from_node: NDArray[np.float64]
    area_ratio: NDArray[np.float64]
    box_ratio: NDArray[np.float64]
    stretch_ratio: NDArray[np.float64]
    change_ratio: NDArray[np.float64]


@dataclass(frozen=True)
class CellMaps:
    """Maps of cells, each to its three field nodes.

    A part of a kernel is resampled by its map only if the map changes it noticeably,
    and in part if it is close to that, see `MIN_SHIFT_RATIO`.

    Attributes
    ----------
    node_from_cell : (n_cells, 3, 2, 2)
        Map from offsets in the cell's pixels (x right, y down) to offsets in the
        pixels of a node's stored kernels.
    """

    node_from_cell: NDArray[np.float64]

    @cached_property
    def tables(self) -> MapTables:
        """Maps in one memory layout, with the ratios derived from them."""
        maps = np.array(self.node_from_cell, np.float64, order="C")
        ratios = np.empty((4, *maps.shape[:2]))
        inverse = np.empty_like(maps)
        loops().call("map_ratios", maps, maps.size // 4, inverse, ratios)
        return MapTables(maps, inverse, *ratios)

    @cached_property
    def record(self) -> records.MapTables:
        """The tables as a C record."""
        return records.MapTables(**pointers(**self.tables._asdict()))

    @property
    def largest_stretch_ratio(self) -> float:
        """Largest stretch ratio of all cells, at least 1."""
        return float(max(1.0, self.tables.stretch_ratio.max()))


CELL_DEG = {"quality": 2.0, "dynamic": 4.0}
"""Largest edge of a cell on the camera's axis.  At 640x360 and nodes for 49 dB, cells
of 8 and 16 px (1.2 and 2.4 degrees) result in a PSNR of 46.9 and 46.8 dB for myopia,
48.3 and 47.4 dB for keratoconus, and 51.0 and 50.1 dB for cataract, whose kernels take
611 and 268 MB."""

TEXELS_PER_PIXEL = 10.0
"""Largest number of texels of a frame's level-0 kernels, per pixel.  If there are more,
the cells become twice as wide to save memory.  With 16 bytes per texel, the limit is
150 MB at 1280x720."""

EXACT_CELL_DEG = {"quality": 0.5, "dynamic": 1.0}
"""Largest edge of a cell on the camera's axis for frames with a render tolerance of 0,
whose pixels blend the kernels of cells."""

EXACT_TEXELS = 48_000_000
"""Largest number of texels of the level-0 kernels of such a frame: 770 MB."""

MIN_CELL_PX = 4
MAX_CELL_PX = 256
"""Cell edges are powers of two, so that each merged square lies within one cell."""


class KernelsTooLarge(Exception):
    """A frame's kernels need too much memory; engines retry with larger cells."""


@dataclass(frozen=True)
class ImageCells:
    """Cells of an image, in scan order.

    Attributes
    ----------
    cell_px : int
        Edge of a cell; 0 if one cell is the whole image.
    grid : (columns, rows)
    nodes : (n_cells, 3)
        Field nodes around each cell's center: indices into [v, h] in C order.
    weight_ratio : (n_cells, 3)
        Weights of the nodes; their sum is 1.
    maps : CellMaps
        Maps to the pixels of the nodes' stored kernels.
    corner_h_deg, corner_v_deg : (rows + 1, columns + 1)
        Field directions of the cells' corners.
    centers_px : (columns,), (rows,)
        Positions of the cells' centers if pixels blend the kernels of cells; empty
        otherwise.
    """

    cell_px: int
    grid: tuple[int, int]
    nodes: NDArray[np.int64]
    weight_ratio: NDArray[np.float64]
    maps: CellMaps
    corner_h_deg: NDArray[np.float64]
    corner_v_deg: NDArray[np.float64]
    centers_px: tuple[NDArray[np.float64], ...] = ()

    @property
    def blends(self) -> bool:
        """Whether each pixel blends the kernels of the cells around it."""
        return bool(self.centers_px)

    def blending(
        self, axis: int, places_px: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the cell before each of some pixels (n,), and the share of the next.

        Parameters
        ----------
        axis : int
            0 for columns, 1 for rows.
        """
        first, _, share = bracket_axis(self.centers_px[axis], places_px + 0.5)
        return first.astype(np.int32), share.astype(np.float32)

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """The weights in C order."""
        return np.ascontiguousarray(self.weight_ratio)

    @cached_property
    def read_nodes(self) -> NDArray[np.int64]:
        """The nodes in C order, with the heaviest in place of those of weight 0."""
        heaviest = self.weight_ratio.argmax(axis=1)[:, None]
        heaviest = np.take_along_axis(self.nodes, heaviest, axis=1)
        is_read = self.weight_ratio > 0.0
        return np.ascontiguousarray(np.where(is_read, self.nodes, heaviest), np.int64)

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.grid[0] * self.grid[1]


def image_cells(
    spec: GridSpec,
    plan: PlanAxes,
    gaze_deg: tuple[float, float] | None = None,
    *,
    cell_px: int | None = None,
    node_scale: NDArray[np.float64] | None = None,
    can_blend: bool = False,
) -> ImageCells:
    """Return the cells of the spec's camera and their field nodes.

    Parameters
    ----------
    gaze_deg : (h, v), optional
        Gaze of the eye; the spec's by default.
    cell_px : int, optional
        Edge of the cells, if larger than the default; their kernels need less memory.
    node_scale : (n_fields, 2, 2), optional
        `stored_scale` of the plan, if already computed.
    can_blend : bool
        Whether the engine can blend the kernels of cells, as frames with a render
        tolerance of 0 require; if it cannot, their cells are smaller.
    """
    if not spec.follows_field:
        return ImageCells(
            cell_px=0,
            grid=(1, 1),
            nodes=np.zeros((1, FIELD_CORNERS), np.int64),
            weight_ratio=np.array([[1.0, 0.0, 0.0]]),
            maps=CellMaps(np.broadcast_to(np.eye(2), (1, FIELD_CORNERS, 2, 2))),
            corner_h_deg=np.zeros((2, 2)),
            corner_v_deg=np.zeros((2, 2)),
        )
    gaze_deg = spec.settings.gaze_deg if gaze_deg is None else gaze_deg
    blends = can_blend and spec.is_exact
    cell_px = cell_px or default_cell_px(spec, blends=blends)
    camera = spec.camera
    grid = (-(-camera.width_px // cell_px), -(-camera.height_px // cell_px))
    # The last cells may extend beyond the image.
    centers_px = tuple(
        np.minimum((np.arange(n) + 0.5) * cell_px, size)
        for n, size in zip(grid, (camera.width_px, camera.height_px), strict=True)
    )
    x_px, y_px = np.meshgrid(*centers_px, indexing="xy")
    h_deg, v_deg = field_deg(camera, x_px.ravel(), y_px.ravel(), gaze_deg=gaze_deg)
    nodes, weight_ratio = _field_nodes(plan, h_deg, v_deg)
    scale = spec.pixel_from_mrad(h_deg, v_deg, gaze_deg=gaze_deg)
    corner_h_deg, corner_v_deg = field_deg(
        camera,
        np.arange(grid[0] + 1) * cell_px,
        np.arange(grid[1] + 1)[:, None] * cell_px,
        gaze_deg=gaze_deg,
    )
    if node_scale is None:
        node_scale = stored_scale(spec, plan)
    return ImageCells(
        cell_px=cell_px,
        grid=grid,
        nodes=nodes,
        weight_ratio=weight_ratio,
        maps=CellMaps(_node_from_cell(node_scale[nodes], scale)),
        corner_h_deg=corner_h_deg,
        corner_v_deg=corner_v_deg,
        centers_px=centers_px if blends else (),
    )


def _field_nodes(
    plan: PlanAxes, h_deg: NDArray[np.float64], v_deg: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return nodes and barycentric weights (n_cells, 3) of each direction's triangle.

    Each rectangle of nodes is divided along the diagonal that is not radial, because
    kernels change fastest in the radial direction.  With the other diagonal, the median
    error of frames is 0.5 dB larger.
    """
    h_low, h_high, h_part = bracket_axis(plan.h_deg, h_deg)
    v_low, v_high, v_part = bracket_axis(plan.v_deg, v_deg)
    middle_h_deg = plan.h_deg[h_low] + plan.h_deg[h_high]
    middle_v_deg = plan.v_deg[v_low] + plan.v_deg[v_high]
    is_turned = middle_h_deg * middle_v_deg >= 0.0
    h_first, h_last = np.where(is_turned, (h_high, h_low), (h_low, h_high))
    weights, is_first = triangle(np.where(is_turned, 1.0 - h_part, h_part), v_part)
    v_between, h_between = np.where(is_first, (v_low, h_last), (v_high, h_first))
    rows = np.stack([v_low, v_between, v_high], axis=-1)
    columns = np.stack([h_first, h_between, h_last], axis=-1)
    return rows * plan.h_deg.size + columns, weights


def can_coarsen(image: ImageCells) -> bool:
    """Return whether larger cells are possible."""
    return 0 < image.cell_px < MAX_CELL_PX


def check_texels(n_texels: int, image: ImageCells, spec: GridSpec) -> None:
    """Check the texel count of a frame's level-0 kernels.

    Raises
    ------
    KernelsTooLarge
        There are more than `TEXELS_PER_PIXEL`, and wider cells are possible.
    """
    if not can_coarsen(image):
        return
    allowed = TEXELS_PER_PIXEL * spec.camera.pixel_count
    if spec.is_exact:
        allowed = max(allowed, EXACT_TEXELS)
    if n_texels > allowed:
        raise KernelsTooLarge(
            f"the frame's kernels have {n_texels} texels; expected at most {allowed:g}"
        )


def stored_scale(spec: GridSpec, plan: PlanAxes) -> NDArray[np.float64]:
    """Return pixels per mrad (n_fields, 2, 2) of the nodes' stored kernels."""
    return spec.node_pixel_from_mrad(*plan.field_nodes_deg)


def _node_from_cell(
    node_scale: NDArray[np.float64], cell_scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return maps (n_cells, 3, 2, 2) between offsets in pixels, y down."""
    upward = node_scale @ np.linalg.inv(cell_scale)[:, None]
    return upward * np.array([[1.0, -1.0], [-1.0, 1.0]])


def default_cell_px(spec: GridSpec, *, blends: bool = False) -> int:
    """Return the edge of cells unless their kernels need too much memory."""
    pixel_deg = math.degrees(min(spec.pixel_pitch_mrad) / 1000.0)
    cell_deg, least_px = CELL_DEG[spec.settings.mode], MIN_CELL_PX
    if spec.is_exact:
        cell_deg, least_px = EXACT_CELL_DEG[spec.settings.mode], 1
        if not blends:
            cell_deg /= 4.0
    power = math.floor(math.log2(max(cell_deg / pixel_deg, 1.0)))
    return min(max(2**power, least_px), MAX_CELL_PX)
