"""What the PSF cache asks of an eye, whether a wavefront or a ray-traced model."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.wavefront.field_wavefronts import FieldWavefronts


class EyeOptics(Protocol):
    """Wavefronts over field, pupil, accommodation, wavelength and defocus.

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
        h_deg: ArrayLike = 0.0,
        v_deg: ArrayLike = 0.0,
        pupil_diameter_mm: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Least-squares refraction for an object at infinity, in the broadcast shape.

        On the circle about the pupil, worn correction included.
        """

    def defocus_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., NDArray[np.float64]]:
        """`total_defocus_dpt` at fixed fields and wavelengths, many states of the eye.

        From ``pupil_diameter_mm`` and ``accommodation_dpt`` to dpt in the broadcast
        shape.
        """

    def chief_ray_shift_mrad(
        self,
        *,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Lateral colour against 555 nm along the pupil axes, (..., 2)."""

    def wavefronts(
        self,
        *,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        pupil_diameter_mm: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
        total_defocus_dpt: ArrayLike,
    ) -> FieldWavefronts:
        """Wavefronts (P,) with the given total defocus, in C order of the broadcast."""
