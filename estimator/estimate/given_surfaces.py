"""An eye given by its surfaces, with the interface of an estimated one."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.measured_residual import MeasuredResidual
from estimator.eye.focusing import FocusedSurfaces
from estimator.eye.surface_eye import SurfaceEye, SurfaceModel
from estimator.optics.surfaces import EyeSurfaces
from estimator.optics.zernike import N_TERMS
from estimator.profiles.measured_wavefront import profile_amplitude_dpt
from estimator.profiles.parse import EyeProfile


@dataclass(frozen=True)
class GivenSurfaces:
    """An eye that a profile gives by its surfaces; nothing is estimated.

    Attributes
    ----------
    profile : EyeProfile
        Profile of kind ``surfaces`` or ``published``.
    model : SurfaceModel
    mean_abs_error_um : float
        Mean error of the eye's coefficients: 0.
    on_bound : tuple of str
        Estimated parameters on a bound: none.
    """

    profile: EyeProfile
    model: SurfaceModel
    mean_abs_error_um: float = 0.0
    on_bound: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the profile."""
        return self.profile.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes on the estimation: none."""
        return ()

    @property
    def zernike_um(self) -> NDArray[np.float64]:
        """Return the wavefront (28,), um, of the relaxed eye on axis, at the cornea."""
        return self.profile.zernike_um

    @property
    def zernike_radius_mm(self) -> float:
        """Return the radius of its circle."""
        return self.profile.pupil_diameter_mm / 2.0

    @property
    def residual_um(self) -> NDArray[np.float64]:
        """Return the wavefront (28,), um, that the eye does not reproduce: zero."""
        return np.zeros(N_TERMS)

    @property
    def wavelength_nm(self) -> float:
        """Return the wavelength of ``zernike_um``."""
        return self.profile.wavelength_nm

    @property
    def relaxed(self) -> EyeSurfaces:
        """Return the surfaces of the relaxed eye."""
        return self.model.relaxed

    @property
    def eye_length_mm(self) -> float:
        """Return the distance from the first surface to the retina."""
        return self.relaxed.retina.z_mm - self.relaxed.surfaces[0].z_mm

    @cached_property
    def accommodating(self) -> SurfaceEye:
        """Return the eye as one that can focus, with its correction."""
        return SurfaceEye(
            self.model,
            pupil_diameter_mm=self.profile.pupil_diameter_mm,
            amplitude_dpt=profile_amplitude_dpt(self.profile),
            correction=self.profile.correction,
        )

    @property
    def refraction_dpt(self) -> float:
        """Return M at 555 nm and the profile's pupil, through the correction."""
        return self.accommodating.refraction_dpt

    @property
    def amplitude_dpt(self) -> float:
        """Return the largest accommodation, by age and states."""
        return self.accommodating.amplitude_dpt

    def rest(
        self, wavelengths_nm: ArrayLike, *, n_traced_terms: int = N_TERMS
    ) -> MeasuredResidual:
        """Return the residual of the measurement: zero."""
        return MeasuredResidual.zero(
            self.profile.pupil_diameter_mm, wavelengths_nm=np.unique(wavelengths_nm)
        )

    def focused(
        self, focus_dpt: float = 0.0, *, pupil_diameter_mm: float | None = None
    ) -> FocusedSurfaces:
        """Return the eye focused as near to ``focus_dpt`` as possible."""
        return self.accommodating.focused(
            focus_dpt, pupil_diameter_mm=pupil_diameter_mm
        )

    def surfaces(
        self, focus_dpt: float = 0.0, *, pupil_diameter_mm: float | None = None
    ) -> EyeSurfaces:
        """Return the surfaces of `focused`."""
        return self.focused(focus_dpt, pupil_diameter_mm=pupil_diameter_mm).surfaces
