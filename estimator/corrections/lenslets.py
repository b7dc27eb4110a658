"""Spectacles with lenslets around a clear center, worn for myopia control.

Each lenslet passes its own part of the light, undeviated through its center.  Together
they make a disc as wide as power times diameter on the retina, 12 arcmin for 3.5 dpt
and 1.03 mm, for any pupil.  Which lenslets the pupil sees depends on gaze and field.
The phase of the lens is applied unchanged in the plane of the pupil; `bench
corrections` measures the error of ignoring the 15 mm between lens and pupil.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.lens_plane import lens_point_mm
from estimator.optics.units import NM_PER_UM

EDGE_ORDERS = 4.0
"""Limit up to which light deflected by the edges of lenslets is included, in lambda
over their diameter."""


@dataclass(frozen=True)
class Lenslets:
    """A honeycomb of lenslets between two circles about the center of a lens.

    Attributes
    ----------
    power_dpt : float
        Added power of each lenslet.
    diameter_mm, pitch_mm : float
        Diameter of a lenslet, and distance to the next.
    inner_mm, outer_mm : float
        Radii between which the lenslets' centers lie.
    vertex_mm : float
        Distance from lens to cornea.
    gaze_deg : (h, v)
        Gaze relative to straight ahead of the head.
    centre_mm : (2,) or (P, 2)
        Center of the lens from that of the pupil, x and y.
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
        """Pitch, inner and outer radius of the honeycomb."""
        return self.pitch_mm, self.inner_mm, self.outer_mm

    def looking(self, gaze_deg: tuple[float, float]) -> "Lenslets":
        """Return the lens for a gaze rotated by (h, v) from the present one."""
        h_deg, v_deg = (
            own + more for own, more in zip(self.gaze_deg, gaze_deg, strict=True)
        )
        return replace(self, gaze_deg=(h_deg, v_deg))

    def seen_from(self, h_deg: ArrayLike, v_deg: ArrayLike) -> "Lenslets":
        """Return the lens as seen from the pupil at field directions (P,)."""
        x, y = lens_point_mm(
            h_deg, v_deg, vertex_mm=self.vertex_mm, gaze_deg=self.gaze_deg
        )
        return replace(self, centre_mm=-np.stack([x, y], axis=-1))

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the powers of sharp foci; lenslets make no focus of their own."""
        return np.zeros(1)

    def main_light_ratio(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[Any]:
        """Return the share (1, ...) of a pupil's light there, lenslets' included."""
        return np.ones((1, *np.shape(radius_mm)))

    def reach_mrad(self, radius_mm: ArrayLike, wavelength_nm: float) -> NDArray[Any]:
        """Return the largest deflection of light by the lenslets and their edges."""
        by_lens = abs(self.power_dpt) * self.diameter_mm / 2.0
        by_edge = EDGE_ORDERS * wavelength_nm / NM_PER_UM / self.diameter_mm
        return np.full(np.shape(radius_mm), by_lens + by_edge)

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude at squared distances from a lenslet's center."""
        square = np.asarray(square_mm2, dtype=np.float64)
        path_um = np.where(
            square <= (self.diameter_mm / 2.0) ** 2, self.power_dpt / 2.0 * square, 0.0
        )
        return np.exp(2j * np.pi * NM_PER_UM / wavelength_nm * path_um)
