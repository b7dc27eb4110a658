"""One wavefront in the pupil, and its optical transfer function."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator import Rings, Transfer, optical_transfer

SECOND_ORDER = slice(3, 6)
TILTS = slice(1, 3)


@dataclass(frozen=True)
class PupilWavefront:
    """The wavefront of a point and its pupil.

    Attributes
    ----------
    zernike_um : (28,)
        Coefficients on the circle of ``circle_diameter_mm``, in the plane of the
        entrance pupil.
    pupil_ellipse : (5,)
        Pupil within the circle: center x, y and semi-axes, mm, and angle, rad.
    rings : Rings or None
        Rings that produce several foci, or lenslets in front of the pupil.
    """

    zernike_um: NDArray[np.float64]
    circle_diameter_mm: float
    pupil_ellipse: NDArray[np.float64]
    wavelength_nm: float
    rings: Rings | None = None

    @property
    def is_readable(self) -> bool:
        """Return whether acuity and contrast are known; not through lenslets."""
        return self.rings is None or self.rings.lattice_mm is None

    def best_corrected(self) -> PupilWavefront:
        """Return the wavefront with sphere and cylinder of this pupil corrected."""
        zernike_um = self.zernike_um.copy()
        zernike_um[SECOND_ORDER] = 0.0
        return replace(self, zernike_um=zernike_um)

    def transfer(self) -> Transfer:
        """Return the optical transfer function.

        Raises
        ------
        ValueError
            If the wavefront is too steep to be resolved, or through lenslets.
        """
        zernike_um = self.zernike_um.copy()
        zernike_um[TILTS] = 0.0  # the image's position is irrelevant
        return optical_transfer(
            zernike_um,
            zernike_radius_mm=self.circle_diameter_mm / 2.0,
            wavelength_nm=self.wavelength_nm,
            pupil_ellipse=self.pupil_ellipse,
            pupil_screen=self.rings,
        )
