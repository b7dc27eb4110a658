"""Change of one eye's wavefront from its axis to the periphery.

The normal distribution of measured people (`population`) is conditioned on this eye's
axis, and on other directions if they were measured.  Measurements off the horizontal
meridian may depart from `meridian`'s forms; a smooth field, zero on the meridian,
represents this departure.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
from estimator.periphery.meridian import (
    CIRCLE_MM,
    TERMS,
    field_matrix,
    field_terms,
)
from estimator.periphery.population import Population, measured_population
from estimator.profiles.parse import EyeProfile, Measurement

NOISE_UM = 0.02
"""Noise of a measured coefficient on the population's circle: the repeatability of
instruments, and the residual of a spline between knots."""

SECOND_ORDER = (3, 4, 5)
"""Terms of the axis that a prescription determines."""

USUAL_DISTANCE = 4.6
"""Mahalanobis distance on the axis within which 95 % of people lie (twelve terms).  An
eye beyond has the periphery of the eye on this border, see `usual_axis_um`."""

FREE_UM = dict(
    zip(
        TERMS,
        (0.23, 0.54, 0.30, 0.10, 0.12, 0.08, 0.06, 0.03, 0.03, 0.03, 0.04, 0.04),
        strict=True,
    )
)
"""Root mean square departure of five measured people (Polans 2015) from the prediction
of their axis by `meridian`'s forms, at 25 deg up and down and within 30 deg to the
sides."""

FREE_AT_DEG, FREE_REACH_DEG = 25.0, 20.0

DISAGREES_UM = 0.1
"""Allowed root mean square difference between measurements and the smooth field."""


@dataclass(frozen=True, eq=False)
class PeripheralChange:
    """Change of terms 3 to 14 over the field of one eye, with its uncertainty.

    Attributes
    ----------
    eye_side : str
        OD or OS.
    axis_um : (12,)
        Wavefront on the axis, as a right eye's, on the circle of `meridian`.
    is_usual : bool
        Whether that is the eye's own axis.
    knots_um : (96,)
        Change at the knots, as a right eye's.
    sphere_deviation_dpt : (8,)
        Standard deviation of the change of M at the knots.
    free_h_deg, free_v_deg : (m,)
        Measured directions, as a right eye's.
    free_um : (m, 12)
        Weights of the smooth field that is zero on the meridian.
    miss_um : float
        Root mean square misfit of the measurements; 0 without any.
    """

    eye_side: str
    axis_um: NDArray[np.float64]
    is_usual: bool
    knots_um: NDArray[np.float64]
    sphere_deviation_dpt: NDArray[np.float64]
    free_h_deg: NDArray[np.float64]
    free_v_deg: NDArray[np.float64]
    free_um: NDArray[np.float64]
    miss_um: float

    @property
    def measured_count(self) -> int:
        """Number of measured directions other than the axis."""
        return self.free_h_deg.size

    def zernike_um(self, h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
        """Return the change (n, 28) at directions (n,), on a circle of 2 mm radius."""
        h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
        h_deg = h_deg if self.eye_side == "OD" else -h_deg
        knots_um = self.knots_um.reshape(len(TERMS), -1)
        found_um = np.zeros((h_deg.size, N_TERMS))
        found_um[:, TERMS[0] : TERMS[-1] + 1] = field_terms(
            h_deg, v_deg, knots_um
        ) + _free_products((h_deg, v_deg), (self.free_h_deg, self.free_v_deg)) @ (
            self.free_um * _free_variances()
        )
        return found_um if self.eye_side == "OD" else flip_horizontal(found_um)


def peripheral_change(
    profile: EyeProfile, population: Population | None = None
) -> PeripheralChange:
    """Return the most probable change of a profile's eye.

    Parameters
    ----------
    population : Population, optional
        Population; that of measured people by default.
    """
    population = population or measured_population()
    axis_um, noise_um = _axis(profile)
    usual_um = usual_axis_um(axis_um, noise_um, population)
    others = [m for m in profile.measurements if not m.is_on_axis]
    return _conditioned(
        population,
        profile.eye_side,
        axis=(usual_um, noise_um),
        others=[_as_right_eye(m, profile.eye_side) for m in others],
        measured_axis_um=axis_um,
    )


def usual_axis_um(
    axis_um: NDArray[np.float64], noise_um: NDArray[np.float64], population: Population
) -> NDArray[np.float64]:
    """Return the wavefront (12,) on the axis, limited to the range of measured people.

    Beyond that range it is moved toward the mean: an extrapolated change would grow
    without bound.
    """
    mean_um, covariance_um2 = _axis_distribution(population)
    away = axis_um - mean_um
    spread = covariance_um2 + np.diag(noise_um**2)
    distance = math.sqrt(float(away @ np.linalg.solve(spread, away)))
    if distance <= USUAL_DISTANCE:
        return axis_um
    usual_um: NDArray[np.float64] = mean_um + USUAL_DISTANCE / distance * away
    return usual_um


def _axis_distribution(population: Population) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return mean (12,) and covariance (12, 12) on the axis."""
    deviation_um = population.deviation_um
    places = deviation_um.shape[1]
    correlation = population.correlation_ratio[::places, ::places]
    at_axis = deviation_um[:, 0]
    return population.mean_um[:, 0], correlation * np.outer(at_axis, at_axis)


