"""Interface of rings in the pupil that no polynomial describes, for wave optics."""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class PupilScreen(Protocol):
    """Effect of rings on light, about one center or many."""

    @property
    def centre_mm(self) -> ArrayLike:
        """Center of the rings from the pupil's center: (2,), or (P, 2) by pupil."""

    @property
    def lattice_mm(self) -> tuple[float, float, float] | None:
        """Pitch of a honeycomb of rings, and its inner and outer radius."""

    def reach_mrad(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the largest deflection of light at distances from the center."""

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude at squared distances from the rings' center."""
