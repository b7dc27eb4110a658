"""Which eye has this wavefront: 45 parameters from one or several measurements.

``refined``: bounded least squares on exactly ray-traced coefficients, with a weak prior
towards the mean eye of the measured refraction.  ``search``: the pattern search of the
earlier work, for comparison.  Coefficients are compared on the measured circle, with
the model's entrance pupil equal to the measured pupil, without piston and tilt: the
chief ray's zero slope ties tilt to coma, so a measured tilt says nothing of the eye.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator import prescription as rx
from estimator.accommodation import AccommodatingEye, FocusedEye
from estimator.bounded_fit import (
    BoundedFit,
    FitFailed,
    difference_jacobian_um,
    fit_bounded,
)
from estimator.estimation_prior import Prior, prior_for_refraction
from estimator.eye_parameters import (
    PARAMETER_NAMES,
    EyeParameters,
    RetinaShape,
    allowed_ranges,
)
from estimator.eye_table import table_vectors
from estimator.eye_wavefront import zernike_of_vectors
from estimator.measured_wavefront import accommodation_amplitude_dpt
from estimator.pattern_search import pattern_search
from estimator.profiles import EyeProfile, Measurement
from estimator.zernike import N_TERMS, remove_central_tilt

METHODS = ("refined", "search")

FIRST_COMPARED = 3
"""Index of the first coefficient that is compared: no piston, no tilt."""

FIT_NOISE_UM = 1e-4
"""Weight of a coefficient against the prior: small, so that the prior decides only what
the measurement leaves open."""

INSTRUMENT_NOISE_UM = 0.01
"""Repeatability of an aberrometer's coefficient, for how well determined an eye is."""

ON_BOUND_RATIO = 1e-6
"""Distance from a bound, in prior deviations, that counts as on it."""

POOR_FIT_UM = 0.01
"""Mean error above which the answer says that the model does not reach the data."""

SEARCH_TIME_S = 60.0
"""Time given to the pattern search; the published runs took one to three hours."""


@dataclass(frozen=True)
class EstimatedEye:
    """An eye that reproduces a measurement, and how well.

    Attributes
    ----------
    zernike_um, residual_um : (28,), um
        Of the eye, and of the eye less the measurement, on the measured circle
        (``zernike_radius_mm``) at ``wavelength_nm``; for several measurements, the
        first.  The residual's tilt is against the measurement shifted to zero central
        slope.
    mean_abs_error_um : float
        Over the 25 terms without piston and tilt, and over all measurements.
    on_bound : tuple of str
        Parameters that sit on a bound of their allowed range.
    """

    name: str
    method: str
    parameters: EyeParameters
    profile: EyeProfile
    zernike_um: NDArray[np.float64]
    residual_um: NDArray[np.float64]
    zernike_radius_mm: float
    wavelength_nm: float
    mean_abs_error_um: float
    time_ms: float
    n_iterations: int
    n_evaluations: int
    on_bound: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def retina(self) -> RetinaShape | None:
        """Return the retina of the profile, None for a sphere."""
        return self.profile.retina

    @cached_property
    def determined_ratio(self) -> dict[str, float]:
        """Return how well each parameter is determined; costs one Jacobian.

        The share of the prior variance that a measurement with 0.01 um noise per
        coefficient takes away: 0 is the prior alone, 1 is known.
        """
        if self.profile.eye is not None:
            return dict.fromkeys(PARAMETER_NAMES, 1.0)
        problem = _Problem(self.profile)
        unit = problem.prior.to_unit(self.parameters.to_vector())
        return _determined_ratio(problem.jacobian_um(unit))

    @cached_property
    def accommodating(self) -> AccommodatingEye:
        """Return the eye as one that can be asked to focus, correction worn."""
        return accommodating_eye(self.parameters, self.profile)

    @property
    def refraction_dpt(self) -> float:
        """Return M at 555 nm and the measured pupil, through the worn correction."""
        return self.accommodating.refraction_dpt

    @property
    def amplitude_dpt(self) -> float:
        """Return the largest accommodation, by age, addition and lens."""
        return self.accommodating.amplitude_dpt

    def focused(self, focus_dpt: float = 0.0) -> FocusedEye:
        """Return the eye focused as near to ``focus_dpt`` as it can."""
        return self.accommodating.focused(focus_dpt)

    def surfaces(self, focus_dpt: float = 0.0):
        """Return the surfaces of the eye focused as near to ``focus_dpt`` as it can."""
        return self.focused(focus_dpt).surfaces


