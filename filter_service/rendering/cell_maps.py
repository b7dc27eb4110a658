"""From the pixels of an image to those that kernels are stored in, cell by cell."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

UNMOVED_PX = 0.5
"""Light that a map would move by less stays where it is stored: between stored pixels
it would blur by as much."""

UNMOVED_RATIO = 0.1
"""Maps that change a kernel's size by less are left out: what four field nodes around a
cell differ in is blended away.  At 5 mm over the field of the demo that leaves 63 to 69
dB to the picture with all maps (cataract, myopia, keratoconus), and takes half of the
time of the blend."""

MAX_REACH_PX = 255
"""A byte a side; light that a map takes beyond it is cut."""


class MapTables(NamedTuple):
    """Maps of cells and what follows from them.

    Attributes
    ----------
    node_from_cell, cell_from_node : (n_cells, 4, 2, 2)
        The map and its inverse.
    area_ratio : (n_cells, 4)
        Area of a pixel of the cell in stored pixels.
    box_ratio : (n_cells, 4)
        That area over that of a box with the mapped pixel's sides.
    stretch_ratio : (n_cells, 4)
        Most by which a kernel is longer than as stored.
    change_ratio : (n_cells, 4)
        By how much of its distance from the centre light moves.
    """

    node_from_cell: NDArray[np.float64]
    cell_from_node: NDArray[np.float64]
    area_ratio: NDArray[np.float64]
    box_ratio: NDArray[np.float64]
    stretch_ratio: NDArray[np.float64]
    change_ratio: NDArray[np.float64]


@dataclass(frozen=True)
class CellMaps:
    """Maps of cells, each to its four field nodes.

    A kernel's part is mapped where `moves` says so; else it is read as stored.

    Attributes
    ----------
    node_from_cell : (n_cells, 4, 2, 2)
        From offsets in the cell's pixels (x right, y down) to those of the pixels that
        a node's kernels are stored in.
    """

    node_from_cell: NDArray[np.float64]

    @cached_property
    def tables(self) -> MapTables:
        """The maps in one layout, with their sizes."""
        maps = np.array(self.node_from_cell, np.float64, order="C")
        ratios = np.empty((4, *maps.shape[:2]))
        inverse = np.empty_like(maps)
        _fill_ratios(maps, inverse, ratios)
        return MapTables(maps, inverse, *(ratio.copy() for ratio in ratios))

    @property
    def largest_stretch_ratio(self) -> float:
        """Of all cells; kernels that are read as stored are not shorter."""
        return float(max(1.0, self.tables.stretch_ratio.max()))


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_ratios(maps, inverse, ratios):
    """Inverses of maps (n, 4, 2, 2), and ratios (4, n, 4) as in `MapTables`."""
    for cell in range(maps.shape[0]):
        for j in range(maps.shape[1]):
            a, b = maps[cell, j, 0, 0], maps[cell, j, 0, 1]
            c, d = maps[cell, j, 1, 0], maps[cell, j, 1, 1]
            area = a * d - b * c
            inverse[cell, j, 0, 0], inverse[cell, j, 0, 1] = d / area, -b / area
            inverse[cell, j, 1, 0], inverse[cell, j, 1, 1] = -c / area, a / area
            # Largest singular value of the map over its area is that of the inverse.
            longest = 0.5 * (math.hypot(a + d, b - c) + math.hypot(a - d, b + c))
            ratios[0, cell, j] = abs(area)
            ratios[1, cell, j] = abs(area) / abs(a * d)
            ratios[2, cell, j] = longest / abs(area)
            off = (a - 1.0) ** 2 + b**2 + c**2 + (d - 1.0) ** 2
            ratios[3, cell, j] = math.sqrt(off)


@njit(cache=True, nogil=True, error_model="numpy")
def moves(change_ratio, radius_px):
    """Whether a map is worth applying to a kernel."""
    return change_ratio > UNMOVED_RATIO and change_ratio * radius_px > UNMOVED_PX


@njit(cache=True, nogil=True, error_model="numpy")
def mapped_reach(out, cell, corner, reach_px):
    """Bring reaches (left, right, up, down) to the image's pixels, in place.

    Light that is interpolated ends one stored pixel beyond the last one.
    """
    left, right, up, down = reach_px
    for axis in range(2):
        a, b = out[cell, corner, axis, 0], out[cell, corner, axis, 1]
        low = min(-a * (left + 1.0), a * (right + 1.0))
        low += min(-b * (up + 1.0), b * (down + 1.0))
        high = max(-a * (left + 1.0), a * (right + 1.0))
        high += max(-b * (up + 1.0), b * (down + 1.0))
        for side, end in ((2 * axis, -low), (2 * axis + 1, high)):
            whole_px = math.ceil(end - 1e-9) - 1
            reach_px[side] = min(max(whole_px, 0), MAX_REACH_PX)
