"""Change of the wavefront of one eye from its axis to the periphery.

The normal distribution of measured eyes (`population`) is conditioned on the axis of
this eye and on all other measured directions; the result is the most probable change,
or one drawn from the conditional distribution.  Off the horizontal meridian,
eyes deviate from the model of `population`; a Gaussian process that is zero on the
meridian represents the deviation.  It follows measurements and draws.  Its deviations
come from the five eyes of Polans 2015, because the population was measured on the
meridian alone.  Orders above the fourth, which the population does not contain, have
their on-axis values in all directions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.units import SPHERE_PER_C20
from estimator.optics.zernike import (
    N_TERMS,
    flip_horizontal,
    nm_from_index,
    rescale_pupil,
)
from estimator.periphery.population import (
    CIRCLE_MM,
    FREEDOM,
    LARGEST_SIZE,
    TERMS,
    Population,
    field_matrix,
    field_terms,
    measured_population,
)
from estimator.profiles.parse import EyeProfile, Measurement

NOISE_UM = 0.02
"""Standard deviation of a measured coefficient on the circle of `population`: the
repeatability of instruments, and the residual of the spline between knots."""

PRESCRIPTION_TERMS = (3, 4, 5)
"""Terms on the axis that a prescription determines; typical ones do not predict the
periphery, but a drawn person's terms do."""

FIRST_HIGHER = 6
"""OSA index of the first higher-order term."""

MAX_DISTANCE = 4.6
"""Mahalanobis distance on the axis (twelve terms) that 95 % of eyes do not exceed.
Eyes outside have the periphery of the eye at this distance; see `clamped_axis_um`."""

OFF_MERIDIAN_UM = dict(
    zip(
        TERMS,
        (0.23, 0.54, 0.30, 0.10, 0.12, 0.08, 0.06, 0.03, 0.03, 0.03, 0.04, 0.04),
        strict=True,
    )
)
"""RMS deviation of five eyes (Polans 2015) from the model of `population`, at 25 deg up
and down and within 30 deg to the sides."""

OFF_MERIDIAN_AT_DEG, CORRELATION_LENGTH_DEG = 25.0, 20.0

FIELD_STREAM = 1
"""Second seed of drawn changes; the axis has another (`typical_aberrations`)."""

N_FEATURES = 256
"""Number of cosines of a drawn Gaussian process."""

RELATIVE_JITTER = 1e-6
"""Added to variances, whose matrix is singular but for rounding."""

MAX_MISFIT_UM = 0.1
"""Largest RMS misfit of measurements that is not reported."""