def _axis(profile: EyeProfile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return terms (12,) of the axis as a right eye's, and their noise (12,)."""
    first = Measurement(
        profile.zernike_um, profile.pupil_diameter_mm, profile.wavelength_nm
    )
    axis_um, noise_um = _as_right_eye(first, profile.eye_side)[2:]
    if profile.kind == "prescription":
        is_told = np.isin(TERMS, SECOND_ORDER)
        noise_um = np.where(is_told, noise_um, 1e3)
    return axis_um, noise_um


def _as_right_eye(
    measurement: Measurement, eye_side: str
) -> tuple[float, float, NDArray[np.float64], NDArray[np.float64]]:
    """Return direction, terms (12,) and noise (12,) on the population's circle."""
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
) -> PeripheralChange:
    """Condition the population on the axis and all other directions at once."""
    axis_um, axis_noise_um = axis
    mean_um = population.mean_um
    places = mean_um.shape[1]
    scale = population.deviation_um.ravel()
    covariance = population.correlation_ratio * np.outer(scale, scale)
    is_axis = np.arange(scale.size) % places == 0
    h_deg, v_deg = (np.array([m[k] for m in others]) for k in (0, 1))
    seen: list[NDArray[np.float64]] | NDArray[np.float64]
    seen = [np.eye(scale.size)[is_axis]]
    if others:
        rows = np.zeros((len(others) * len(TERMS), scale.size))
        rows[:, ~is_axis] = field_matrix(h_deg, v_deg).reshape(len(rows), -1)
        seen.append(rows)
    seen = np.concatenate(seen)
    told_um = np.concatenate([axis_um, *(m[2] - measured_axis_um for m in others)])
    noise_um2 = np.concatenate([axis_noise_um, *(m[3] for m in others)]) ** 2
    free_um2 = np.kron(
        _free_products((h_deg, v_deg), (h_deg, v_deg)), np.diag(_free_variances())
    )
    total = seen @ covariance @ seen.T + np.diag(noise_um2)
    total[len(TERMS) :, len(TERMS) :] += free_um2
    surprise_um = told_um - seen @ mean_um.ravel()
    weights: NDArray[Any] = np.linalg.solve(total, surprise_um)
    gain = np.linalg.solve(total, seen @ covariance)
    found_um = mean_um.ravel() + weights @ (seen @ covariance)
    left_um2 = np.diag(covariance - (seen @ covariance).T @ gain)
    missed_um = (noise_um2 * weights)[len(TERMS) :]
    return PeripheralChange(
        eye_side=eye_side,
        axis_um=axis_um,
        is_usual=bool(np.array_equal(axis_um, measured_axis_um)),
        knots_um=found_um[~is_axis],
        sphere_deviation_dpt=_sphere_deviation_dpt(left_um2[~is_axis]),
        free_h_deg=h_deg,
        free_v_deg=v_deg,
        free_um=weights[len(TERMS) :].reshape(-1, len(TERMS)),
        miss_um=float(np.sqrt(np.mean(missed_um**2))) if others else 0.0,
    )


def _sphere_deviation_dpt(variances_um2: NDArray[Any]) -> NDArray[np.float64]:
    """Return the deviation (8,) of M from variances (96,) at the knots."""
    sphere_um2 = variances_um2.reshape(len(TERMS), -1)[TERMS.index(4)]
    deviation_dpt: NDArray[np.float64] = (
        SPHERE_PER_C20 * np.sqrt(np.maximum(sphere_um2, 0.0)) / CIRCLE_MM**2
    )
    return deviation_dpt


def _free_variances() -> NDArray[np.float64]:
    """Return the variance (12,) of the smooth field at `FREE_AT_DEG`."""
    return np.square(list(FREE_UM.values()))


def _free_products(
    at_deg: tuple[NDArray[Any], NDArray[Any]],
    measured_deg: tuple[NDArray[Any], NDArray[Any]],
) -> NDArray[np.float64]:
    """Return the smooth field's covariance (n, m) between directions, unit variance."""
    (h, v), (h0, v0) = at_deg, measured_deg
    square = (h[:, None] - h0) ** 2 + (v[:, None] - v0) ** 2
    near = np.exp(-0.5 * square / FREE_REACH_DEG**2)
    products: NDArray[np.float64] = near * v[:, None] * v0 / FREE_AT_DEG**2
    return products
