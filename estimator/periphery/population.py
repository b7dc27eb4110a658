"""Mean and covariance of wavefronts on the axis and along the horizontal meridian.

There are few eyes and many variables.  The periphery is predicted from the axis by
ridge regression, with a smaller penalty on the sphere than on other terms.  Each
prediction is shrunk by the fraction that chance explains (James and Stein).  Penalties
are those with the smallest cross-validation error that, at every angle, do not predict
worse than the sphere alone.

The residuals have a multivariate t-distribution, whose covariance is shrunk.  Its
maximum-likelihood estimate gives less weight to eyes that are far from the others, and
none to the farthest: in a sample covariance, three people with a relative M of -3 to
-6 dpt at 20 deg temporal raise the standard deviation of M there by 0.3 dpt and hide
most of the correlation of M with J0.

Wavefronts are extended from the horizontal meridian, along which eyes were measured, to
the whole visual field.  About the symmetry axis of a nearly rotationally symmetric eye
(angle alpha), nodal aberration theory (Thompson, JOSA A 22, 2005) gives the dependence
on direction H = h + iv: defocus is proportional to |H|², astigmatism to H² and coma to
H.  A shift of the axis adds terms in H to the first two.  Terms that are even along the
meridian therefore rotate with one multiple of the azimuth, and odd terms with another.

For five eyes measured over +-40 x 25 deg (Polans 2015), this is as accurate as the mean
of the other four.  Separate vertical terms, fitted to those four, are no improvement.

Measured eyes are all right eyes in the project's frame.  The data are from Jaeken &
Artal, IOVS 53(7), 2012, as distributed with ISETBio (MIT license): both eyes of 65
people along the horizontal meridian, 4 mm.  Angles in the file are positive in the
temporal retina of a right eye, whose visual field is to the left: h = -angle.
Coefficients are in the project's frame, as the sign of coma shows.  Left eyes are
mirrored.
"""

import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.bounded_files import InvalidFile, read_bytes, reason_of
from estimator.optics.interpolation import CubicSpline
from estimator.optics.zernike import N_TERMS, flip_horizontal

SMOOTHING_RATIO = 0.15
"""Standard deviation of the Gaussian weights, over the angle of a knot, of the fit of a
parabola about it.  The change is small near the axis, and no window extends past it."""

LEAST_SMOOTHING_DEG = 1.5
"""Smallest standard deviation; directions are 1 deg apart."""

LEAST_POINTS = 2
MAX_FILE_BYTES = 10_000_000
"""Size limit of a file and of each of its arrays; 130 eyes take 0.4 MB."""

_DAMAGED = (
    *(ValueError, KeyError, TypeError, OSError, EOFError, OverflowError),
    *(NotImplementedError, RuntimeError, MemoryError, SyntaxError, zlib.error),
)
"""What NumPy and zipfile raise for damaged files."""


class MeasuredEyes(NamedTuple):
    """Wavefronts of measured eyes along the horizontal meridian.

    Attributes
    ----------
    person : (n,)
        Index of the person.
    is_left : (n,)
        Whether it is a left eye, mirrored.
    h_deg : (n_directions,)
        Azimuths, ascending.
    zernike_um : (n, n_directions, 12)
        Coefficients of `TERMS`; NaN where an eye was not measured.
    """

    person: NDArray[np.int64]
    is_left: NDArray[np.bool_]
    h_deg: NDArray[np.float64]
    zernike_um: NDArray[np.float64]

    @property
    def axis_um(self) -> NDArray[np.float64]:
        """Coefficients on the axis, (n, 12)."""
        return self.zernike_um[:, np.flatnonzero(self.h_deg == 0.0)[0]]

    @property
    def change_um(self) -> NDArray[np.float64]:
        """Coefficients minus those on the axis, (n, n_directions, 12)."""
        return self.zernike_um - self.axis_um[:, None]

    def select(self, is_selected: NDArray[np.bool_]) -> "MeasuredEyes":
        """Return the eyes for which a mask (n,) is True."""
        return MeasuredEyes(
            self.person[is_selected],
            self.is_left[is_selected],
            self.h_deg,
            self.zernike_um[is_selected],
        )


