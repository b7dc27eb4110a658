"""Rings in the pupil that no polynomial describes, as wave optics asks of them."""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class PupilScreen(Protocol):
    """What rings do to the light, about one centre or many."""

    @property
    def centre_mm(self) -> ArrayLike:
        """Of the rings, from the pupil's centre: (2,), or (P, 2) for each pupil."""

    @property
    def lattice_mm(self) -> tuple[float, float, float] | None:
        """Pitch of a honeycomb of rings, and the radii between which it lies."""

    def reach_mrad(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """How far light goes aside at distances from the centre."""

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Complex amplitude at squared distances from the centre of rings."""
