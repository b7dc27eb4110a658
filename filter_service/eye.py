"""What the PSF cache asks of an eye, whether a wavefront or a ray-traced model."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Eye(Protocol):
    """Seen on axis: wavefronts over pupil, accommodation, wavelength and defocus.

    Object distance adds its vergence to the total defocus, so a PSF depends on it
    through that sum alone.
    """

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Pupil asked for, capped where the eye knows no more."""

    def accommodation_dpt(self, focus_dpt: float) -> float:
        """Accommodation for a focus distance, within reach."""

    def reachable_focus_dpt(self, focus_dpt: float) -> float:
        """Distance that the eye is then really focused at."""

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Say what of a request cannot be met."""

    def accommodation_nodes_dpt(
        self, focus_range_dpt: tuple[float, float]
    ) -> NDArray[np.float64]:
        """Accommodations (n,), ascending, between which wavefronts are blended."""

    def total_defocus_dpt(
        self,
        *,
        pupil_diameter_mm: float,
        accommodation_dpt: float,
        wavelength_nm: float,
    ) -> float:
        """Least-squares refraction at this state for an object at infinity."""

    def zernike_at_defocus(
        self,
        *,
        pupil_diameter_mm: float,
        accommodation_dpt: float,
        wavelength_nm: float,
        total_defocus_dpt: float,
    ) -> NDArray[np.float64]:
        """Coefficients (28,), um, with the given total defocus."""