@dataclass(frozen=True, eq=False)
class OffMeridianDraw:
    """A function drawn from the Gaussian process, as a sum of random cosines.

    Attributes
    ----------
    frequencies_per_deg : (N_FEATURES, 2)
        Angular frequencies, rad/deg.
    phases_rad : (N_FEATURES,)
    amplitudes_um : (N_FEATURES, 12)

    References
    ----------
    Rahimi & Recht 2007 (NIPS 20): random Fourier features.
    """

    frequencies_per_deg: NDArray[np.float64]
    phases_rad: NDArray[np.float64]
    amplitudes_um: NDArray[np.float64]

    @classmethod
    def draw(cls, random: np.random.RandomState, size: float) -> "OffMeridianDraw":
        """Draw a function, scaled by ``size``."""
        return cls(
            random.standard_normal((N_FEATURES, 2)) / CORRELATION_LENGTH_DEG,
            random.uniform(0.0, 2.0 * math.pi, N_FEATURES),
            size
            * math.sqrt(2.0 / N_FEATURES)
            * random.standard_normal((N_FEATURES, len(TERMS)))
            * list(OFF_MERIDIAN_UM.values()),
        )

    def at_um(
        self, h_deg: NDArray[np.float64], v_deg: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the deviation (n, 12) in directions (n,)."""
        directions_deg = np.stack([h_deg, v_deg], axis=-1)
        cosines = np.cos(directions_deg @ self.frequencies_per_deg.T + self.phases_rad)
        return v_deg[:, None] / OFF_MERIDIAN_AT_DEG * (cosines @ self.amplitudes_um)


@dataclass(frozen=True, eq=False)
class PeripheralChange:
    """Change of terms 3 to 14 over the field of one eye, with its uncertainty.

    Except for ``eye_side``, all values describe a right eye.

    Attributes
    ----------
    eye_side : str
        OD or OS.
    axis_um : (12,)
        Wavefront on the axis, on the circle of `population`.
    is_in_population : bool
        Whether it belongs to the eye and is not clamped to the population's range.
    knots_um : (120,)
        Change at the knots.
    sphere_deviation_dpt : (10,)
        Standard deviation of the change of M at the knots.
    off_meridian_h_deg, off_meridian_v_deg : (m,)
        Measured directions other than the axis.
    off_meridian_um : (m, 12)
        Weights of the Gaussian process at these directions.
    misfit_um : float
        RMS misfit of the measurements; 0 if there are none.
    sample : int or None
        Seed, if the change is drawn.
    off_meridian_draw : OffMeridianDraw or None
        Function of a drawn change, to which the weighted process is added.
    """

    eye_side: str
    axis_um: NDArray[np.float64]
    is_in_population: bool
    knots_um: NDArray[np.float64]
    sphere_deviation_dpt: NDArray[np.float64]
    off_meridian_h_deg: NDArray[np.float64]
    off_meridian_v_deg: NDArray[np.float64]
    off_meridian_um: NDArray[np.float64]
    misfit_um: float
    sample: int | None = None
    off_meridian_draw: OffMeridianDraw | None = None

    @property
    def measured_count(self) -> int:
        """Number of measured directions other than the axis."""
        return self.off_meridian_h_deg.size

    def zernike_um(self, h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
        """Return the change (n, 28), um, at directions (n,), on a radius of 2 mm."""
        h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
        h_deg = h_deg if self.eye_side == "OD" else -h_deg
        knots_um = self.knots_um.reshape(len(TERMS), -1)
        found_um = np.zeros((h_deg.size, N_TERMS))
        covariance = _off_meridian_covariance(
            (h_deg, v_deg), (self.off_meridian_h_deg, self.off_meridian_v_deg)
        )
        weights_um = self.off_meridian_um * _off_meridian_variances()
        found_um[:, TERMS[0] : TERMS[-1] + 1] = (
            field_terms(h_deg, v_deg, knots_um) + covariance @ weights_um
        )
        if self.off_meridian_draw is not None:
            found_um[:, TERMS[0] : TERMS[-1] + 1] += self.off_meridian_draw.at_um(
                h_deg, v_deg
            )
        return found_um if self.eye_side == "OD" else flip_horizontal(found_um)


def peripheral_change(
    profile: EyeProfile, population: Population | None = None
) -> PeripheralChange:
    """Return the change of the eye of a profile: drawn if it has a ``sample``.

    Without one, it is the most probable change.

    Parameters
    ----------
    profile : EyeProfile
    population : Population, optional
        `measured_population` by default.
    """
    population = population or measured_population()
    axis_um, noise_um = _axis(profile)
    clamped_um = clamped_axis_um(axis_um, noise_um, population)
    others = [m for m in profile.measurements if not m.is_on_axis]
    return _conditioned(
        population,
        profile.eye_side,
        axis=(clamped_um, noise_um),
        others=[_as_right_eye(m, profile.eye_side) for m in others],
        measured_axis_um=axis_um,
        sample=profile.sample,
    )


def clamped_axis_um(
    axis_um: NDArray[np.float64], noise_um: NDArray[np.float64], population: Population
) -> NDArray[np.float64]:
    """Return an on-axis wavefront (12,), limited to 95 % of the population.

    Outside this range, an extrapolated change would grow without bound.  The wavefront
    is moved toward the mean.
    """
    mean_um, covariance_um2 = _axis_distribution(population)
    away = axis_um - mean_um
    spread = covariance_um2 + np.diag(noise_um**2)
    distance = math.sqrt(float(away @ np.linalg.solve(spread, away)))
    if distance <= MAX_DISTANCE:
        return axis_um
    return mean_um + MAX_DISTANCE / distance * away


def _axis_distribution(population: Population) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return mean (12,) and covariance (12, 12) on the axis."""
    deviation_um = population.deviation_um
    n_places = deviation_um.shape[1]
    correlation = population.correlation_ratio[::n_places, ::n_places]
    at_axis = deviation_um[:, 0]
    return population.mean_um[:, 0], correlation * np.outer(at_axis, at_axis)


def _axis(profile: EyeProfile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the terms (12,) on the axis, as a right eye's, and their noise (12,)."""
    first = Measurement(
        profile.zernike_um, profile.pupil_diameter_mm, profile.wavelength_nm
    )
    axis_um, noise_um = _as_right_eye(first, profile.eye_side)[2:]
    is_drawn = profile.sample is not None and profile.zernike_um[FIRST_HIGHER:].any()
    if profile.kind == "prescription" and not is_drawn:
        is_prescribed = np.isin(TERMS, PRESCRIPTION_TERMS)
        noise_um = np.where(is_prescribed, noise_um, 1e3)
    return axis_um, noise_um


def _as_right_eye(
    measurement: Measurement, eye_side: str
) -> tuple[float, float, NDArray[np.float64], NDArray[np.float64]]:
    """Return direction, terms (12,) and noise (12,) on the circle of `population`."""
    zernike_um, h_deg = measurement.zernike_um, measurement.h_deg
    if eye_side == "OS":
        zernike_um, h_deg = flip_horizontal(zernike_um), -h_deg
    ratio = 2.0 * CIRCLE_MM / measurement.pupil_diameter_mm
    terms_um = rescale_pupil(zernike_um, radius_ratio=ratio)[list(TERMS)]
    orders = np.array([nm_from_index(j)[0] for j in TERMS])
    noise_um = NOISE_UM * np.maximum(ratio, 1.0) ** orders
    return h_deg, measurement.v_deg, terms_um, noise_um


def _conditioned(
    population: Population,
    eye_side: str,
    *,
    axis: tuple[NDArray[np.float64], NDArray[np.float64]],
    others: Sequence[tuple[float, float, NDArray[np.float64], NDArray[np.float64]]],
    measured_axis_um: NDArray[np.float64],
    sample: int | None = None,
) -> PeripheralChange:
    """Condition the population on the axis and on all other directions.

    A change is drawn by Matheron's rule: an eye drawn from the population is corrected
    by the difference of its simulated measurements from the actual ones.  One size for
    all of its deviations makes the distribution a t-distribution; see `LARGEST_SIZE`.
    """
    axis_um, axis_noise_um = axis
    mean_um = population.mean_um
    n_places = mean_um.shape[1]
    scale = population.deviation_um.ravel()
    covariance = population.correlation_ratio * np.outer(scale, scale)
    is_axis = np.arange(scale.size) % n_places == 0
    h_deg, v_deg = (np.array([m[k] for m in others]) for k in (0, 1))
    observation: list[NDArray[np.float64]] | NDArray[np.float64]
    observation = [np.eye(scale.size)[is_axis]]
    if others:
        rows = np.zeros((len(others) * len(TERMS), scale.size))
        rows[:, ~is_axis] = field_matrix(h_deg, v_deg).reshape(len(rows), -1)
        observation.append(rows)
    observation = np.concatenate(observation)
    measured_um = np.concatenate([axis_um, *(m[2] - measured_axis_um for m in others)])
    noise_um2 = np.concatenate([axis_noise_um, *(m[3] for m in others)]) ** 2
    off_meridian_um2 = np.kron(
        _off_meridian_covariance((h_deg, v_deg), (h_deg, v_deg)),
        np.diag(_off_meridian_variances()),
    )
    total = observation @ covariance @ observation.T + np.diag(noise_um2)
    total[len(TERMS) :, len(TERMS) :] += off_meridian_um2
    prior_um, draw = mean_um.ravel(), None
    weights: NDArray[Any] = np.linalg.solve(total, measured_um - observation @ prior_um)
    residual_um = (noise_um2 * weights)[len(TERMS) :]
    if sample is not None:
        # The stream of `RandomState` is the same in all versions of NumPy.
        random = np.random.RandomState([sample, FIELD_STREAM])
        root = _covariance_root(population)
        size = drawn_size(random)
        prior_um = prior_um + size * (root @ random.standard_normal(scale.size))
        draw = OffMeridianDraw.draw(random, size)
        noise_um = np.sqrt(noise_um2) * random.standard_normal(noise_um2.size)
        simulated_um = observation @ prior_um + size * noise_um
        simulated_um[len(TERMS) :] += draw.at_um(h_deg, v_deg).ravel()
        weights = np.linalg.solve(total, measured_um - simulated_um)
    gain = np.linalg.solve(total, observation @ covariance)
    found_um = prior_um + weights @ (observation @ covariance)
    posterior_um2 = np.diag(covariance - (observation @ covariance).T @ gain)
    return PeripheralChange(
        eye_side=eye_side,
        axis_um=axis_um,
        is_in_population=bool(np.array_equal(axis_um, measured_axis_um)),
        knots_um=found_um[~is_axis],
        sphere_deviation_dpt=_sphere_deviation_dpt(posterior_um2[~is_axis]),
        off_meridian_h_deg=h_deg,
        off_meridian_v_deg=v_deg,
        off_meridian_um=weights[len(TERMS) :].reshape(-1, len(TERMS)),
        misfit_um=float(np.sqrt(np.mean(residual_um**2))) if others else 0.0,
        sample=sample,
        off_meridian_draw=draw,
    )


@lru_cache(maxsize=2)
def _covariance_root(population: Population) -> NDArray[np.float64]:
    """Return a root (n, n) of the covariance of a population, which takes 2 ms."""
    scale = population.deviation_um.ravel()
    covariance = population.correlation_ratio * np.outer(scale, scale)
    root: NDArray[Any] = np.linalg.cholesky(
        covariance + np.diag(RELATIVE_JITTER * scale**2)
    )
    return root


def drawn_size(random: np.random.RandomState) -> float:
    """Return the factor of all deviations of a drawn person, at most `LARGEST_SIZE`."""
    return min(math.sqrt((FREEDOM - 2) / random.chisquare(FREEDOM)), LARGEST_SIZE)


def _sphere_deviation_dpt(variances_um2: NDArray[Any]) -> NDArray[np.float64]:
    """Return the standard deviation (10,) of M from variances (120,) at the knots."""
    sphere_um2 = variances_um2.reshape(len(TERMS), -1)[TERMS.index(4)]
    return SPHERE_PER_C20 * np.sqrt(np.maximum(sphere_um2, 0.0)) / CIRCLE_MM**2


def _off_meridian_variances() -> NDArray[np.float64]:
    """Return the variance (12,) of the Gaussian process at `OFF_MERIDIAN_AT_DEG`."""
    return np.square(list(OFF_MERIDIAN_UM.values()))


def _off_meridian_covariance(
    at_deg: tuple[NDArray[Any], NDArray[Any]],
    measured_deg: tuple[NDArray[Any], NDArray[Any]],
) -> NDArray[np.float64]:
    """Return the correlation (n, m) of the Gaussian process between directions."""
    (h, v), (h0, v0) = at_deg, measured_deg
    square = (h[:, None] - h0) ** 2 + (v[:, None] - v0) ** 2
    near = np.exp(-0.5 * square / CORRELATION_LENGTH_DEG**2)
    return near * v[:, None] * v0 / OFF_MERIDIAN_AT_DEG**2
