"""Mean and covariance of people's wavefronts, on the axis and along the meridian.

Few people, many numbers: of what a sample's covariance says between different terms,
and between the axis and the periphery, a share is believed.  The shares are those at
which people left out are predicted best.
"""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.periphery.meridian import KNOTS_DEG, TERMS
from estimator.periphery.people import People, knots_um

POPULATION_FILE = Path(__file__).parent / "population.json"

PLACES = 1 + len(KNOTS_DEG)
"""The axis and the knots: what is known of each term."""

SAME_SHARE, OTHER_SHARE = 0.95, 0.5
"""Of covariances between angles of one term, and those between terms; on the axis all
terms count as one."""

AXIS_SHARE, AXIS_SPHERE_SHARE = 0.3, 0.7
"""Of those between the axis and the periphery; for the sphere on the axis, which says
most: with more of the others, people left out are told worse than by it alone at 10 and
20 deg of temporal retina."""

ROUNDS = 15
"""Of expectation and maximisation: some people were not measured everywhere."""

RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class Population:
    """Normal distribution of (12 terms, 9 places), the axis first.

    Attributes
    ----------
    mean_um, deviation_um : (12, 9)
    correlation_ratio : (108, 108)
        In C order of terms and places.
    """

    mean_um: NDArray[np.float64]
    deviation_um: NDArray[np.float64]
    correlation_ratio: NDArray[np.float64]

    @classmethod
    def of(cls, people: People) -> "Population":
        """Fit that of measured people; those without an axis are left out."""
        values_um = np.concatenate(
            [people.axis_um[:, :, None], knots_um(people)], axis=-1
        )
        values_um = values_um[np.isfinite(people.axis_um).all(axis=-1)]
        mean_um = np.nanmean(values_um, axis=0)
        deviation_um = np.nanstd(values_um, axis=0)
        units = ((values_um - mean_um) / deviation_um).reshape(len(values_um), -1)
        centre, correlation = _fitted(units)
        mean_um = mean_um + deviation_um * centre.reshape(mean_um.shape)
        return cls(mean_um, deviation_um, correlation)

    def to_json(self) -> dict:
        """Return the content of a file."""
        rows = [row[: k + 1] for k, row in enumerate(self.correlation_ratio)]
        return {
            "terms": list(TERMS),
            "h_deg": [0.0, *KNOTS_DEG],
            "mean_um": _rounded(self.mean_um),
            "deviation_um": _rounded(self.deviation_um),
            "correlation": [_rounded(row) for row in rows],
        }

    @classmethod
    def from_json(cls, data: dict) -> "Population":
        """Read what `to_json` returned."""
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


def _rounded(values: NDArray[np.float64]) -> list:
    return np.vectorize(lambda v: float(f"{v:.5g}"))(values).tolist()


def _fitted(
    units: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean (108,) and covariance (108, 108) of rows with gaps, shrunk."""
    centre, covariance = np.zeros(units.shape[1]), np.eye(units.shape[1])
    share = _believed()
    for _ in range(ROUNDS):
        filled, spread = _expected(units, centre, covariance)
        away = filled - centre
        centre = filled.mean(axis=0)
        covariance = (away.T @ away + spread) / len(units) * share
        covariance += RIDGE * np.eye(len(centre))
    lowest = float(np.linalg.eigvalsh(covariance)[0])
    return centre, covariance + max(RIDGE - lowest, 0.0) * np.eye(len(centre))


def _expected(
    units: NDArray, centre: NDArray, covariance: NDArray
) -> tuple[NDArray, NDArray]:
    """Rows with their gaps filled in, and the covariance of what was filled in."""
    filled, spread = units.copy(), np.zeros_like(covariance)
    for row in filled:
        gap = np.isnan(row)
        if not gap.any():
            continue
        known = ~gap
        gain = np.linalg.solve(
            covariance[np.ix_(known, known)], covariance[np.ix_(known, gap)]
        ).T
        row[gap] = centre[gap] + gain @ (row[known] - centre[known])
        spread[np.ix_(gap, gap)] += (
            covariance[np.ix_(gap, gap)] - gain @ covariance[np.ix_(known, gap)]
        )
    return filled, spread


def _believed() -> NDArray[np.float64]:
    """Share (108, 108) of each sample covariance."""
    term, place = np.divmod(np.arange(len(TERMS) * PLACES), PLACES)
    is_axis = place == 0
    is_sphere = is_axis & (term == TERMS.index(4))
    share = np.where(term[:, None] == term, SAME_SHARE, OTHER_SHARE)
    share = np.where(is_axis[:, None] & is_axis, SAME_SHARE, share)
    share = np.where(is_axis[:, None] != is_axis, AXIS_SHARE, share)
    outside = (is_sphere[:, None] & ~is_axis) | (~is_axis[:, None] & is_sphere)
    share = np.where(outside, AXIS_SPHERE_SHARE, share)
    np.fill_diagonal(share, 1.0)
    return share
