"""Measured wavefront used directly: the lightweight option, without an eye model.

Pupil, object, focus and wavelength act on the measurement in closed form: coefficients
rescale to smaller pupils, defocus shifts by vergence, accommodation and chromatic
difference.  The one measured field is used for all fields.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.worn_lens import replaces_lens, rings_of, worn_polynomial
from estimator.eye.focusing import FocusingEye
from estimator.optics import prescription as rx
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, SPHERE_PER_C20
from estimator.optics.vergence import (
    TYPICAL_ENTRANCE_PUPIL_MM,
    ObjectVergence,
    chromatic_refraction_dpt,
    refraction_at_cornea_dpt,
)
from estimator.optics.zernike import (
    remove_central_tilt,
    rescale_pupil,
    summed_terms,
)
from estimator.profiles.parse import EyeProfile
from estimator.wavefront.field_wavefronts import (
    N_RIM,
    FieldWavefronts,
    polynomial_in_mm,
    total_defocus_dpt,
    with_defocus,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_wavefront

DEFAULT_AMPLITUDE_DPT = 10.0
"""Amplitude of accommodation of an eye whose age is not given."""


def accommodation_amplitude_dpt(
    *, age_years: float | None, add_dpt: float = 0.0
) -> float:
    """Return the largest accommodation in dpt.

    The objective amplitude by age is 7.33 - 0.0035 (age - 3)² (Anderson et al. 2008),
    zero from 49 years on.  A near addition implies that half the amplitude and the
    addition together give the 2.5 dpt of a reading distance.  The smaller of the two
    applies.
    """
    amplitude_dpt = DEFAULT_AMPLITUDE_DPT
    if age_years is not None:
        amplitude_dpt = max(0.0, 7.33 - 0.0035 * (age_years - 3.0) ** 2)
    if add_dpt > 0.0:
        amplitude_dpt = min(amplitude_dpt, max(0.0, 2.0 * (2.5 - add_dpt)))
    return amplitude_dpt


def profile_amplitude_dpt(profile: EyeProfile) -> float:
    """Return a profile's largest accommodation, dpt; 0 with an intraocular lens."""
    if replaces_lens(profile.correction):
        return 0.0
    return accommodation_amplitude_dpt(
        age_years=profile.age_years, add_dpt=profile.add_dpt
    )


@dataclass(frozen=True)
class WavefrontState:
    """Wavefront of the eye at one pupil, object, focus and wavelength.

    ``zernike_um`` (n_terms,) is on the circle of ``pupil_diameter_mm``; ``notes`` list
    requests that could not be met.
    """

    zernike_um: NDArray[np.float64]
    pupil_diameter_mm: float
    notes: tuple[str, ...]


