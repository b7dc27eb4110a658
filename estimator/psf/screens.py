"""Complex amplitude of multifocal lenses in the pupil, tabulated.

It is a factor of the pupil function, which only wave optics supports.  The tables are
over the squared distance from the center, in which the zones of a lens are about
equally wide.
"""

from dataclasses import dataclass

import numpy as np
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
    offset_mm : (P, 2)
        Center of each pupil relative to the center of the screen.
    tables : (n_wavelengths, TABLE_COUNT) complex64
        Ascending wavelengths, the same as for the pupils.
    radius_mm : float
        Radius of the last entry.
    lattice_mm : (pitch, inner, outer)
        Honeycomb of centers, see `PupilScreen`; zeros for a single center.
    pixel_from_mrad : (P, 2, 2)
    reach_px : (P, 2)
        Largest additional deflection by the screen, x and y.
    """

    offset_mm: NDArray[np.float64]
    tables: NDArray[np.complex64]
    radius_mm: float
    lattice_mm: tuple[float, float, float]
    pixel_from_mrad: NDArray[np.float64]
    reach_px: NDArray[np.float64]

    @classmethod
    def from_screen(
        cls,
        screen: PupilScreen,
        *,
        pixel_from_mrad: NDArray[np.float64],
        pupil_ellipse: NDArray[np.float64],
        wavelength_nm: NDArray[np.float64],
    ) -> "ScreenTables":
        """Tabulate a screen; see `pupil.pupil_frames` for the pupils."""
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
            offset_mm=offset,
            tables=np.stack(
                [screen.transmission(square_mm2, nm) for nm in colors_nm.tolist()]
            ).astype(np.complex64),
            radius_mm=radius_mm,
            lattice_mm=lattice_mm,
            pixel_from_mrad=pixel_from_mrad,
            reach_px=reach_mrad[:, None] * np.linalg.norm(pixel_from_mrad, axis=2),
        )