def accommodating_eye(
    parameters: EyeParameters, profile: EyeProfile
) -> AccommodatingEye:
    """Return an eye with the age, addition and correction of its profile."""
    return AccommodatingEye(
        parameters,
        retina=profile.retina,
        pupil_diameter_mm=profile.pupil_diameter_mm,
        amplitude_dpt=accommodation_amplitude_dpt(
            age_years=profile.age_years, add_dpt=profile.add_dpt
        ),
        correction=profile.correction,
    )


def estimate_eye(
    profile: EyeProfile,
    *,
    method: str = "refined",
    max_time_s: float = SEARCH_TIME_S,
    start_vectors: NDArray[np.float64] | None = None,
) -> EstimatedEye:
    """Estimate the eye behind a profile.

    Parameters
    ----------
    profile : EyeProfile
        A profile that is an eye already is returned as it is, with method ``given``.
    method : {"refined", "search"}
    max_time_s : float
        For ``search`` only.
    start_vectors : (P, 45), optional
        Eyes of which ``refined`` starts at the nearest; the built-in table otherwise.

    Raises
    ------
    ValueError
        An unknown method.
    """
    if method not in METHODS:
        raise ValueError(f"method '{method}': allowed are {', '.join(METHODS)}")
    start_s = time.perf_counter()
    if profile.eye is not None:
        return _given(profile, start_s)
    problem = _Problem(profile)
    if start_vectors is None:
        start_vectors = table_vectors()
    if method == "search":
        return _searched(problem, start_s, max_time_s)
    fit = problem.refine(start_vectors)
    return problem.answer(
        "refined",
        vector=problem.prior.from_unit(fit.position_ratio),
        values_um=fit.values_um,
        start_s=start_s,
        counts=(fit.n_iterations, fit.n_evaluations),
    )


