"""Spectacle lenses with lenslets around a clear center, for myopia control.

Each lenslet images a distant point without deviating its chief ray.  On the retina, all
lenslets together blur the point to a disc of power times diameter, 12 arcmin for 3.5
dpt and 1.03 mm, regardless of the pupil.  Gaze and field direction determine which
lenslets cover the pupil.  Their phase is applied unchanged in the plane of the pupil;
`bench corrections` measures the error of neglecting the 15 mm between lens and pupil.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.progressive import lens_point_mm
from estimator.optics.units import NM_PER_UM

EDGE_ORDERS = 4.0
"""Largest deflection by diffraction at the edges of lenslets that is included, in
wavelengths over their diameter."""


@dataclass(frozen=True)
class Lenslets:
    """A honeycomb of lenslets between two circles about the center of a lens.

    Attributes
    ----------
    power_dpt : float
        Power of a lenslet in addition to that of the carrier lens.
    diameter_mm, pitch_mm : float
        Diameter of a lenslet, and distance between the centers of neighbors.
    inner_mm, outer_mm : float
        Radii of the annulus that contains the centers of the lenslets.
    vertex_mm : float
        Distance from lens to cornea.
    gaze_deg : (h, v)
        Gaze relative to the head.
    centre_mm : (2,) or (P, 2)
        Position x, y of the lens center relative to the pupil center.
    """

    power_dpt: float
    diameter_mm: float
    pitch_mm: float
    inner_mm: float
    outer_mm: float
    vertex_mm: float = 12.0
    gaze_deg: tuple[float, float] = (0.0, 0.0)
    centre_mm: ArrayLike = (0.0, 0.0)

    @property
    def lattice_mm(self) -> tuple[float, float, float]:
        """Pitch, inner radius and outer radius of the honeycomb."""
        return self.pitch_mm, self.inner_mm, self.outer_mm

    def with_gaze_offset(self, offset_deg: tuple[float, float]) -> "Lenslets":
        """Return the lens after a rotation of gaze by (h, v) from ``gaze_deg``."""
        h_deg, v_deg = (
            gaze + offset
            for gaze, offset in zip(self.gaze_deg, offset_deg, strict=True)
        )
        return replace(self, gaze_deg=(h_deg, v_deg))

    def seen_from(self, h_deg: ArrayLike, v_deg: ArrayLike) -> "Lenslets":
        """Return the lens with its center for each of the field directions (P,)."""
        x, y = lens_point_mm(
            h_deg, v_deg, vertex_mm=self.vertex_mm, gaze_deg=self.gaze_deg
        )
        return replace(self, centre_mm=-np.stack([x, y], axis=-1))

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the power (1,) of the only sharp focus, that of the carrier lens."""
        return np.zeros(1)

    def main_light_ratio(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[Any]:
        """Return the share (1, ...) of the light at that focus, counted as 1."""
        return np.ones((1, *np.shape(radius_mm)))

    def reach_mrad(self, radius_mm: ArrayLike, wavelength_nm: float) -> NDArray[Any]:
        """Return the largest deflection (...) by refraction plus diffraction."""
        by_lens = abs(self.power_dpt) * self.diameter_mm / 2.0
        by_edge = EDGE_ORDERS * wavelength_nm / NM_PER_UM / self.diameter_mm
        return np.full(np.shape(radius_mm), by_lens + by_edge)

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude (...) at squared distances from the center."""
        square = np.asarray(square_mm2, dtype=np.float64)
        path_um = np.where(
            square <= (self.diameter_mm / 2.0) ** 2, self.power_dpt / 2.0 * square, 0.0
        )
        return np.exp(2j * np.pi * NM_PER_UM / wavelength_nm * path_um)
