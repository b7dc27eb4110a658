"""Interface between the PSF cache and an eye: a wavefront or a ray-traced model."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.rings import Rings
from estimator.optics.vergence import ObjectVergence
from estimator.wavefront.field_wavefronts import FieldWavefronts


class EyeOptics(Protocol):
    """Wavefronts over field, pupil, accommodation, wavelength and defocus.

    Wavefronts are given in the plane of the entrance pupil.  There object distance adds
    its vergence to the total defocus, so a PSF depends on it through that sum alone.

    The arrays of a state broadcast with each other: field angles ``h_deg`` and
    ``v_deg``, entrance pupil diameter in mm, accommodation in dpt, wavelength in nm.
    An eye that was traced for a range raises ValueError for a state outside it.
    """

    @property
    def eye_side(self) -> str:
        """OD or OS, which sets the center of the Stiles-Crawford effect."""

    @property
    def vergence(self) -> ObjectVergence:
        """Conversion of object distances to vergences through the correction."""

    @property
    def rings(self) -> Rings | None:
        """Rings of a multifocal correction, if one is worn."""

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Return the requested pupil diameter, mm, capped at the eye's known pupil."""

    def accommodation_dpt(self, focus_dpt: float, *, pupil_diameter_mm: float) -> float:
        """Return the accommodation at which a distance is sharpest through a pupil."""

    def sharpest_dpt(
        self, accommodation_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the sharpest distance, dpt, at an accommodation through a pupil."""

    def reachable_focus_dpt(
        self, focus_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the reachable distance, dpt, nearest to the requested focus."""

    def focus_limits_dpt(self, pupil_diameter_mm: float) -> tuple[float, float]:
        """Return far point and near point through a pupil, dpt."""

    def accommodation_range_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> tuple[float, float]:
        """Return smallest and largest accommodation for ranges of focus and pupil."""

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Return a sentence for each part of a request that cannot be met."""

    def accommodation_nodes_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> NDArray[np.float64]:
        """Return ascending accommodations (n,), dpt, between which to blend."""

    def total_defocus_dpt(
        self,
        *,
        h_deg: ArrayLike = 0.0,
        v_deg: ArrayLike = 0.0,
        pupil_diameter_mm: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Return the least-squares refraction, dpt, for an object at infinity.

        It has the broadcast shape and holds on the circle about the pupil, correction
        included.

        Raises
        ------
        ValueError
            A state is outside the eye's known range.
        """

    def defocus_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., NDArray[np.float64]]:
        """Return `total_defocus_dpt` at fixed fields as a function of the eye's state.

        Returns
        -------
        callable
            Function of ``pupil_diameter_mm`` and ``accommodation_dpt``, both numbers,
            that returns dpt in the broadcast shape of the fields and wavelengths.

        Raises
        ------
        ValueError
            A field or wavelength is outside the known range; the callable raises it
            for a pupil or accommodation.
        """

    def chief_ray_shift_mrad(
        self,
        *,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Return the lateral color against 555 nm along the pupil axes, (..., 2), mrad.

        Raises
        ------
        ValueError
            A state is outside the eye's known range.
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
        """Return wavefronts (P,) with the given total defocus, in C order of states.

        Parameters
        ----------
        total_defocus_dpt : array
            Defocus of eye and object together; it replaces the eye's own.

        Raises
        ------
        ValueError
            A state is outside the eye's known range.
        """

    def wavefronts_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., FieldWavefronts]:
        """Return `wavefronts` at fixed fields (n,) as a function of the eye's state.

        Returns
        -------
        callable
            Function of ``pupil_diameter_mm`` and ``accommodation_dpt``, both numbers,
            and ``total_defocus_dpt`` (m, n) that returns wavefronts (m n,).

        Raises
        ------
        ValueError
            A field or wavelength is outside the known range; the callable raises it
            for a pupil or accommodation.
        """
