"""Mean and covariance of people's wavefronts, on the axis and along the meridian.

There are few people and many variables.  The periphery is predicted from the axis by
ridge regression, with a smaller penalty on the sphere than on other terms, and each
prediction is shrunk by the fraction that chance explains (James and Stein).  The
residual has a covariance, which is shrunk as well.  The penalties and shrinkages are
those that best predict people left out, at no angle worse than their sphere alone.
"""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from estimator.periphery.meridian import KNOTS_DEG, TERMS
from estimator.periphery.people import People, knots_um

POPULATION_FILE = Path(__file__).parent / "population.json"

PLACES = 1 + len(KNOTS_DEG)
"""Number of places of each term: the axis and the knots."""

SPHERE_RIDGE, OTHER_RIDGE = 20.0, 400.0
"""Penalties of the regression on standardized terms of the axis."""

SAME_SHARE, OTHER_SHARE = 0.95, 0.5
"""Shrinkage factors of covariances between angles of one term, and between terms; on
the axis all terms count as one."""

ROUNDS = 15
"""Rounds of expectation and maximization: some people were not measured everywhere."""

RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class Population:
    """Normal distribution of (12 terms, 9 places), the axis first.

    Attributes
    ----------
    mean_um, deviation_um : (12, 9)
    correlation_ratio : (108, 108)
        Correlations, in C order of terms and places.
    """

    mean_um: NDArray[np.float64]
    deviation_um: NDArray[np.float64]
    correlation_ratio: NDArray[np.float64]

    @classmethod
    def of(cls, people: People) -> "Population":
        """Fit the population of measured people; omit those without an axis."""
        has_axis = np.isfinite(people.axis_um).all(axis=-1)
        people = people.of(cast("NDArray[np.bool_]", has_axis))
        axis_um = people.axis_um
        away_um = axis_um - axis_um.mean(axis=0)
        changes_um = knots_um(people).reshape(len(axis_um), -1)
        slopes, mean_um = _regressed(away_um, changes_um)
        axis_um2 = away_um.T @ away_um / len(away_um)
        axis_um2 *= np.where(np.eye(len(TERMS), dtype=bool), 1.0, SAME_SHARE)
        rest_um2 = _rest_um2(changes_um - mean_um - away_um @ slopes.T)
        covariance_um2 = np.block(
            [
                [axis_um2, axis_um2 @ slopes.T],
                [slopes @ axis_um2, slopes @ axis_um2 @ slopes.T + rest_um2],
            ]
        )
        order = _by_terms()
        covariance_um2 = covariance_um2[np.ix_(order, order)]
        deviation_um = np.sqrt(np.diag(covariance_um2))
        mean_um = np.concatenate([axis_um.mean(axis=0), mean_um])[order]
        shape = (len(TERMS), PLACES)
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
        """Build from the result of `to_json`."""
        size = len(TERMS) * PLACES
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
    """Return indices (108,) that sort axis and knots by terms and places."""
    axis = np.arange(len(TERMS))[:, None]
    knots = len(TERMS) + np.arange(len(TERMS) * len(KNOTS_DEG))
    return np.concatenate([axis, knots.reshape(len(TERMS), -1)], axis=1).ravel()


def _regressed(
    axis_um: NDArray[np.float64], changes_um: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return slopes (96, 12) over the centered axis (n, 12), and values (96,) there."""
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
        left = float(np.mean((targets - inputs @ weights) ** 2))
        explained = max(float(np.mean(targets**2)) - left, 1e-12)
        freedom = float(np.trace(ridge @ square)) / known.sum()
        weights *= max(1.0 - freedom * left / explained, 0.0)
        slopes[k] = weights / deviation_um
        mean_um.append(column[known].mean() - center @ weights)
    return slopes, np.array(mean_um)


def _rest_um2(rest_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (96, 96) of regression residuals (n, 96) with gaps."""
    deviation_um = np.nanstd(rest_um, axis=0)
    covariance = _fitted(rest_um / deviation_um)
    return covariance * np.outer(deviation_um, deviation_um)


def _fitted(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shrunk covariance (96, 96) about 0 of rows with gaps."""
    covariance, share = np.eye(units.shape[1]), _believed()
    for _ in range(ROUNDS):
        filled, spread = _expected(units, covariance)
        covariance = (filled.T @ filled + spread) / len(units) * share
        covariance += RIDGE * np.eye(len(covariance))
    return covariance


def _expected(
    units: NDArray[Any], covariance: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return rows with their gaps filled in, and the filled values' covariance."""
    filled, spread = units.copy(), np.zeros_like(covariance)
    for row in filled:
        gap = np.isnan(row)
        if not gap.any():
            continue
        known = ~gap
        gain = np.linalg.solve(
            covariance[np.ix_(known, known)], covariance[np.ix_(known, gap)]
        ).T
        row[gap] = gain @ row[known]
        spread[np.ix_(gap, gap)] += (
            covariance[np.ix_(gap, gap)] - gain @ covariance[np.ix_(known, gap)]
        )
    return filled, spread


def _believed() -> NDArray[np.float64]:
    """Return the shrinkage (96, 96) of sample covariances, which keeps their signs."""
    term = np.repeat(np.arange(len(TERMS)), len(KNOTS_DEG))
    share = np.where(term[:, None] == term, SAME_SHARE, OTHER_SHARE)
    np.fill_diagonal(share, 1.0)
    return share
