"""Interface of a complex amplitude in the pupil that is not a polynomial phase."""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class PupilScreen(Protocol):
    """Complex amplitude that is rotationally symmetric about one or many centers."""

    @property
    def centre_mm(self) -> ArrayLike:
        """Center relative to the pupil's center: (2,), or (P, 2) for P pupils."""

    @property
    def lattice_mm(self) -> tuple[float, float, float] | None:
        """Pitch, inner and outer radius of a honeycomb of centers; None for one."""

    def reach_mrad(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the largest deflection (...) of light within distances (...)."""

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude (...) at squared distances from a center."""