def load_measured_eyes(file: Path) -> MeasuredEyes:
    """Read the eyes of Jaeken & Artal from ``peripheral_wavefronts.npz``.

    Raises
    ------
    InvalidFile
        The file is damaged, too large, or does not contain these arrays.
    """
    found = _arrays(file)
    measured_um, angle_deg = (
        found["jaeken_zernike_um"],
        found["jaeken_eccentricity_deg"],
    )
    person = found["jaeken_subject"].astype(np.int64)
    shape = (2, len(person), len(angle_deg))
    if measured_um.shape[:3] != shape or not 15 <= measured_um.shape[3] <= N_TERMS:
        problem = f"jaeken_zernike_um has the shape {measured_um.shape}"
        raise InvalidFile(file, problem, f"{shape} and 15 to {N_TERMS} terms")
    if not (np.all(np.diff(angle_deg) > 0.0) and np.all(angle_deg == -angle_deg[::-1])):
        problem = "jaeken_eccentricity_deg is not ascending and symmetrical"
        raise InvalidFile(file, problem, "angles from -h to h, 0 in the middle")
    zernike_um = np.zeros((*measured_um.shape[:3], N_TERMS))
    zernike_um[..., : measured_um.shape[3]] = measured_um
    right, left = zernike_um
    left = flip_horizontal(left)[:, ::-1]  # angles are symmetrical about 0
    eyes_um = np.concatenate([right, left])[:, ::-1, list(TERMS)]
    is_left = np.repeat([False, True], len(person))
    return MeasuredEyes(np.tile(person, 2), is_left, -angle_deg[::-1], eyes_um)


_DIMENSIONS = {
    "jaeken_zernike_um": 4,
    "jaeken_eccentricity_deg": 1,
    "jaeken_subject": 1,
}


