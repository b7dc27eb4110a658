"""From the pixels of an image to those that kernels are stored in, cell by cell."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

UNMOVED_PX = 0.5
"""Light that a map would move by less stays where it is stored: between stored pixels
it would blur by as much."""

MAX_REACH_PX = 255
"""A byte a side; light that a map takes beyond it is cut."""


@dataclass(frozen=True)
class CellMaps:
    """Maps of cells, each to its four field nodes.

    Attributes
    ----------
    node_from_cell : (n_cells, 4, 2, 2)
        From offsets in the cell's pixels (x right, y down) to those of the pixels that
        a node's kernels are stored in.
    """

    node_from_cell: NDArray[np.float64]

    @cached_property
    def cell_from_node(self) -> NDArray[np.float64]:
        """The other way (n_cells, 4, 2, 2)."""
        return np.linalg.inv(self.node_from_cell)

    @cached_property
    def area_ratio(self) -> NDArray[np.float64]:
        """Area (n_cells, 4) of a pixel of the cell in stored pixels."""
        return np.abs(np.linalg.det(self.node_from_cell))

    @cached_property
    def box_ratio(self) -> NDArray[np.float64]:
        """Area (n_cells, 4) over that of a box with the mapped pixel's sides."""
        diagonal = np.diagonal(self.node_from_cell, axis1=-2, axis2=-1)
        return self.area_ratio / np.abs(diagonal.prod(axis=-1))

    @cached_property
    def stretch_ratio(self) -> NDArray[np.float64]:
        """Most (n_cells, 4) by which a kernel is longer than as stored."""
        return np.linalg.norm(self.cell_from_node, ord=2, axis=(-2, -1))

    @cached_property
    def change_ratio(self) -> NDArray[np.float64]:
        """By how much (n_cells, 4) of its distance from the centre light moves."""
        return np.linalg.norm(self.node_from_cell - np.eye(2), axis=(-2, -1))

    @property
    def largest_stretch_ratio(self) -> float:
        """Of all cells; kernels that are read as stored are not shorter."""
        return float(max(1.0, self.stretch_ratio.max()))

    def is_moved(self, cells: NDArray, radius_px: NDArray) -> NDArray[np.bool_]:
        """Whether parts (n, 4) of kernels are mapped, or read as stored."""
        return self.change_ratio[cells] * radius_px > UNMOVED_PX

    def mapped_sizes(
        self,
        cells: NDArray[np.int64],
        is_moved: NDArray[np.bool_],
        reach_px: NDArray[np.int64],
        radius_px: NDArray[np.int64],
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Reaches (n, 4, 4) and radii (n, 4) of parts in the image's pixels.

        Light that is interpolated ends one stored pixel beyond the last one.
        """
        row, corner = np.nonzero(is_moved)
        out = self.cell_from_node[cells[row], corner]
        left, right, up, down = (reach_px[row, corner] + 1.0).T
        sides = []
        for axis in range(2):
            a, b = out[:, axis, 0], out[:, axis, 1]
            low = np.minimum(-a * left, a * right) + np.minimum(-b * up, b * down)
            high = np.maximum(-a * left, a * right) + np.maximum(-b * up, b * down)
            sides += [-low, high]
        reach_px, radius_px = reach_px.copy(), radius_px.copy()
        mapped_px = np.ceil(np.stack(sides, axis=-1) - 1e-9) - 1
        reach_px[row, corner] = np.clip(mapped_px, 0, MAX_REACH_PX)
        wider_px = self.stretch_ratio[cells[row], corner] * (
            radius_px[row, corner] + 1.0
        )
        radius_px[row, corner] = np.minimum(np.ceil(wider_px), MAX_REACH_PX)
        return reach_px, radius_px
