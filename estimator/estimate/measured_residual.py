"""Residual of the estimate: a phase that the estimated eye does not reproduce.

45 parameters in human ranges do not reproduce every wavefront, and the dispersion of
the eye's media differs slightly from measured eyes.  On the axis the eye with
its residual is exactly the measurement.  Off the axis the residual fades: for random
eyes, estimated from their axis alone, it is right within some 10 deg and no help
beyond.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.assembly import eye_surfaces
from estimator.eye.parameters import EyeParameters
from estimator.eye.tracing import OPEN_RATIO
from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.surfaces import media_indices, pack_eye
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, SPHERE_PER_C20
from estimator.optics.vergence import chromatic_refraction_dpt
from estimator.optics.zernike import (
    EXPONENTS,
    N_TERMS,
    monomial_degrees,
    padded_terms,
    remove_central_tilt,
    summed_terms,
)
from estimator.profiles.parse import EyeProfile
from estimator.wavefront.aberrations import on_axis_zernike, wavefront_grid
from estimator.wavefront.field_wavefronts import (
    c20_by_degree,
    polynomial_in_mm,
    total_defocus_dpt,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_wavefront

FADE_DEG = 15.0
"""Angle from the axis at which 1/e of the residual is left."""

OVERSHOOT = 0.03
"""Fraction of the measured pupil beyond it to which the residual is followed.

