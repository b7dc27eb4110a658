"""Interface between the PSF cache and an eye: a wavefront or a ray-traced model."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.rings import Rings
from estimator.optics.vergence import ObjectVergence
from estimator.wavefront.field_wavefronts import FieldWavefronts


class EyeOptics(Protocol):
    """Wavefronts by field, pupil, accommodation, wavelength and total defocus.

    Wavefronts are in the plane of the entrance pupil.  In that plane, the vergence of
    the object adds to the total defocus, so PSFs depend on the object distance only
    through this sum.

    Array arguments broadcast: field angles ``h_deg`` and ``v_deg``, diameter of the
    entrance pupil in mm, accommodation in dpt and wavelength in nm.
    """

    @property
    def eye_side(self) -> str:
        """OD or OS, for the center of the Stiles-Crawford effect."""

    @property
    def vergence(self) -> ObjectVergence:
        """Conversion of object distances to vergences through the correction."""

    @property
    def rings(self) -> Rings | None:
        """Complex amplitude of a multifocal correction, or None."""

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Return a pupil diameter, mm, limited to the largest one of this eye."""

    def accommodation_dpt(self, focus_dpt: float, *, pupil_diameter_mm: float) -> float:
        """Return the accommodation, dpt, that focuses a distance through a pupil."""

    def sharpest_dpt(
        self, accommodation_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the focus distance, dpt, for an accommodation and a pupil."""

    def reachable_focus_dpt(
        self, focus_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the reachable distance, dpt, nearest to the requested focus."""

    def focus_limits_dpt(self, pupil_diameter_mm: float) -> tuple[float, float]:
        """Return the far point and the near point, dpt, through a pupil."""

    def accommodation_range_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> tuple[float, float]:
        """Return the accommodation range, dpt, for ranges of focus and pupil."""

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Return a note on each part of a request that cannot be fulfilled."""

    def accommodation_nodes_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> NDArray[np.float64]:
        """Return ascending accommodations (n,), dpt, between which PSFs are blended."""

    def total_defocus_dpt(
        self,
        *,
        h_deg: ArrayLike = 0.0,
        v_deg: ArrayLike = 0.0,
        pupil_diameter_mm: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
        object_dpt: ArrayLike = 0.0,
    ) -> NDArray[np.float64]:
        """Return the least-squares refraction, dpt, plus the vergence of an object.

        It has the broadcast shape, includes the correction and is on the circle of the
        pupil.  The object is at infinity by default.  `accommodation_dpt` focuses over
        the pupil itself, so at the focus of a decentered pupil the total defocus is not
        0: see "Focus" in CONVENTIONS.md.

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
        """Return the lateral color relative to 555 nm, (..., 2), mrad.

        It is along the pupil axes of the field.

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
            Defocus of eye and object, which replaces the defocus of the eye.

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
