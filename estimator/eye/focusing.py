"""Focus of any eye: accommodation, far and near point, and notes on their limits.

Distances and refraction refer to the plane of the entrance pupil.  Focus depends on the
pupil too: spherical aberration moves the sharpest distance as the pupil opens, so every
method requires the pupil diameter.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.rings import Rings
from estimator.note import Note
from estimator.optics.vergence import ObjectVergence

if TYPE_CHECKING:
    from estimator.optics.surfaces import EyeSurfaces  # compiled: loads slowly

OUT_OF_REACH_DPT = 0.01
"""Distance from the eye's range beyond which a focus is reported as out of reach.

A traced eye matches its prescription within this limit.  The difference is invisible:
it displaces rays through a 6 mm pupil by at most 0.1 arcmin.
"""

NOTICED_DPT = 0.25
"""Smallest step of a refraction: less blur is hardly noticed."""

RANGE_PUPIL_COUNT = 5
"""Number of pupils in a range for which the accommodation is computed.  A few suffice,
because the accommodation changes slowly and smoothly with the pupil."""


class Focusing(ABC):
    """Accommodation of an eye, independent of the source of its wavefronts.

    Attributes
    ----------
    refraction_dpt : float
        Clinical refraction: least-squares M of the relaxed eye and its correction, at
        the cornea, at 555 nm and for the measured pupil.
    amplitude_dpt : float
        Largest accommodation.
    vergence : ObjectVergence
        Conversion of distances to vergences through the correction.
    rings : Rings or None
        Lens with several foci, or lenslets.
    """

    refraction_dpt: float
    amplitude_dpt: float
    vergence: ObjectVergence
    rings: Rings | None = None

    @abstractmethod
    def refraction_at_dpt(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float
    ) -> float:
        """Return least-squares M at 555 nm in a pupil's plane, at an accommodation."""

    @abstractmethod
    def accommodation_for_dpt(
        self, refraction_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the reachable accommodation with M closest to this refraction."""

    @abstractmethod
    def largest_accommodation_dpt(self, pupil_diameter_mm: float) -> float:
        """Return the accommodation for the near point through a pupil."""

    def with_object_dpt(
        self, defocus_dpt: NDArray[np.float64], object_dpt: ArrayLike
    ) -> NDArray[np.float64]:
        """Return total defocus (...), dpt, with the vergence of an object added."""
        if isinstance(object_dpt, float) and object_dpt == 0.0:
            return defocus_dpt
        at_dpt = np.asarray(object_dpt, dtype=np.float64)
        return defocus_dpt + self.vergence.vergence_dpt(at_dpt)

    def accommodation_dpt(self, focus_dpt: float, *, pupil_diameter_mm: float) -> float:
        """Return the reachable accommodation that focuses a distance best."""
        return self.accommodation_for_dpt(
            -self.vergence.vergence_dpt(focus_dpt),
            pupil_diameter_mm=pupil_diameter_mm,
        )

    def sharpest_dpt(
        self, accommodation_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the sharpest distance at an accommodation, through a pupil."""
        return self.vergence.object_dpt(
            -self.refraction_at_dpt(
                pupil_diameter_mm=pupil_diameter_mm, accommodation_dpt=accommodation_dpt
            )
        )

    def reachable_focus_dpt(
        self, focus_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the reachable distance, dpt, nearest to the requested focus."""
        used_dpt = self.accommodation_dpt(
            focus_dpt, pupil_diameter_mm=pupil_diameter_mm
        )
        return self.sharpest_dpt(used_dpt, pupil_diameter_mm=pupil_diameter_mm)

    def focus_limits_dpt(self, pupil_diameter_mm: float) -> tuple[float, float]:
        """Return far point and near point through a pupil, dpt."""
        largest_dpt = self.largest_accommodation_dpt(pupil_diameter_mm)
        far_dpt, near_dpt = (
            self.sharpest_dpt(used_dpt, pupil_diameter_mm=pupil_diameter_mm)
            for used_dpt in (0.0, largest_dpt)
        )
        return far_dpt, near_dpt

    def accommodation_range_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> tuple[float, float]:
        """Return smallest and largest accommodation over ranges of focus and pupil."""
        used_dpt = [
            self.accommodation_dpt(focus_dpt, pupil_diameter_mm=float(pupil_mm))
            for pupil_mm in np.unique(np.linspace(*pupil_range_mm, RANGE_PUPIL_COUNT))
            for focus_dpt in np.unique(focus_range_dpt).tolist()
        ]
        return min(used_dpt), max(used_dpt)

    def focus_notes(
        self, focus_dpt: float, *, pupil_diameter_mm: float
    ) -> tuple[str, ...]:
        """Return notes on a focus distance that this eye cannot reach."""
        far_dpt, near_dpt = self.focus_limits_dpt(pupil_diameter_mm)
        blurred = "blurred"
        if self.rings is not None and self.rings.lattice_mm is None:
            blurred = "blurred in the distance focus of the lens"
        if focus_dpt < far_dpt - OUT_OF_REACH_DPT:
            note = Note(
                "focus_beyond_far_point",
                f"{blurred}: nothing beyond {_distance(far_dpt)} is sharp; focus "
                f"{focus_dpt:.3g} dpt is beyond the far point ({far_dpt:.3g} dpt): the "
                "eye stays relaxed",
                focus_dpt=focus_dpt,
                far_point_dpt=far_dpt,
            )
            return (note,)
        if focus_dpt <= near_dpt + OUT_OF_REACH_DPT:
            return ()
        if near_dpt > -OUT_OF_REACH_DPT:
            code = "focus_nearer_than_near_point"
            nearest_dpt = max(0.0, round(near_dpt, 3))
            seen = f"nothing nearer than {_distance(nearest_dpt)} is sharp"
            if nearest_dpt <= OUT_OF_REACH_DPT:
                seen = "only far distances are sharp"
            reached = f"is nearer than the near point ({nearest_dpt:.3g} dpt)"
        else:
            code = "focus_out_of_reach"
            lacking_dpt = focus_dpt - near_dpt
            little = ", which few people notice" if lacking_dpt < NOTICED_DPT else ""
            seen = f"the eye lacks {lacking_dpt:.2g} dpt for {_distance(focus_dpt)}"
            seen += little
            reached = "is out of reach, as is every distance"
        added_dpt = self.vergence.vergence_dpt(near_dpt) - self.vergence.vergence_dpt(
            far_dpt
        )
        note = Note(
            code,
            f"{blurred}: {seen}; focus {focus_dpt:.3g} dpt {reached}: "
            f"accommodation stops at {added_dpt:.3g} dpt",
            focus_dpt=focus_dpt,
            near_point_dpt=near_dpt,
            accommodation_dpt=added_dpt,
        )
        return (note,)


def _distance(vergence_dpt: float) -> str:
    """Return a distance in meters or centimeters."""
    if vergence_dpt <= OUT_OF_REACH_DPT:
        return "far distances"
    meters = 1.0 / vergence_dpt
    return f"{100.0 * meters:.0f} cm" if meters < 1.0 else f"{meters:.1f} m"


@dataclass(frozen=True)
class FocusedSurfaces:
    """One eye at one focus.

    ``focus_dpt`` is the focus actually reached; ``notes`` report a difference from the
    requested one.
    """

    surfaces: EyeSurfaces
    focus_dpt: float
    accommodation_dpt: float
    notes: tuple[str, ...]


class FocusingEye(Focusing):
    """A `Focusing` eye whose wavefronts are known up to a maximum pupil diameter.

    Attributes
    ----------
    max_pupil_diameter_mm : float
        Largest pupil; wider ones are capped.
    pupil_limit : str
        Origin of that limit: "measured" or "traced".
    rings : Rings or None
        Rings of a multifocal correction, if one is worn.
    """

    max_pupil_diameter_mm: float
    pupil_limit: str
    rings: Rings | None = None

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Return the requested pupil, capped at the largest known one."""
        return min(pupil_diameter_mm, self.max_pupil_diameter_mm)

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Return notes on parts of a request that this eye cannot meet."""
        usable_mm = self.usable_pupil_mm(pupil_diameter_mm)
        notes = self.focus_notes(focus_dpt, pupil_diameter_mm=usable_mm)
        if pupil_diameter_mm <= self.max_pupil_diameter_mm + 1e-9:
            return notes
        capped = Note(
            "pupil_capped",
            f"pupil {pupil_diameter_mm:g} mm capped at the {self.pupil_limit} "
            f"{self.max_pupil_diameter_mm:g} mm",
            pupil_diameter_mm=pupil_diameter_mm,
            used_mm=self.max_pupil_diameter_mm,
        )
        return (capped, *notes)


STANDARD_PUPILS_MM = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
NEAREST_PUPIL_MM = 0.6
"""Standard pupils closer than this to the eye's own pupil are omitted."""

SAME_NODE = 1e-12
"""Distance within which a position counts as the node itself."""

LEAST_STATES = 3
"""Pupils that light fills at fewer accommodations than this are omitted."""


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

    def _at_pupil(self, pupil_mm: float) -> tuple[list[float], _Polynomial]:
        """Return refractions (m,) at a pupil, and the polynomial through them.

        The last result is cached: a frame requests the same pupil several times.
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

        Accommodations beyond the first minimum of the refraction cannot be reached.
        """
        found_dpt, inverse = self._at_pupil(pupil_mm)
        used_dpt = self._over_accommodation.nodes[: len(inverse.nodes)]
        wanted_dpt = min(max(refraction_dpt, inverse.nodes[-1]), found_dpt[0])
        found = inverse.through(used_dpt, wanted_dpt)
        return min(max(found, used_dpt[0]), used_dpt[-1])


class _Polynomial:
    """Polynomial through values at fixed nodes, by the barycentric formula.

    It uses lists: for so few nodes, NumPy would take five times as long.
    """

    def __init__(self, nodes: list[float]):
        self.nodes = nodes
        # Scaling keeps the products over many nodes from overflowing.
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
        """Evaluate the polynomial through values (n,) at a position."""
        weights = self.weights(at)
        return sum(w * value for w, value in zip(weights, values, strict=True))


def _falling(values: list[float]) -> list[float]:
    """Return the leading values that strictly decrease."""
    for count, (value, following) in enumerate(pairwise(values), start=1):
        if following >= value:
            return values[:count]
    return values


def _filled(nodes: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """Fill NaN in rows (n, m) by the polynomial through the other values.

    A strongly curved lens blocks part of the light of a wide pupil.  If that pupil were
    omitted, M would be extrapolated from narrower ones at all accommodations: in the
    cataract preset, M was off by 0.06 dpt at 6 mm and 0.17 dpt at 7 mm.
    """
    rows = rows.copy()
    for row in rows:
        known = np.isfinite(row)
        through = _Polynomial(nodes[known].tolist()).through
        row[~known] = [through(row[known].tolist(), at) for at in nodes[~known]]
    return rows