class MeasuredWavefront(FocusingEye):
    """Wavefront-only eye: measured coefficients plus defocus in closed form.

    Attributes
    ----------
    eye_side : str
        OD or OS.
    zernike_um : (n_terms,)
        Coefficients in the plane of a typical entrance pupil, correction subtracted;
        as many as the wavefront needs there.
    refraction_dpt : float
        M at the cornea and 555 nm at the measured pupil, through the correction.
    """

    pupil_limit = "measured"

    def __init__(self, profile: EyeProfile):
        radius_mm = profile.pupil_diameter_mm / 2.0
        depth_mm = TYPICAL_ENTRANCE_PUPIL_MM
        at_cornea_um = remove_central_tilt(profile.zernike_um)
        zernike_um = zernike_from_polynomial(
            moved_wavefront(
                polynomial_in_mm(at_cornea_um, radius_mm),
                depth_mm=depth_mm,
                radius_mm=radius_mm,
            ),
            radius_mm,
        )
        if profile.correction is not None:
            correction_um = zernike_from_polynomial(
                worn_polynomial(profile.correction, entrance_pupil_mm=depth_mm),
                radius_mm,
            )
            zernike_um = summed_terms(zernike_um, -correction_um)
        self.rings = rings_of(profile.correction)
        self.vergence = ObjectVergence.seen_through(
            profile.correction, entrance_pupil_mm=depth_mm
        )
        # Cached for the last pupil, because each frame requests it five times.
        self._relaxed: tuple[float, float] | None = None
        self.eye_side = profile.eye_side
        self.zernike_um = zernike_um
        self.zernike_radius_mm = radius_mm
        self.wavelength_nm = profile.wavelength_nm
        self.max_pupil_diameter_mm = profile.max_pupil_diameter_mm
        self.amplitude_dpt = profile_amplitude_dpt(profile)
        self.refraction_dpt = refraction_at_cornea_dpt(
            self.refraction_at_dpt(pupil_diameter_mm=2.0 * radius_mm),
            entrance_pupil_mm=depth_mm,
        )

    @classmethod
    def from_profile(cls, profile: EyeProfile) -> "MeasuredWavefront":
        """Build from a parsed profile."""
        return cls(profile)

    def refraction_at_dpt(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float = 0.0
    ) -> float:
        """Return least-squares M at 555 nm through a pupil, at an accommodation."""
        if self._relaxed is None or self._relaxed[0] != pupil_diameter_mm:
            self._relaxed = pupil_diameter_mm, self._relaxed_dpt(pupil_diameter_mm)
        return self._relaxed[1] - accommodation_dpt

    def _relaxed_dpt(self, pupil_diameter_mm: float) -> float:
        radius_mm = pupil_diameter_mm / 2.0
        relaxed_dpt, _, _ = rx.power_vector_from_zernike(
            rescale_pupil(
                self.zernike_um, radius_ratio=radius_mm / self.zernike_radius_mm
            ),
            zernike_radius_mm=radius_mm,
        )
        return relaxed_dpt + self.chromatic_shift_dpt(REFERENCE_WAVELENGTH_NM)

    def accommodation_for_dpt(
        self, refraction_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the available accommodation whose M is closest to a refraction."""
        relaxed_dpt = self.refraction_at_dpt(pupil_diameter_mm=pupil_diameter_mm)
        return min(max(relaxed_dpt - refraction_dpt, 0.0), self.amplitude_dpt)

    def largest_accommodation_dpt(self, pupil_diameter_mm: float) -> float:
        """Return the accommodation for the near point: the amplitude."""
        return self.amplitude_dpt

    def chromatic_shift_dpt(self, wavelength_nm: float) -> float:
        """Return the refraction relative to the measured wavelength, in dpt."""
        return float(
            chromatic_refraction_dpt(wavelength_nm)
            - chromatic_refraction_dpt(self.wavelength_nm)
        )

    def zernike_with_defocus(
        self, *, pupil_diameter_mm: float, added_defocus_dpt: float
    ) -> NDArray[np.float64]:
        """Return coefficients (n_terms,), um, with vergence added to the relaxed eye.

        ``added_defocus_dpt`` is object vergence minus accommodation plus chromatic
        shift; C(2,0) changes by -added r²/(4 sqrt 3), everything else is the
        measurement rescaled.
        """
        radius_mm = pupil_diameter_mm / 2.0
        zernike_um = rescale_pupil(
            self.zernike_um, radius_ratio=radius_mm / self.zernike_radius_mm
        )
        zernike_um[rx.C20] -= added_defocus_dpt * radius_mm**2 / SPHERE_PER_C20
        zernike_um[0] = 0.0  # rescaling adds piston, which no image depends on
        return zernike_um

    # ----- interface to the PSF cache (also in estimator/field/traced_eye.py)

    def accommodation_nodes_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> NDArray[np.float64]:
        """Return the single accommodation: the wavefront's shape does not change."""
        return np.zeros(1)

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
        """Return the least-squares refraction over the pupil, in dpt.

        It includes the vergence of an object at ``object_dpt``.  All arguments
        broadcast, and the result has their shape.
        """
        _, _, pupil_mm, used_dpt, wavelength_nm = np.broadcast_arrays(
            h_deg, v_deg, pupil_diameter_mm, accommodation_dpt, wavelength_nm
        )
        radius_mm = self._radius_mm(pupil_mm)
        shift_dpt = chromatic_refraction_dpt(wavelength_nm) - chromatic_refraction_dpt(
            self.wavelength_nm
        )
        relaxed_dpt = total_defocus_dpt(self._on_circles(radius_mm), radius_mm)
        found_dpt = relaxed_dpt.reshape(pupil_mm.shape) + shift_dpt - used_dpt
        return self.with_object_dpt(found_dpt, object_dpt)

    def defocus_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., NDArray[np.float64]]:
        """Return `total_defocus_dpt` at fixed fields as a function of the eye's state.

        Returns
        -------
        callable
            Function of ``pupil_diameter_mm`` and ``accommodation_dpt`` that returns
            dpt in the arguments' broadcast shape.
        """
        shape = np.broadcast_shapes(*map(np.shape, (h_deg, v_deg, wavelength_nm)))
        return partial(self._defocus_dpt, wavelength_nm, shape)

    def _defocus_dpt(
        self, wavelength_nm: ArrayLike, shape: tuple[int, ...], **state: float
    ) -> NDArray[np.float64]:
        found_dpt = self.total_defocus_dpt(wavelength_nm=wavelength_nm, **state)
        return np.broadcast_to(found_dpt, shape)

    def chief_ray_shift_mrad(
        self,
        *,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Return zeros (..., 2), in mrad: one wavelength has no lateral color."""
        states = np.broadcast_shapes(
            *map(np.shape, (h_deg, v_deg, accommodation_dpt, wavelength_nm))
        )
        return np.zeros((*states, 2))

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

        Raises
        ------
        ValueError
            A pupil is larger than the measured one.
        """
        _, _, pupil_mm, _, _, total_dpt = np.broadcast_arrays(
            h_deg,
            v_deg,
            pupil_diameter_mm,
            accommodation_dpt,
            wavelength_nm,
            total_defocus_dpt,
        )
        radius_mm = self._radius_mm(pupil_mm)
        rim_mm = np.zeros((radius_mm.size, N_RIM))
        rim_mm[:, 2] = rim_mm[:, 4] = radius_mm
        return with_defocus(
            self._on_circles(radius_mm), rim_mm, radius_mm, total_defocus_dpt=total_dpt
        )

    def wavefronts_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., FieldWavefronts]:
        """Return `wavefronts` at fixed fields as a function of the eye's state."""
        return partial(
            self.wavefronts, h_deg=h_deg, v_deg=v_deg, wavelength_nm=wavelength_nm
        )

    def _on_circles(self, radius_mm: NDArray[Any]) -> NDArray[np.float64]:
        """Return measured coefficients (P, n) on circles (P,), piston zero."""
        polynomial_um = polynomial_in_mm(self.zernike_um, self.zernike_radius_mm)
        return zernike_from_polynomial(polynomial_um, radius_mm)

    def _radius_mm(self, pupil_mm: NDArray[Any]) -> NDArray[np.float64]:
        """Return flat pupil radii; reject pupils larger than the measured one."""
        largest_mm = self.max_pupil_diameter_mm
        if pupil_mm.size and not (
            pupil_mm.min() > 0.0 and pupil_mm.max() <= largest_mm + 1e-6
        ):
            raise ValueError(
                f"pupil_diameter_mm {pupil_mm.min():g} to {pupil_mm.max():g}: allowed "
                f"is above 0 to {largest_mm:g}"
            )
        return pupil_mm.ravel() / 2.0

    def state(
        self,
        *,
        pupil_diameter_mm: float,
        object_dpt: float,
        focus_dpt: float,
        wavelength_nm: float,
    ) -> WavefrontState:
        """Return the wavefront for one pupil, object distance, focus and wavelength.

        Raises
        ------
        ValueError
            The pupil is not positive, or a value is not finite.
        """
        values = (pupil_diameter_mm, object_dpt, focus_dpt, wavelength_nm)
        if not all(math.isfinite(v) for v in values) or pupil_diameter_mm <= 0:
            raise ValueError(f"eye state {values}: allowed: finite, positive pupil")
        usable_mm = self.usable_pupil_mm(pupil_diameter_mm)
        added_dpt = (
            self.vergence.vergence_dpt(object_dpt)
            - self.accommodation_dpt(focus_dpt, pupil_diameter_mm=usable_mm)
            + self.chromatic_shift_dpt(wavelength_nm)
        )
        return WavefrontState(
            zernike_um=self.zernike_with_defocus(
                pupil_diameter_mm=usable_mm, added_defocus_dpt=added_dpt
            ),
            pupil_diameter_mm=usable_mm,
            notes=self.notes(pupil_diameter_mm=pupil_diameter_mm, focus_dpt=focus_dpt),
        )
