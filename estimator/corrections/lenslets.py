"""Spectacles with lenslets around a clear middle, as they are worn against myopia.

Each lenslet passes its own part of the light, and sends it on undeviated through its
middle: together they make a disc as wide as power times diameter on the retina, 12
arcmin for 3.5 dpt and 1.03 mm, whatever the pupil.  Which of them the pupil sees
depends on gaze and field.  The phase of the lens is taken straight on into the plane of
the pupil; `bench corrections` has what that leaves out on the 15 mm between.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.lens_plane import lens_point_mm
from estimator.optics.units import NM_PER_UM

EDGE_ORDERS = 4.0
"""Light that the edges of lenslets send aside is followed so far, in lambda over their
diameter."""


@dataclass(frozen=True)
class Lenslets:
    """A honeycomb of lenslets between two circles about the middle of a lens.

    Attributes
    ----------
    power_dpt : float
        That each adds.
    diameter_mm, pitch_mm : float
        Of one, and from one to the next.
    inner_mm, outer_mm : float
        Radii between which their middles lie.
    vertex_mm : float
        The lens before the cornea.
    gaze_deg : (h, v)
        Where the eye looks, from straight ahead of the head.
    centre_mm : (2,) or (P, 2)
        Middle of the lens from that of the pupil, x and y.
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
        """Pitch, inner and outer radius."""
        return self.pitch_mm, self.inner_mm, self.outer_mm

    def looking(self, gaze_deg: tuple[float, float]) -> "Lenslets":
        """Return the lens for an eye that looks so much farther aside and up."""
        h_deg, v_deg = (
            own + more for own, more in zip(self.gaze_deg, gaze_deg, strict=True)
        )
        return replace(self, gaze_deg=(h_deg, v_deg))

    def seen_from(self, h_deg: ArrayLike, v_deg: ArrayLike) -> "Lenslets":
        """Return the lens as it lies before the pupil at field directions (P,)."""
        x, y = lens_point_mm(
            h_deg, v_deg, vertex_mm=self.vertex_mm, gaze_deg=self.gaze_deg
        )
        return replace(self, centre_mm=-np.stack([x, y], axis=-1))

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Powers at which something is sharp: lenslets make no focus of their own."""
        return np.zeros(1)

    def main_light_ratio(self, radius_mm: ArrayLike, wavelength_nm: float) -> NDArray:
        """Share (1, ...) of a pupil's light there; of the lenslets' some is, too."""
        return np.ones((1, *np.shape(radius_mm)))

    def reach_mrad(self, radius_mm: ArrayLike, wavelength_nm: float) -> NDArray:
        """How far light goes aside, by the lenslets and by their edges."""
        by_lens = abs(self.power_dpt) * self.diameter_mm / 2.0
        by_edge = EDGE_ORDERS * wavelength_nm / NM_PER_UM / self.diameter_mm
        return np.full(np.shape(radius_mm), by_lens + by_edge)

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Complex amplitude at squared distances from the middle of a lenslet."""
        square = np.asarray(square_mm2, dtype=np.float64)
        path_um = np.where(
            square <= (self.diameter_mm / 2.0) ** 2, self.power_dpt / 2.0 * square, 0.0
        )
        return np.exp(2j * np.pi * NM_PER_UM / wavelength_nm * path_um)
