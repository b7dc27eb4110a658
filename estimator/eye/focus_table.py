"""Refraction of one eye over pupil and accommodation, and its inverse.

Over accommodation the table is interpolated by a polynomial through traced states of
the lens; over the pupil by a polynomial in its square, in which a wavefront's spherical
terms are a short series.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

STANDARD_PUPILS_MM = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
NEAREST_PUPIL_MM = 0.6
"""Standard pupils closer than this to the eye's own pupil are omitted."""

SAME_NODE = 1e-12
"""Distance from a node at which a polynomial has its value."""

LEAST_STATES = 3
"""Number of accommodations at which light must fill a pupil; others are omitted."""


def table_pupils_mm(own_mm: float) -> list[float]:
    """Return the pupils of a table, ascending: the eye's own and standard ones."""
    others = [p for p in STANDARD_PUPILS_MM if abs(p - own_mm) >= NEAREST_PUPIL_MM]
    return sorted([own_mm, *others])


class FocusTable:
    """Traced refractions and their interpolation.

    Parameters
    ----------
    pupils_mm : (n,)
    accommodations_dpt : (m,)
        Ascending from 0.
    refractions_dpt : (n, m)
        Least-squares M at 555 nm, NaN where light does not fill the pupil;
        accommodation through a pupil ends where M no longer falls.
    """

    def __init__(
        self,
        pupils_mm: NDArray[Any],
        accommodations_dpt: NDArray[Any],
        refractions_dpt: NDArray[Any],
    ):
        least = min(LEAST_STATES, accommodations_dpt.size)
        usable = np.isfinite(refractions_dpt).sum(axis=1) >= least
        refractions_dpt = _filled(accommodations_dpt, refractions_dpt[usable])
        self._accommodations_dpt = accommodations_dpt
        self._refractions_dpt = refractions_dpt
        self._over_square_mm2 = _Polynomial(np.square(pupils_mm[usable]).tolist())
        self._over_accommodation = _Polynomial(accommodations_dpt.tolist())
        self._last: tuple[float, list[float], _Polynomial | None] = (0.0, [], None)

    def _at_pupil(self, pupil_mm: float) -> tuple[list[float], "_Polynomial"]:
        """Return refractions (m,) at a pupil, and the polynomial over them.

        Those of the last pupil are cached: a frame asks for one pupil several times.
        """
        last_mm, found_dpt, inverse = self._last
        if inverse is None or last_mm != pupil_mm:
            weights = self._over_square_mm2.weights(pupil_mm**2)
            found_dpt = (np.array(weights) @ self._refractions_dpt).tolist()
            inverse = _Polynomial(_falling(found_dpt))
            self._last = pupil_mm, found_dpt, inverse
        return found_dpt, inverse

    def refraction_dpt(self, *, pupil_mm: float, accommodation_dpt: float) -> float:
        """Return the refraction through a pupil at an accommodation."""
        found_dpt, _ = self._at_pupil(pupil_mm)
        return self._over_accommodation.through(found_dpt, accommodation_dpt)

    def accommodation_dpt(self, *, pupil_mm: float, refraction_dpt: float) -> float:
        """Return the accommodation in the table with the nearest refraction.

        Only those up to which the refraction falls are in reach.
        """
        found_dpt, inverse = self._at_pupil(pupil_mm)
        used_dpt = self._over_accommodation.nodes[: len(inverse.nodes)]
        wanted_dpt = min(max(refraction_dpt, inverse.nodes[-1]), found_dpt[0])
        found = inverse.through(used_dpt, wanted_dpt)
        return min(max(found, used_dpt[0]), used_dpt[-1])


class _Polynomial:
    """Polynomial through values at fixed nodes, by the barycentric formula.

    It has few nodes, so that NumPy would take five times as long.
    """

    def __init__(self, nodes: list[float]):
        self.nodes = nodes
        # so that many nodes do not overflow
        unit = 4.0 / ((max(nodes) - min(nodes)) or 1.0)
        self._shares = [
            1.0 / math.prod((node - other) * unit for other in nodes if other != node)
            for node in nodes
        ]

    def weights(self, at: float) -> list[float]:
        """Return the weights (n,) of the values at a position."""
        away = [at - node for node in self.nodes]
        if any(-SAME_NODE < distance < SAME_NODE for distance in away):
            return [float(-SAME_NODE < distance < SAME_NODE) for distance in away]
        terms = [share / d for share, d in zip(self._shares, away, strict=True)]
        total = sum(terms)
        return [term / total for term in terms]

    def through(self, values: list[float], at: float) -> float:
        """Return the value at a position of the polynomial through values (n,)."""
        weights = self.weights(at)
        return sum(w * value for w, value in zip(weights, values, strict=True))


def _falling(values: list[float]) -> list[float]:
    """Return the first of values, as long as they fall."""
    for count, (value, following) in enumerate(pairwise(values), start=1):
        if following >= value:
            return values[:count]
    return values


def _filled(nodes: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """Return rows (n, m) whose NaN are replaced by the polynomial through the others.

    A strongly curved lens does not pass the light of a wide pupil.  Without that pupil,
    M at all accommodations would be extrapolated from narrower ones: in the cataract
    preset, it was off by 0.06 dpt at 6 mm and 0.17 dpt at 7 mm.
    """
    rows = rows.copy()
    for row in rows:
        known = np.isfinite(row)
        through = _Polynomial(nodes[known].tolist()).through
        row[~known] = [through(row[known].tolist(), at) for at in nodes[~known]]
    return rows
