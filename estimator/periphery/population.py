"""Mean and covariance of wavefronts on the axis and along the horizontal meridian.

There are few eyes and many variables.  The periphery is predicted from the axis by
ridge regression, with a smaller penalty on the sphere than on other terms.  Each
prediction is shrunk by the fraction that chance explains (James and Stein), and so is
the covariance of the residuals.  Penalties and shrinkage factors are those with the
smallest cross-validation error that, at every angle, do not predict worse than the
sphere alone.
"""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from estimator.periphery.measured_eyes import MeasuredEyes, knots_um
from estimator.periphery.meridian import KNOTS_DEG, TERMS

POPULATION_FILE = Path(__file__).parent / "population.json"

N_PLACES = 1 + len(KNOTS_DEG)
"""Number of positions of each term: the axis and the knots."""

SPHERE_RIDGE, OTHER_RIDGE = 20.0, 400.0
"""Penalties of the regression on standardized terms of the axis."""

SAME_TERM_SHRINKAGE, OTHER_TERM_SHRINKAGE = 0.95, 0.5
"""Shrinkage factors of covariances between angles of one term, and between terms.  On
the axis, the first is used between all terms."""

EM_ITERATIONS = 15
"""Iterations of expectation and maximization, for eyes with missing directions."""

RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class Population:
    """Normal distribution of 12 terms at 9 positions, the axis first.

    Attributes
    ----------
    mean_um, deviation_um : (12, 9)
    correlation_ratio : (108, 108)
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
        axis_um2 *= np.where(np.eye(len(TERMS), dtype=bool), 1.0, SAME_TERM_SHRINKAGE)
        residual_um2 = _residual_covariance_um2(
            changes_um - mean_um - away_um @ slopes.T
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
    rounded: list[Any] = np.vectorize(lambda v: float(f"{v:.5g}"))(values).tolist()
    return rounded


def _by_terms() -> NDArray[np.int64]:
    """Return indices (108,) that sort axis and knots by terms and positions."""
    axis = np.arange(len(TERMS))[:, None]
    knots = len(TERMS) + np.arange(len(TERMS) * len(KNOTS_DEG))
    return np.concatenate([axis, knots.reshape(len(TERMS), -1)], axis=1).ravel()


def _ridge_regression(
    axis_um: NDArray[np.float64], changes_um: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return slopes (96, 12) and intercepts (96,) over the centered axis (n, 12)."""
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


def _residual_covariance_um2(residual_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (96, 96) of residuals (n, 96), some of them missing."""
    deviation_um = np.nanstd(residual_um, axis=0)
    covariance = _shrunk_covariance(residual_um / deviation_um)
    return covariance * np.outer(deviation_um, deviation_um)


def _shrunk_covariance(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shrunk covariance (96, 96) about 0 of rows with missing values."""
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
    """Return the shrinkage factors (96, 96) of sample covariances."""
    term = np.repeat(np.arange(len(TERMS)), len(KNOTS_DEG))
    is_same = term[:, None] == term
    shrinkage = np.where(is_same, SAME_TERM_SHRINKAGE, OTHER_TERM_SHRINKAGE)
    np.fill_diagonal(shrinkage, 1.0)
    return shrinkage