def compared_terms(zernike_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients (..., 25) that an estimation compares."""
    return zernike_um[..., FIRST_COMPARED:]


class _Problem:
    """Measurements of one profile, and the model that answers for many eyes."""

    def __init__(self, profile: EyeProfile):
        self.profile = profile
        self.measurements = profile.measurements or (
            Measurement(
                profile.zernike_um, profile.pupil_diameter_mm, profile.wavelength_nm
            ),
        )
        self.target_um = np.concatenate(
            [compared_terms(m.zernike_um) for m in self.measurements]
        )
        refraction_dpt, _, _ = rx.power_vector_from_zernike(
            profile.zernike_um, zernike_radius_mm=profile.pupil_diameter_mm / 2.0
        )
        self.prior: Prior = prior_for_refraction(refraction_dpt)

    def zernike_of(self, measurement: Measurement) -> Callable:
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
        return np.concatenate(
            [compared_terms(self.zernike_of(m)(vectors)) for m in self.measurements],
            axis=-1,
        )

    def nearest(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vector of the eye whose coefficients lie nearest."""
        misfit_um = self.compared_um(vectors) - self.target_um
        distance = np.sum(misfit_um**2, axis=-1)
        if np.all(np.isnan(distance)):
            raise FitFailed("light passes none of the start eyes at this pupil")
        return vectors[np.nanargmin(distance)]

    def _model(self, units: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.compared_um(self.prior.from_unit(units))

    def jacobian_um(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        value_um = self._model(unit[None])[0]
        return difference_jacobian_um(
            self._model, unit, value_um, high=self.prior.unit_bounds()[1]
        )

    def refine(self, start_vectors: NDArray[np.float64]) -> BoundedFit:
        return fit_bounded(
            self._model,
            target_um=self.target_um,
            start=self.prior.to_unit(self.nearest(start_vectors)),
            bounds=self.prior.unit_bounds(),
            noise_um=FIT_NOISE_UM,
        )

    def answer(
        self,
        method: str,
        *,
        vector: NDArray[np.float64],
        values_um: NDArray[np.float64],
        start_s: float,
        counts: tuple[int, int],
    ) -> EstimatedEye:
        error_um = float(np.mean(np.abs(values_um - self.target_um)))
        on_bound = self._on_bound(vector)
        vector = np.clip(vector, *allowed_ranges().T)  # rounding may overstep a bound
        zernike_um = self.zernike_of(self.measurements[0])(vector[None])[0]
        zernike_um[0] = 0.0
        measured_um = remove_central_tilt(self.profile.zernike_um)
        residual_um = zernike_um - measured_um
        residual_um[0] = 0.0
        return EstimatedEye(
            name=self.profile.name,
            method=method,
            parameters=EyeParameters.from_vector(vector),
            profile=self.profile,
            zernike_um=zernike_um,
            residual_um=residual_um,
            zernike_radius_mm=self.profile.pupil_diameter_mm / 2.0,
            wavelength_nm=self.profile.wavelength_nm,
            mean_abs_error_um=error_um,
            time_ms=1000.0 * (time.perf_counter() - start_s),
            n_iterations=counts[0],
            n_evaluations=counts[1],
            on_bound=on_bound,
            notes=_notes(error_um),
        )

    def _on_bound(self, vector: NDArray[np.float64]) -> tuple[str, ...]:
        unit = self.prior.to_unit(vector)
        low, high = self.prior.unit_bounds()
        room = np.minimum(unit - low, high - unit)
        return tuple(
            name
            for name, left in zip(PARAMETER_NAMES, room, strict=True)
            if left < ON_BOUND_RATIO
        )


def _notes(error_um: float) -> tuple[str, ...]:
    if error_um <= POOR_FIT_UM:
        return ()
    return (
        f"the eye model reaches this wavefront only to {error_um:.2g} um on average",
    )


def _determined_ratio(jacobian_um: NDArray[np.float64]) -> dict[str, float]:
    n = jacobian_um.shape[1]
    information = jacobian_um.T @ jacobian_um / INSTRUMENT_NOISE_UM**2 + np.eye(n)
    left = np.diag(np.linalg.inv(information))
    return dict(zip(PARAMETER_NAMES, (1.0 - left).tolist(), strict=True))


def _searched(problem: _Problem, start_s: float, max_time_s: float) -> EstimatedEye:
    first = problem.measurements[0]
    zernike_of = problem.zernike_of(first)
    found = pattern_search(
        zernike_of, target_um=first.zernike_um, max_time_s=max_time_s
    )
    vector = found.parameters.to_vector()
    return problem.answer(
        "search",
        vector=vector,
        values_um=problem.compared_um(vector[None])[0],
        start_s=start_s,
        counts=(found.n_iterations, found.n_evaluations),
    )


def _given(profile: EyeProfile, start_s: float) -> EstimatedEye:
    return EstimatedEye(
        name=profile.name,
        method="given",
        parameters=profile.eye,
        profile=profile,
        zernike_um=profile.zernike_um,
        residual_um=np.zeros(N_TERMS),
        zernike_radius_mm=profile.pupil_diameter_mm / 2.0,
        wavelength_nm=profile.wavelength_nm,
        mean_abs_error_um=0.0,
        time_ms=1000.0 * (time.perf_counter() - start_s),
        n_iterations=0,
        n_evaluations=0,
        on_bound=(),
        notes=(),
    )
