"""One wavefront in the pupil, and what its optics pass on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator import Rings, Transfer, optical_transfer

SECOND_ORDER = slice(3, 6)
TILTS = slice(1, 3)


@dataclass(frozen=True)
class PupilWavefront:
    """What a point looks like from within: a wavefront and its pupil.

    Attributes
    ----------
    zernike_um : (28,)
        On the circle of ``circle_diameter_mm``, in the plane of the entrance pupil.
    pupil_ellipse : (5,)
        Pupil within the circle: centre x, y and semi-axes, mm, and angle, rad.
    rings : Rings or None
        What makes several foci of it, or lenslets before it.
    """

    zernike_um: NDArray[np.float64]
    circle_diameter_mm: float
    pupil_ellipse: NDArray[np.float64]
    wavelength_nm: float
    rings: Rings | None = None

    @property
    def is_readable(self) -> bool:
        """Return whether acuity and contrast are known: not through lenslets."""
        return self.rings is None or self.rings.lattice_mm is None

    def best_corrected(self) -> PupilWavefront:
        """Return it with a lens for the sphere and cylinder of this pupil."""
        zernike_um = self.zernike_um.copy()
        zernike_um[SECOND_ORDER] = 0.0
        return replace(self, zernike_um=zernike_um)

    def transfer(self) -> Transfer:
        """Return its optical transfer function.

        Raises
        ------
        ValueError
            A wavefront too steep to be resolved, or lenslets.
        """
        zernike_um = self.zernike_um.copy()
        zernike_um[TILTS] = 0.0  # where the picture lies does not matter
        return optical_transfer(
            zernike_um,
            zernike_radius_mm=self.circle_diameter_mm / 2.0,
            wavelength_nm=self.wavelength_nm,
            pupil_ellipse=self.pupil_ellipse,
            pupil_screen=self.rings,
        )
