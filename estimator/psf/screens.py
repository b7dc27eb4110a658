"""Complex amplitude of multifocal lenses in the pupil, tabulated.

It is a factor of the pupil function, which only wave optics supports.  The tables are
over the squared distance from the center, in which the zones of a lens are about
equally wide.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.optics.pupil_screen import PupilScreen

TABLE_COUNT = 1 << 15
"""Entries of a table: 800 per zone if there are 40 waves over the pupil."""

BEYOND_EDGE = 1.5
"""Extent of tables in pupil radii: the smoothed edge extends beyond the pupil."""

ONE_CENTER = (0.0, 0.0, 0.0)
"""Value of the lattice for a single center."""


@dataclass(frozen=True)
class ScreenTables:
    """Tables of a screen for P pupils.

    Attributes
    ----------
    from_box_mm : (P, 2, 3)
        Affine map from box coordinates to the position relative to the screen's center.
    tables : (n_wavelengths, TABLE_COUNT) complex64
    which : (P,) int64
        Table of each pupil.
    radius_mm : float
        Radius of the last entry.
    lattice_mm : (pitch, inner, outer)
        Honeycomb of centers, see `PupilScreen`; zeros for a single center.
    reach_px : (P, 2)
        Largest additional deflection by the screen, x and y.
    """

    from_box_mm: NDArray[np.float64]
    tables: NDArray[np.complex64]
    which: NDArray[np.int64]
    radius_mm: float
    lattice_mm: tuple[float, float, float]
    reach_px: NDArray[np.float64]

    @classmethod
    def from_screen(
        cls,
        screen: PupilScreen,
        *,
        half_width_um_per_px: NDArray[np.float64],
        pixel_from_mrad: NDArray[np.float64],
        pupil_ellipse: NDArray[np.float64],
        wavelength_nm: NDArray[np.float64],
    ) -> "ScreenTables":
        """Tabulate a screen; see `pupil.pupil_frames` for the pupils."""
        matrix = np.swapaxes(pixel_from_mrad, 1, 2) * half_width_um_per_px[:, None, :]
        offset = pupil_ellipse[:, :2] - np.array(screen.centre_mm)
        largest_mm = pupil_ellipse[:, 2] + np.hypot(*offset.T)
        lattice_mm = screen.lattice_mm or ONE_CENTER
        radius_mm = BEYOND_EDGE * float(largest_mm.max())
        if screen.lattice_mm is not None:
            radius_mm = lattice_mm[0]
        square_mm2 = (np.arange(TABLE_COUNT) + 0.5) / TABLE_COUNT * radius_mm**2
        colors_nm, which = np.unique(wavelength_nm, return_inverse=True)
        reaches = [screen.reach_mrad(largest_mm, nm) for nm in colors_nm.tolist()]
        reach_mrad = np.stack(reaches)[which, np.arange(which.size)]
        return cls(
            from_box_mm=np.concatenate([matrix, offset[:, :, None]], axis=2),
            tables=np.stack(
                [screen.transmission(square_mm2, nm) for nm in colors_nm.tolist()]
            ).astype(np.complex64),
            which=which,
            radius_mm=radius_mm,
            lattice_mm=lattice_mm,
            reach_px=reach_mrad[:, None] * np.linalg.norm(pixel_from_mrad, axis=2),
        )

    def apply(
        self,
        members: NDArray[np.int64],
        samples: NDArray[np.float64],
        size: NDArray[np.int64],
        field: NDArray[np.complex64],
    ) -> None:
        """Multiply fields (B, My, N) by the screen; see `fill_pupils` for the grids."""
        _apply(
            self.from_box_mm[members],
            self.tables,
            self.which[members],
            TABLE_COUNT / self.radius_mm**2,
            self.lattice_mm,
            samples,
            size,
            field,
        )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _square_mm2(u: float, v: float, lattice: tuple[float, float, float]) -> float:
    """Return the squared distance from the nearest center, inf outside the lattice."""
    pitch, inner, outer = lattice
    if pitch == 0.0:
        return u * u + v * v
    row = math.sqrt(3.0) * pitch  # of every second row
    x, y = pitch * round(u / pitch), row * round(v / row)
    p = pitch * (round(u / pitch - 0.5) + 0.5)
    q = row * (round(v / row - 0.5) + 0.5)
    square, other = (u - x) ** 2 + (v - y) ** 2, (u - p) ** 2 + (v - q) ** 2
    if other < square:
        x, y, square = p, q, other
    if not inner * inner <= x * x + y * y <= outer * outer:
        return math.inf
    return square


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _apply(
    from_box: NDArray[np.float64],
    tables: NDArray[np.complex64],
    which: NDArray[np.int64],
    steps_per_mm2: float,
    lattice: tuple[float, float, float],
    samples: NDArray[np.float64],
    size: NDArray[np.int64],
    field: NDArray[np.complex64],
) -> None:
    last = tables.shape[1] - 1
    for b in range(field.shape[0]):
        m, table = from_box[b], tables[which[b]]
        columns, rows = size[b]
        for j in range(rows):
            y = (j - (rows - 1) / 2.0) * 2.0 / samples[b, 1]
            row = field[b, j]
            for i in range(columns):
                if row[i] == 0.0:
                    continue
                x = (i - (columns - 1) / 2.0) * 2.0 / samples[b, 0]
                u = m[0, 0] * x + m[0, 1] * y + m[0, 2]
                v = m[1, 0] * x + m[1, 1] * y + m[1, 2]
                step = _square_mm2(u, v, lattice) * steps_per_mm2
                row[i] *= table[last if step >= last else math.floor(step)]
