"""Estimation problem: a prior, the measurements of one profile, and a model of them.

Coefficients are compared on the measured circle, with the model's entrance pupil equal
to the measured pupil, without piston and tilt: the chief ray's zero slope ties tilt to
coma, so a measured tilt contains no information about the eye.

27 coefficients do not determine 45 parameters; among the eyes that fit, the prior
selects the one nearest to the mean eye of that refraction.

The baseline is the pattern search over the 45 parameters of the earlier work, the
published generalized pattern search (Csoba & Kunkli 2023): squared error with weights
by radial order and a penalty on wrong signs, parameters scaled to their ranges, mesh
factors 1/2 and 2.  It needs no derivatives, at the cost of time; the recommended method
is in `estimation.py`.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.bounded_fit import (
    BoundedFit,
    FitFailed,
    difference_jacobian_um,
    fit_bounded,
)
from estimator.eye.parameters import (
    N_PARAMETERS,
    PARAMETER_NAMES,
    PARAMETERS,
    EyeParameters,
    allowed_ranges,
    column,
    mean_vector,
    offset_name,
)
from estimator.eye.tracing import zernike_of_vectors
from estimator.optics import prescription as rx
from estimator.optics.zernike import N_TERMS, nm_from_index
from estimator.profiles.parse import EyeProfile, Measurement

LENGTH_PER_DPT_MM = -0.299
RADIUS_PER_DPT_MM = 0.022
"""Myopia is mostly a long eye: axial length and anterior corneal radius against the
spherical refraction (Atchison 2006)."""

REFRACTION_LIMITS_DPT = (-12.0, 6.0)
"""Range of refractions in which the two slopes above apply."""


@dataclass(frozen=True)
class Prior:
    """Independent normal prior in table order, in the units of the parameters."""

    _mean: NDArray[np.float64]
    _deviation: NDArray[np.float64]

    def to_unit(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parameters (..., 45) in deviations from the mean."""
        return (vectors - self._mean) / self._deviation

    def from_unit(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parameters from deviations, the inverse of `to_unit`."""
        return self._mean + unit * self._deviation

    def unit_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the allowed ranges in deviations from the mean."""
        low, high = allowed_ranges().T
        return self.to_unit(low), self.to_unit(high)


def mean_eyes(refraction_dpt: ArrayLike) -> NDArray[np.float64]:
    """Return vectors (..., 45) of the mean eyes of spherical refractions (...), dpt.

    Refractions are clamped to `REFRACTION_LIMITS_DPT`.
    """
    clipped_dpt = np.clip(refraction_dpt, *REFRACTION_LIMITS_DPT)
    eyes = np.broadcast_to(mean_vector(), (*np.shape(clipped_dpt), N_PARAMETERS)).copy()
    eyes[..., column("eye_length_mm")] += LENGTH_PER_DPT_MM * clipped_dpt
    eyes[..., column("cornea_anterior_radius_mm")] += RADIUS_PER_DPT_MM * clipped_dpt
    return eyes


def deviations() -> NDArray[np.float64]:
    """Return standard deviations (45,) about a mean eye, each in its own unit."""
    return np.array([row.deviation for row in PARAMETERS])


def prior_for_refraction(refraction_dpt: float) -> Prior:
    """Return the prior around the mean eye of a spherical refraction M, dpt."""
    return Prior(mean_eyes(refraction_dpt), deviations())


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
        distance = np.minimum(unit - low, high - unit)
        return tuple(
            name
            for name, ratio in zip(PARAMETER_NAMES, distance, strict=True)
            if ratio < ON_BOUND_RATIO
        )


WEIGHT_BY_ORDER = {1: 0.5, 2: 1.0, 3: 1.0, 4: 2.0, 5: 4.0, 6: 4.0}
ERROR_WEIGHT = 200.0
WRONG_SIGN_WEIGHT = 10.0
RIGHT_SIGN_UM = 1e-6

FIRST_MESH = 0.005
SMALLEST_MESH = 1e-6
LARGEST_MESH = 1.0

POPULATION = {
    # parameter: (mean, half width without a penalty, half range), in its own unit
    "eye_length_mm": (23.82, 0.81, 2.0),
    "cornea_thickness_mm": (0.55, 0.03, 0.16),
    "cornea_anterior_radius_mm": (7.81, 0.25, 2.0),
    "cornea_posterior_astigmatism_ratio": (1.0, 0.03, 0.2),
    "cornea_posterior_radius_ratio": (0.825, 0.03, 0.09),
    "cornea_anterior_conic_constant": (-0.29, 0.09, 3.0),
    "cornea_posterior_conic_constant": (-0.34, 0.24, 3.0),
    "cornea_anterior_rotation_deg": (0.0, 0.0, 45.0),
    "cornea_posterior_rotation_deg": (0.0, 0.0, 45.0),
    "aqueous_thickness_mm": (2.90, 0.39, 1.0),
    "lens_diameter_mm": (9.5, 0.3, 0.5),
    "lens_volume_mm3": (160.1, 2.5, 7.0),
    "lens_anterior_conic_constant": (-4.4, 1.6, 6.0),
    "lens_posterior_conic_constant": (-4.0, 2.0, 6.0),
    "lens_decentration_x_mm": (0.0, 0.0, 0.8),
    "lens_decentration_y_mm": (0.0, 0.0, 0.8),
    "lens_tilt_about_y_deg": (0.0, 0.0, 7.0),
    "lens_tilt_about_x_deg": (0.0, 0.0, 7.0),
}
"""Table of the published search; where our cornea has another parameter (ratios instead
of radii), the widths are converted."""

OFFSET_HALF_RANGE_MM = {1: 0.10, 2: 0.10, 3: 0.06, 4: 0.06, 5: 0.03, 6: 0.03}


@dataclass(frozen=True)
class SearchResult:
    """Best eye found, and the cost of the search."""

    parameters: EyeParameters
    loss_ratio: float
    n_iterations: int
    n_evaluations: int
    mesh_ratio: float
    stopped_by: str


def _table() -> NDArray[np.float64]:
    rows = [POPULATION.get(name, (0.0, 0.0, 0.0)) for name in PARAMETER_NAMES]
    for index in range(1, N_TERMS):
        half_range_mm = OFFSET_HALF_RANGE_MM[nm_from_index(index)[0]]
        rows[PARAMETER_NAMES.index(offset_name(index))] = (0.0, 0.0, half_range_mm)
    return np.array(rows)


def search_weights() -> NDArray[np.float64]:
    """Return the weights (28,) of the coefficients; piston has none."""
    orders = [nm_from_index(j)[0] for j in range(N_TERMS)]
    return np.array([WEIGHT_BY_ORDER.get(n, 0.0) for n in orders])


def search_loss(
    zernike_um: NDArray[np.float64], target_um: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weighted squared error (P,) of sets (P, 28); infinite where NaN."""
    # A zero up to rounding, as in the symmetric start, counts as the wrong sign:
    # otherwise rounding would decide between losses a factor of ten apart.
    wrong_sign = zernike_um * np.sign(target_um) < RIGHT_SIGN_UM
    wrong_sign &= target_um != 0.0
    weight = search_weights() * np.where(wrong_sign, WRONG_SIGN_WEIGHT, 1.0)
    error = weight * ERROR_WEIGHT * (zernike_um - target_um) ** 2
    error[..., 0] = 0.0
    loss = error.sum(axis=-1)
    return np.where(np.isnan(loss), np.inf, loss)


def pattern_search(
    zernike_of: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    *,
    target_um: NDArray[np.float64],
    max_time_s: float,
    max_evaluations: int | None = None,
) -> SearchResult:
    """Search from the mean eye.

    Parameters
    ----------
    zernike_of : callable
        Function from (P, 45) parameter vectors to (P, 28) um, with NaN rows where
        light does not pass.
    target_um : (28,)
    max_time_s : float
        Time limit; the published runs took one to three hours.

    Notes
    -----
    Every iteration polls both directions of every parameter in one batch and moves to
    the best of them: mesh x 2 after a success, x 1/2 otherwise.
    """
    mean, dead_zone, half_range = _table().T
    allowed = (allowed_ranges() - mean[:, None]) / half_range[:, None]
    low, high = np.clip(allowed, -1.0, 1.0).T
    directions = np.concatenate([np.eye(N_PARAMETERS), -np.eye(N_PARAMETERS)])

    def losses(units: NDArray[np.float64]) -> NDArray[np.float64]:
        outside = np.maximum(np.abs(units) - dead_zone / half_range, 0.0)
        zernike_um = zernike_of(mean + units * half_range)
        penalty: NDArray[np.float64] = np.sum(outside**2, axis=-1)
        return search_loss(zernike_um, target_um) + penalty

    start_s = time.perf_counter()
    position, mesh = np.zeros(N_PARAMETERS), FIRST_MESH
    best = float(losses(position[None])[0])
    n_iterations, n_evaluations, stopped_by = 0, 1, "mesh"
    while mesh >= SMALLEST_MESH:
        if time.perf_counter() - start_s > max_time_s:
            stopped_by = "time"
            break
        if max_evaluations is not None and n_evaluations >= max_evaluations:
            stopped_by = "evaluations"
            break
        polled = np.clip(position + mesh * directions, low, high)
        polled_losses = losses(polled)
        n_iterations += 1
        n_evaluations += len(polled)
        winner = int(np.argmin(polled_losses))
        if polled_losses[winner] < best:
            position, best = polled[winner], float(polled_losses[winner])
            mesh = min(2.0 * mesh, LARGEST_MESH)
        else:
            mesh *= 0.5
    parameters = EyeParameters.from_vector(mean + position * half_range)
    return SearchResult(parameters, best, n_iterations, n_evaluations, mesh, stopped_by)