def _arrays(file: Path) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of `_DIMENSIONS`; check sizes before unpacking."""
    content = read_bytes(file, max_bytes=MAX_FILE_BYTES)
    found = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            for name, n_dimensions in _DIMENSIONS.items():
                entry = packed.getinfo(f"{name}.npy")
                if entry.file_size > MAX_FILE_BYTES:
                    problem = f"{name} has {entry.file_size:,} bytes"
                    raise InvalidFile(file, problem, f"at most {MAX_FILE_BYTES:,}")
                array = np.load(io.BytesIO(packed.read(entry)), allow_pickle=False)
                if array.ndim != n_dimensions or array.dtype.kind not in "fiu":
                    problem = f"{name} is {array.dtype} of shape {array.shape}"
                    raise InvalidFile(file, problem, f"{n_dimensions} axes of numbers")
                found[name] = array.astype(np.float64)
    except InvalidFile:
        raise
    except (*_DAMAGED, zipfile.BadZipFile) as error:
        problem = f"cannot be read ({reason_of(error)})"
        raise InvalidFile(file, problem, "an .npz file of measured eyes") from None
    return found


def knots_um(eyes: MeasuredEyes) -> NDArray[np.float64]:
    """Return smoothed changes (n, 12, 10) at the knots; NaN where not measured."""
    change_um, h_deg = eyes.change_um, eyes.h_deg
    found = np.full((len(change_um), len(TERMS), len(KNOTS_DEG)), np.nan)
    for eye, rows_um in enumerate(change_um):
        is_known = np.isfinite(rows_um).all(axis=1)
        for knot, at_deg in enumerate(KNOTS_DEG):
            away = h_deg - at_deg
            width_deg = max(SMOOTHING_RATIO * abs(at_deg), LEAST_SMOOTHING_DEG)
            if (is_known & (np.abs(away) <= width_deg)).sum() < LEAST_POINTS:
                continue
            near = is_known & (np.abs(away) <= 2.5 * width_deg)
            root = np.exp(-0.25 * np.square(away[near] / width_deg))[:, None]
            parabola = np.stack([away[near] ** k for k in range(3)], axis=-1)
            fitted = np.linalg.lstsq(root * parabola, root * rows_um[near], rcond=None)
            found[eye, :, knot] = fitted[0][0]
    return found


TERMS = tuple(range(3, 15))
"""OSA indices of the measured terms: orders 2 to 4."""

SECOND_ORDER = (3, 4, 5)
"""OSA indices of the terms of J45, M and J0."""

CIRCLE_MM = 2.0
"""Radius of the circle of the coefficients."""

KNOTS_DEG = (-40.0, -30.0, -20.0, -10.0, -5.0, 5.0, 10.0, 20.0, 30.0, 40.0)
"""Azimuths h of the knots, in a right eye.  Those at 5 deg are there because M, in the
mean, rises by 0.1 dpt between the axis and 5 deg temporal, and falls beyond: a spline
without them misses that, and the modulation at 5 deg is 0.02 too high."""

MEASURED_DEG = 40.0
"""Largest measured angle; beyond it, the slope decays exponentially."""

FADE_DEG = 15.0

_AZIMUTHAL_ORDERS = (
    # cosine term, sine term, azimuthal order of the even part and of the odd part
    (4, None, 0, 1),
    (5, 3, 2, 1),
    (8, 7, 0, 1),
    (9, 6, 2, 1),
    (12, None, 0, 1),
    (13, 11, 2, 1),
    (14, 10, 2, 1),
)


def meridian_weights(h_deg: ArrayLike) -> NDArray[np.float64]:
    """Return spline weights (..., 10) of the knots at azimuths (...), 0 on the axis."""
    h_deg = np.asarray(h_deg, dtype=np.float64)
    spline = _spline()
    inside = np.clip(h_deg, -MEASURED_DEG, MEASURED_DEG)
    beyond = h_deg - inside
    if not beyond.any():
        return spline(inside)
    faded = np.sign(beyond) * FADE_DEG * -np.expm1(-np.abs(beyond) / FADE_DEG)
    return spline(inside) + faded[..., None] * spline.slopes(inside)


@cache
def _spline() -> CubicSpline:
    nodes = np.array(sorted((*KNOTS_DEG, 0.0)))
    values = np.delete(np.eye(nodes.size), nodes.searchsorted(0.0), axis=1)
    return CubicSpline(nodes, values)


def field_terms(
    h_deg: ArrayLike, v_deg: ArrayLike, knots: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return terms (n, 12) at directions (n,) from those at the knots (12, 10).

    The result is the product of `field_matrix` and the knots, in a tenth of the time,
    because most of the matrix is zero.
    """
    h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
    angle_deg, azimuth = np.hypot(h_deg, v_deg), np.arctan2(v_deg, h_deg)
    right, left = (meridian_weights(a) @ knots.T for a in (angle_deg, -angle_deg))
    parts = 0.5 * (right + left), 0.5 * (right - left)
    found = np.zeros((h_deg.size, len(TERMS)))
    rotations = [(np.cos(k * azimuth), np.sin(k * azimuth)) for k in range(3)]
    for cosine, sine, *orders in _AZIMUTHAL_ORDERS:
        c, s = TERMS.index(cosine), None if sine is None else TERMS.index(sine)
        for part, order in zip(parts, orders, strict=True):
            cos, sin = rotations[order]
            found[:, c] += cos * part[:, c]
            if s is not None:
                found[:, c] -= sin * part[:, s]
                found[:, s] += cos * part[:, s] + sin * part[:, c]
    return found


