"""What the PSF cache asks of an eye, whether a wavefront or a ray-traced model."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.rings import Rings
from estimator.optics.vergence import ObjectVergence
from estimator.wavefront.field_wavefronts import FieldWavefronts


class EyeOptics(Protocol):
    """Wavefronts over field, pupil, accommodation, wavelength and defocus.

    Wavefronts are those in the plane of the entrance pupil.  There object distance adds
    its vergence to the total defocus, so a PSF depends on it through that sum alone.

    Every array of states may have any shape that broadcasts with the others: fields
    ``h_deg`` and ``v_deg``, the entrance pupil's diameter in mm, accommodation in dpt,
    the wavelength in nm.  An eye that was traced for a range raises ValueError where a
    state lies outside of it.
    """

    @property
    def eye_side(self) -> str:
        """OD or OS, which decides where cones see the pupil brightest."""

    @property
    def vergence(self) -> ObjectVergence:
        """From object distances to vergences, through the worn correction."""

    @property
    def rings(self) -> Rings | None:
        """What makes several foci of it, where a worn lens does."""

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Pupil diameter asked for, mm, capped where the eye knows no more."""

    def accommodation_dpt(self, focus_dpt: float, *, pupil_diameter_mm: float) -> float:
        """Accommodation at which a distance, dpt, is sharpest through a pupil."""

    def sharpest_dpt(
        self, accommodation_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Distance that is sharpest at an accommodation, through a pupil, dpt."""

    def reachable_focus_dpt(
        self, focus_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Distance that is then really sharpest, dpt: the eye's reach has ends."""

    def focus_limits_dpt(self, pupil_diameter_mm: float) -> tuple[float, float]:
        """Far point and near point through a pupil, dpt."""

    def accommodation_range_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> tuple[float, float]:
        """Smallest and largest accommodation for ranges of focus and pupil."""

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Say what of a request cannot be met, in sentences; empty where all can."""

    def accommodation_nodes_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> NDArray[np.float64]:
        """Accommodations (n,), dpt, ascending, between which wavefronts are blended."""

    def total_defocus_dpt(
        self,
        *,
        h_deg: ArrayLike = 0.0,
        v_deg: ArrayLike = 0.0,
        pupil_diameter_mm: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Least-squares refraction for an object at infinity, dpt, broadcast shape.

        On the circle about the pupil, worn correction included.

        Raises
        ------
        ValueError
            A state outside of what is known of the eye.
        """

    def defocus_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., NDArray[np.float64]]:
        """`total_defocus_dpt` at fixed fields and wavelengths, many states of the eye.

        Returns
        -------
        callable
            From ``pupil_diameter_mm`` and ``accommodation_dpt``, both numbers, to dpt
            in the broadcast shape of the fields and wavelengths.

        Raises
        ------
        ValueError
            A field or wavelength outside of what is known; the callable, for a pupil or
            accommodation.
        """

    def chief_ray_shift_mrad(
        self,
        *,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Lateral colour against 555 nm along the pupil axes, (..., 2), mrad.

        Raises
        ------
        ValueError
            A state outside of what is known of the eye.
        """

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
        """Wavefronts (P,) with the given total defocus, in C order of the broadcast.

        Parameters
        ----------
        total_defocus_dpt : array
            Of eye and object together; it replaces the eye's own.

        Raises
        ------
        ValueError
            A state outside of what is known of the eye.
        """

    def wavefronts_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., FieldWavefronts]:
        """`wavefronts` at fixed fields and wavelengths (n,), many states of the eye.

        Returns
        -------
        callable
            From ``pupil_diameter_mm`` and ``accommodation_dpt``, both numbers, and
            ``total_defocus_dpt`` (m, n) to wavefronts (m n,).

        Raises
        ------
        ValueError
            A field or wavelength outside of what is known; the callable, for a pupil or
            accommodation.
        """