A stretch that starts abruptly at the measured pupil is a kink: in a wavefront with a
large residual, the slope of M over the pupil jumped by 0.2 dpt/mm.
"""

_BOWL = np.where((EXPONENTS == [2, 0]).all(1) | (EXPONENTS == [0, 2]).all(1), -0.5, 0.0)
"""(28,): monomials of one diopter of refraction, um."""


@dataclass(frozen=True)
class MeasuredResidual:
    """Phase added to the ray-traced wavefront, in the plane of the entrance pupil.

    Attributes
    ----------
    residue_um : (n_terms,), um/mm^degree
        Measurement minus the eye, at the measured wavelength.  It has as many terms as
        the measurement needs in the pupil.
    radius_mm : float
        Radius of the measured pupil.  In a wider one the residual is stretched (see
        `stretch_ratio`): polynomials diverge beyond the measured pupil.
    wavelengths_nm, color_dpt : (n,)
        Refraction that adjusts the eye's longitudinal color, relative to the measured
        wavelength, to measured eyes (`vergence`).
    """

    residue_um: NDArray[np.float64]
    radius_mm: float
    wavelengths_nm: NDArray[np.float64]
    color_dpt: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        parameters: EyeParameters,
        profile: EyeProfile,
        *,
        wavelengths_nm: ArrayLike,
        n_traced_terms: int = N_TERMS,
    ) -> "MeasuredResidual":
        """Return the residual of an estimated eye; zero for a given eye.

        It is added to traced wavefronts of ``n_traced_terms``.
        """
        wavelengths_nm = np.unique(wavelengths_nm)
        radius_mm, measured_nm = profile.pupil_diameter_mm / 2.0, profile.wavelength_nm
        if profile.is_given:
            return cls.zero(profile.pupil_diameter_mm, wavelengths_nm=wavelengths_nm)
        traced_um, depth_mm = _traced_um(
            parameters,
            profile,
            np.append(measured_nm, wavelengths_nm),
            n_traced_terms,
        )
        at_cornea_um = polynomial_in_mm(
            remove_central_tilt(profile.zernike_um), radius_mm
        )
        moved_um = moved_wavefront(at_cornea_um, depth_mm=depth_mm, radius_mm=radius_mm)
        residue_um = summed_terms(moved_um, -traced_um[0])
        residue_um[0] = 0.0
        eye_dpt = total_defocus_dpt(
            zernike_from_polynomial(traced_um, radius_mm), radius_mm
        )
        people_dpt = chromatic_refraction_dpt(wavelengths_nm)
        people_dpt = people_dpt - chromatic_refraction_dpt(measured_nm)
        color_dpt = people_dpt - (eye_dpt[1:] - eye_dpt[0])
        return cls(residue_um, radius_mm, wavelengths_nm, color_dpt)

    @classmethod
    def zero(
        cls, pupil_diameter_mm: float, *, wavelengths_nm: NDArray[np.float64]
    ) -> "MeasuredResidual":
        """Return no residual at ascending wavelengths (n,)."""
        none = np.zeros(wavelengths_nm.size)
        return cls(np.zeros(N_TERMS), pupil_diameter_mm / 2.0, wavelengths_nm, none)

    @property
    def rms_um(self) -> float:
        """Root mean square of the residual over the measured pupil."""
        zernike_um = zernike_from_polynomial(self.residue_um, self.radius_mm)
        return float(np.sqrt(np.sum(zernike_um[3:] ** 2)))

    def color_um(self, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return monomials (n, n_terms) that correct the color of wavelengths (n,)."""
        place = np.searchsorted(self.wavelengths_nm, wavelength_nm)
        bowl = padded_terms(_BOWL, self.residue_um.size)
        return self.color_dpt[place][..., None] * bowl

    def residues_um(
        self, radius_mm: NDArray[np.float64], share: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return monomials (n, n_terms) of the residual in pupils, scaled by shares."""
        stretch = stretch_ratio(radius_mm / self.radius_mm)[..., None]
        degree = monomial_degrees(self.residue_um.size)
        return share[..., None] * self.residue_um * stretch**degree

    @staticmethod
    def left_share(h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
        """Return the fraction (n,) of the residual that is left at fields."""
        squared = np.square(h_deg) + np.square(v_deg)
        return np.exp(-squared / FADE_DEG**2)

    def on_axis_um(self, pupil_diameter_mm: ArrayLike) -> NDArray[np.float64]:
        """Return monomials (n, n_terms) at 555 nm on the axis, in pupils (n,)."""
        radius_mm = np.atleast_1d(np.asarray(pupil_diameter_mm, dtype=np.float64)) / 2
        color_um = self.color_um(np.full(radius_mm.size, REFERENCE_WAVELENGTH_NM))
        return self.residues_um(radius_mm, np.ones(radius_mm.size)) + color_um

    def on_axis_dpt(self, pupil_diameter_mm: float) -> float:
        """Return M at 555 nm of `on_axis_um` in a pupil."""
        radius_mm = pupil_diameter_mm / 2.0
        pupil_ratio, stretch = radius_mm / self.radius_mm, 1.0
        if pupil_ratio > 1.0:
            stretch = float(stretch_ratio(np.array(pupil_ratio)))
        measured_um, color_um = self._on_axis_c20
        return -SPHERE_PER_C20 * sum(
            (measured * stretch**degree + color) * radius_mm ** (degree - 2)
            for degree, measured, color in zip(
                range(2, 2 * len(measured_um) + 1, 2),
                measured_um,
                color_um,
                strict=True,
            )
        )

    @cached_property
    def _on_axis_c20(self) -> tuple[list[float], list[float]]:
        """Contributions (n,) of the residual and its color to C(2,0), by degree."""
        color_um = self.color_um(np.array([REFERENCE_WAVELENGTH_NM]))[0]
        measured, color = (
            c20_by_degree(part_um).tolist() for part_um in (self.residue_um, color_um)
        )
        return measured, color


def stretch_ratio(pupil_ratio: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factors (n,) that scale pupil coordinates before the residual.

    Parameters
    ----------
    pupil_ratio : (n,)
        Pupil over the measured pupil.  Up to 1, the factor is 1.  From
        1 + 2 `OVERSHOOT` on, the rim of any pupil has the residual at 1 + `OVERSHOOT`
        times the measured radius; in between, that multiple is a parabola with
        continuous slope.
    """
    beyond = np.minimum(np.maximum(pupil_ratio - 1.0, 0.0), 2.0 * OVERSHOOT)
    rim = np.minimum(pupil_ratio, 1.0) + beyond - beyond**2 / (4.0 * OVERSHOOT)
    return rim / pupil_ratio


def _traced_um(
    parameters: EyeParameters,
    profile: EyeProfile,
    wavelengths_nm: NDArray[Any],
    n_terms: int,
) -> tuple[NDArray[np.float64], float]:
    """Return the eye's monomials (n, n_terms) in the measured pupil, and its depth."""
    surfaces = eye_surfaces(parameters, retina=profile.retina)
    depth_mm = entrance_pupil_mm(surfaces, wavelength_nm=REFERENCE_WAVELENGTH_NM)
    found = wavefront_grid(
        surfaces,
        fields_deg=[[0.0, 0.0]],
        wavelengths_nm=wavelengths_nm,
        pupil_diameters_mm=[profile.pupil_diameter_mm],
        plane="pupil",
        n_terms=n_terms,
    )
    radius_mm: float | NDArray[np.float64]
    if (found.open_ratio > OPEN_RATIO).all():
        zernike_um, radius_mm = found.zernike_um, found.zernike_radius_mm
        return polynomial_in_mm(zernike_um, radius_mm)[0, :, 0], depth_mm
    radius_mm = profile.pupil_diameter_mm / 2.0
    count = len(wavelengths_nm)
    zernike_um, _ = on_axis_zernike(
        np.repeat(pack_eye(surfaces)[None], count, axis=0),
        media_indices(surfaces, wavelengths_nm),
        zernike_radius_mm=radius_mm,
        pupil_z_mm=depth_mm,
        n_terms=n_terms,
    )
    return polynomial_in_mm(zernike_um, radius_mm), depth_mm
