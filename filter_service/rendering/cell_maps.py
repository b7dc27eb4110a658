"""Linear maps from the pixels of an image cell to the pixels of stored kernels."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.native import loops


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
    see `MIN_SHIFT_RATIO`.

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

    @property
    def largest_stretch_ratio(self) -> float:
        """Largest stretch ratio of all cells, at least 1."""
        return float(max(1.0, self.tables.stretch_ratio.max()))
