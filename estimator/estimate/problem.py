"""Estimation problem: the measurements of one profile, and a model of them.

Coefficients are compared on the measured circle, with the model's entrance pupil equal
to the measured pupil, without piston and tilt: the chief ray's zero slope ties tilt to
coma, so a measured tilt contains no information about the eye.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.bounded_fit import (
    BoundedFit,
    FitFailed,
    difference_jacobian_um,
    fit_bounded,
)
from estimator.estimate.prior import Prior, prior_for_refraction
from estimator.eye.parameters import PARAMETER_NAMES
from estimator.eye.tracing import zernike_of_vectors
from estimator.optics import prescription as rx
from estimator.optics.zernike import N_TERMS
from estimator.profiles.parse import EyeProfile, Measurement

FIRST_COMPARED = 3
"""Index of the first compared coefficient, after piston and tilt."""

FIT_NOISE_UM = 1e-3
"""Weight of a coefficient against the prior: a tenth of the repeatability of
instruments.  The residual is kept as a phase (`measured_residual`), so that an eye need
not leave human ranges for the last nanometers: with 1e-4 an eye of 8 dpt of cylinder
got a chamber 4.6 mm deep."""

INSTRUMENT_NOISE_UM = 0.01
"""Repeatability of an aberrometer's coefficient, used by `determined_ratio`."""

ON_BOUND_RATIO = 1e-6
"""Distance from a bound, in prior deviations, that counts as on it."""


def compared_terms(zernike_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coefficients (..., 25) that an estimation compares."""
    return zernike_um[..., FIRST_COMPARED:]


class EstimationProblem:
    """Measurements of one profile, and a model of them for many eyes."""

    def __init__(self, profile: EyeProfile):
        self.profile = profile
        measurements = profile.compared_measurements or (
            Measurement(
                profile.zernike_um, profile.pupil_diameter_mm, profile.wavelength_nm
            ),
        )
        # Terms are orthogonal: the first are the best fit with as many.
        self.measurements = tuple(
            replace(m, zernike_um=m.zernike_um[:N_TERMS]) for m in measurements
        )
        self.target_um = np.concatenate(
            [compared_terms(m.zernike_um) for m in self.measurements]
        )
        refraction_dpt, _, _ = rx.power_vector_from_zernike(
            profile.zernike_um, zernike_radius_mm=profile.pupil_diameter_mm / 2.0
        )
        self.prior: Prior = prior_for_refraction(refraction_dpt)

    def zernike_of(
        self, measurement: Measurement
    ) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """Return a function from vectors (P, 45) to a measurement's coefficients."""

        def coefficients(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
            return zernike_of_vectors(
                vectors,
                retina=self.profile.retina,
                pupil_diameter_mm=measurement.pupil_diameter_mm,
                wavelength_nm=measurement.wavelength_nm,
                h_deg=measurement.h_deg,
                v_deg=measurement.v_deg,
            )

        return coefficients

    def compared_um(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Trace the compared coefficients (P, K) of vectors (P, 45)."""
        return np.concatenate(
            [compared_terms(self.zernike_of(m)(vectors)) for m in self.measurements],
            axis=-1,
        )

    def nearest(self, vectors: NDArray[np.float64]) -> int:
        """Return the index of the eye with the nearest coefficients."""
        misfit_um = self.compared_um(vectors) - self.target_um
        distance = np.sum(misfit_um**2, axis=-1)
        if np.all(np.isnan(distance)):
            raise FitFailed("light passes none of the start eyes at this pupil")
        return int(np.nanargmin(distance))

    def _model(self, units: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.compared_um(self.prior.from_unit(units))

    def jacobian_um(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Jacobian (K, 45) of the coefficients, per prior deviation."""
        value_um = self._model(unit[None])[0]
        return difference_jacobian_um(
            self._model, unit, value_um, high=self.prior.unit_bounds()[1]
        )

    def refine(self, start_vector: NDArray[np.float64]) -> BoundedFit:
        """Fit the eye from a start (45,)."""
        return fit_bounded(
            self._model,
            target_um=self.target_um,
            start=self.prior.to_unit(start_vector),
            bounds=self.prior.unit_bounds(),
            noise_um=FIT_NOISE_UM,
        )

    def error_um(self, fit: BoundedFit) -> float:
        """Return the mean error of a fit over the compared coefficients."""
        return float(np.mean(np.abs(fit.values_um - self.target_um)))

    def determined_ratio(self, vector: NDArray[np.float64]) -> dict[str, float]:
        """Return the fraction of each prior variance that the measurement removes."""
        jacobian_um = self.jacobian_um(self.prior.to_unit(vector))
        n = jacobian_um.shape[1]
        information = jacobian_um.T @ jacobian_um / INSTRUMENT_NOISE_UM**2 + np.eye(n)
        left = np.diag(np.linalg.inv(information))
        return dict(zip(PARAMETER_NAMES, (1.0 - left).tolist(), strict=True))

    def on_bound(self, vector: NDArray[np.float64]) -> tuple[str, ...]:
        """Return the names of the parameters on a bound of their range."""
        unit = self.prior.to_unit(vector)
        low, high = self.prior.unit_bounds()
        room = np.minimum(unit - low, high - unit)
        return tuple(
            name
            for name, left in zip(PARAMETER_NAMES, room, strict=True)
            if left < ON_BOUND_RATIO
        )