def field_matrix(h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix (n, 12, 12, 10) from terms at the knots to directions (n,)."""
    h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
    angle_deg, azimuth = np.hypot(h_deg, v_deg), np.arctan2(v_deg, h_deg)
    right, left = meridian_weights(angle_deg), meridian_weights(-angle_deg)
    matrix = np.zeros((h_deg.size, len(TERMS), len(TERMS), len(KNOTS_DEG)))
    for cosine, sine, *orders in _AZIMUTHAL_ORDERS:
        parts = (0.5 * (right + left), 0.5 * (right - left))
        for part, order in zip(parts, orders, strict=True):
            along = np.cos(order * azimuth)[:, None] * part
            across = np.sin(order * azimuth)[:, None] * part
            c = TERMS.index(cosine)
            matrix[:, c, c] += along
            if sine is not None:
                s = TERMS.index(sine)
                matrix[:, s, s] += along
                matrix[:, c, s] -= across
                matrix[:, s, c] += across
    return matrix


POPULATION_FILE = Path(__file__).parent / "population.json"

N_PLACES = 1 + len(KNOTS_DEG)
"""Number of positions of each term: the axis and the knots."""

SPHERE_RIDGE, OTHER_RIDGE = 20.0, 400.0
"""Penalties of the regression on standardized terms of the axis."""

AXIS_SHRINKAGE = 0.95
"""Shrinkage factor of covariances between terms on the axis."""

SAME_TERM_SHRINKAGE, M_J0_SHRINKAGE, OTHER_TERM_SHRINKAGE = 0.98, 0.9, 0.5
"""Shrinkage factors of covariances of residuals: between angles of one term, between M
and J0, and between other terms.  They have the smallest cross-validated squared error
of covariances (Ledoit & Wolf, J Multivar Anal 88:365, 2004): 0.92 to 0.99, 0.85 to 0.92
and 0.3 to 0.6 in the training sets of five folds; within these ranges they have the
largest likelihood.  At 30 deg nasal, M and J0 have a correlation of 0.6 in measured
eyes; most other relations between terms are chance."""

FREEDOM = 8
"""Degrees of freedom of the residuals' t-distribution: of 5, 6, 8, 12, 20 and infinite
ones, 5 to 8 have the largest cross-validated likelihood, 4 nat an eye over infinite
ones."""

LARGEST_SIZE = 2.0
"""Largest factor of an eye's deviations in the t-distribution, which one in 130 eyes
exceeds, as many as were measured.  Drawn persons have no larger one, as in a screened
population, and six measured eyes of five people that have are not used for the
covariance.  With the limit, deviations and correlations of people left out are
predicted better in 4 and in 5 of five training sets."""

WEIGHT_ITERATIONS = 30
"""Iterations for the weights of eyes, which then change by less than 1e-3."""

EM_ITERATIONS = 15
"""Iterations of expectation and maximization, for eyes with missing directions."""

RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class Population:
    """Normal distribution of 12 terms at 11 positions, the axis first.

    Attributes
    ----------
    mean_um, deviation_um : (12, 11)
    correlation_ratio : (132, 132)
        Correlations, in C order of terms and positions.
    """

    mean_um: NDArray[np.float64]
    deviation_um: NDArray[np.float64]
    correlation_ratio: NDArray[np.float64]

    @classmethod
    def fit(cls, eyes: MeasuredEyes) -> "Population":
        """Fit the distribution to measured eyes; those without an axis are omitted."""
        has_axis = np.isfinite(eyes.axis_um).all(axis=-1)
        eyes = eyes.select(cast("NDArray[np.bool_]", has_axis))
        axis_um = eyes.axis_um
        away_um = axis_um - axis_um.mean(axis=0)
        changes_um = knots_um(eyes).reshape(len(axis_um), -1)
        slopes, mean_um = _ridge_regression(away_um, changes_um)
        axis_um2 = away_um.T @ away_um / len(away_um)
        axis_um2 *= np.where(np.eye(len(TERMS), dtype=bool), 1.0, AXIS_SHRINKAGE)
        residual_um2 = _residual_covariance_um2(
            changes_um - mean_um - away_um @ slopes.T, eyes.is_left
        )
        covariance_um2 = np.block(
            [
                [axis_um2, axis_um2 @ slopes.T],
                [slopes @ axis_um2, slopes @ axis_um2 @ slopes.T + residual_um2],
            ]
        )
        order = _by_terms()
        covariance_um2 = covariance_um2[np.ix_(order, order)]
        deviation_um = np.sqrt(np.diag(covariance_um2))
        mean_um = np.concatenate([axis_um.mean(axis=0), mean_um])[order]
        shape = (len(TERMS), N_PLACES)
        return cls(
            mean_um.reshape(shape),
            deviation_um.reshape(shape),
            covariance_um2 / np.outer(deviation_um, deviation_um),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``population.json``."""
        rows = [row[: k + 1] for k, row in enumerate(self.correlation_ratio)]
        return {
            "terms": list(TERMS),
            "h_deg": [0.0, *KNOTS_DEG],
            "mean_um": _rounded(self.mean_um),
            "deviation_um": _rounded(self.deviation_um),
            "correlation": [_rounded(row) for row in rows],
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> "Population":
        """Return the population of a result of `to_json`."""
        size = len(TERMS) * N_PLACES
        correlation = np.zeros((size, size))
        for k, row in enumerate(data["correlation"]):
            correlation[k, : k + 1] = correlation[: k + 1, k] = row
        return cls(
            np.array(data["mean_um"]), np.array(data["deviation_um"]), correlation
        )


@cache
def measured_population() -> Population:
    """Return the population of ``population.json``."""
    text = POPULATION_FILE.read_text(encoding="utf-8")
    return Population.from_json(json.loads(text))


def _rounded(values: NDArray[np.float64]) -> list[Any]:
    return np.vectorize(lambda v: float(f"{v:.5g}"))(values).tolist()


def _by_terms() -> NDArray[np.int64]:
    """Return indices (132,) that sort axis and knots by terms and positions."""
    axis = np.arange(len(TERMS))[:, None]
    knots = len(TERMS) + np.arange(len(TERMS) * len(KNOTS_DEG))
    return np.concatenate([axis, knots.reshape(len(TERMS), -1)], axis=1).ravel()


def _ridge_regression(
    axis_um: NDArray[np.float64], changes_um: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return slopes (120, 12) and intercepts (120,) over the centered axis (n, 12)."""
    deviation_um = axis_um.std(axis=0)
    penalty = np.full(len(TERMS), OTHER_RIDGE)
    penalty[TERMS.index(4)] = SPHERE_RIDGE
    slopes, mean_um = np.zeros((changes_um.shape[1], len(TERMS))), []
    for k, column in enumerate(changes_um.T):
        known = np.isfinite(column)
        inputs = axis_um[known] / deviation_um
        center = inputs.mean(axis=0)
        inputs, targets = inputs - center, column[known] - column[known].mean()
        square = inputs.T @ inputs
        ridge = np.linalg.inv(square + np.diag(penalty))
        weights = ridge @ inputs.T @ targets
        residual = float(np.mean((targets - inputs @ weights) ** 2))
        explained = max(float(np.mean(targets**2)) - residual, 1e-12)
        freedom = float(np.trace(ridge @ square)) / known.sum()
        weights *= max(1.0 - freedom * residual / explained, 0.0)
        slopes[k] = weights / deviation_um
        mean_um.append(column[known].mean() - center @ weights)
    return slopes, np.array(mean_um)


def _residual_covariance_um2(
    residual_um: NDArray[np.float64], is_left: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the covariance (120, 120) of residuals (n, 120), some of them missing.

    Both sides are centered.  The mean J45 of mirrored left eyes differs from that of
    right ones, in the same direction at both sides of the field, by 0.15 dpt at 30 deg:
    an instrument or a head that is turned does that.  In the covariance, it would halve
    the antisymmetry of J45.
    """
    residual_um = residual_um.copy()
    for side in (is_left, ~is_left):
        residual_um[side] -= np.nanmean(residual_um[side], axis=0)
    deviation_um = np.nanstd(residual_um, axis=0)
    units = residual_um / deviation_um
    second_order = np.isin(TERMS, SECOND_ORDER).repeat(len(KNOTS_DEG))
    weights = _weights(units[:, second_order])
    used, weights = units[weights > 0.0], weights[weights > 0.0]
    covariance = _shrunk_covariance(np.sqrt(weights)[:, None] * used)
    # The weights estimate the size of deviations of the second order; for other terms
    # they only weight a mean.
    deviation_um[~second_order] /= np.sqrt(weights.mean())
    return covariance * np.outer(deviation_um, deviation_um)


def _weights(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights (n,) of rows with missing values in a t-distribution.

    The weighted covariance is the maximum-likelihood estimate (Lange, Little & Taylor,
    J Am Stat Assoc 84:881, 1989) for the rows up to `LARGEST_SIZE`; others have the
    weight 0.
    """
    covariance = np.eye(units.shape[1])
    weights = np.ones(len(units))
    patterns, pattern = np.unique(np.isfinite(units), axis=0, return_inverse=True)
    for k in range(WEIGHT_ITERATIONS):
        limit = LARGEST_SIZE**2 if k >= WEIGHT_ITERATIONS // 3 else np.inf
        for which, at in enumerate(patterns):
            rows, count = pattern == which, at.sum()
            values = units[np.ix_(rows, at)].T
            square = np.sum(
                values * np.linalg.solve(covariance[np.ix_(at, at)], values), axis=0
            )
            found = (FREEDOM + count) / (FREEDOM - 2 + square)
            weights[rows] = np.where(square <= limit * count, found, 0.0)
        used = weights > 0.0
        filled, imputed_covariance = _imputed(units[used], covariance)
        covariance = (weights[used] * filled.T) @ filled + imputed_covariance
        covariance = covariance / used.sum() + RIDGE * np.eye(len(covariance))
    return weights


def _shrunk_covariance(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shrunk covariance (120, 120) about 0 of rows with missing values."""
    covariance, shrinkage = np.eye(units.shape[1]), _shrinkage()
    for _ in range(EM_ITERATIONS):
        filled, imputed_covariance = _imputed(units, covariance)
        covariance = (filled.T @ filled + imputed_covariance) / len(units) * shrinkage
        covariance += RIDGE * np.eye(len(covariance))
    return covariance


def _imputed(
    units: NDArray[Any], covariance: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return rows with imputed missing values, and the covariance of these values."""
    filled, imputed_covariance = units.copy(), np.zeros_like(covariance)
    for row in filled:
        gap = np.isnan(row)
        if not gap.any():
            continue
        known = ~gap
        gain = np.linalg.solve(
            covariance[np.ix_(known, known)], covariance[np.ix_(known, gap)]
        ).T
        row[gap] = gain @ row[known]
        imputed_covariance[np.ix_(gap, gap)] += (
            covariance[np.ix_(gap, gap)] - gain @ covariance[np.ix_(known, gap)]
        )
    return filled, imputed_covariance


def _shrinkage() -> NDArray[np.float64]:
    """Return the shrinkage factors (120, 120) of sample covariances."""
    term = np.repeat(TERMS, len(KNOTS_DEG))
    is_m_or_j0 = np.isin(term, (4, 5))
    shrinkage = np.full((term.size, term.size), OTHER_TERM_SHRINKAGE)
    shrinkage[np.ix_(is_m_or_j0, is_m_or_j0)] = M_J0_SHRINKAGE
    shrinkage[term[:, None] == term] = SAME_TERM_SHRINKAGE
    np.fill_diagonal(shrinkage, 1.0)
    return shrinkage
