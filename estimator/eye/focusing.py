"""Focus of any eye: accommodation, far and near point, and notes on their limits.

Distances and refraction refer to the plane of the entrance pupil.  Focus depends on the
pupil too: spherical aberration moves the sharpest distance as the pupil opens, so every
method requires the pupil diameter.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from estimator.corrections.rings import Rings
from estimator.eye.focus_table import FocusTable
from estimator.note import Note
from estimator.optics.vergence import ObjectVergence

if TYPE_CHECKING:
    from estimator.optics.surfaces import EyeSurfaces  # compiled: loads slowly

OUT_OF_REACH_DPT = 0.01
"""Distance from the eye's range beyond which a focus is reported as out of reach.

A traced eye matches its prescription to this.  It is invisible: through 6 mm it moves
rays by 0.1 arcmin to either side.
"""

RANGE_PUPIL_COUNT = 5
"""Number of pupils in a range at which the accommodation for a focus is evaluated: it
changes slowly and smoothly with the pupil."""


class Focusing(ABC):
    """Accommodation of an eye, independent of the source of its wavefronts.

    Attributes
    ----------
    refraction_dpt : float
        Least-squares M at the cornea and 555 nm of the relaxed eye at the measured
        pupil, through the correction: the clinical refraction.
    amplitude_dpt : float
        Largest accommodation.
    vergence : ObjectVergence
        Conversion of distances to vergences through the correction.
    """

    refraction_dpt: float
    amplitude_dpt: float
    vergence: ObjectVergence

    @abstractmethod
    def refraction_at_dpt(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float
    ) -> float:
        """Return least-squares M at 555 nm in a pupil's plane, at an accommodation."""

    @abstractmethod
    def accommodation_for_dpt(
        self, refraction_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the reachable accommodation whose M at a pupil is closest to this."""

    @abstractmethod
    def largest_accommodation_dpt(self, pupil_diameter_mm: float) -> float:
        """Return the accommodation for the near point through a pupil."""

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
            for pupil_mm in np.linspace(*pupil_range_mm, RANGE_PUPIL_COUNT)
            for focus_dpt in focus_range_dpt
        ]
        return min(used_dpt), max(used_dpt)

    def focus_notes(
        self, focus_dpt: float, *, pupil_diameter_mm: float
    ) -> tuple[str, ...]:
        """Return notes on a focus distance that this eye cannot reach."""
        far_dpt, near_dpt = self.focus_limits_dpt(pupil_diameter_mm)
        if focus_dpt < far_dpt - OUT_OF_REACH_DPT:
            note = Note(
                "focus_beyond_far_point",
                f"focus {focus_dpt:g} dpt is beyond the far point "
                f"({far_dpt:.3g} dpt): the eye stays relaxed",
                focus_dpt=focus_dpt,
                far_point_dpt=far_dpt,
            )
            return (note,)
        if focus_dpt <= near_dpt + OUT_OF_REACH_DPT:
            return ()
        code, reached = (
            (
                "focus_nearer_than_near_point",
                "is nearer than the near point "
                f"({max(0.0, round(near_dpt, 3)):.3g} dpt)",
            )
            if near_dpt > -OUT_OF_REACH_DPT
            else (
                "focus_out_of_reach",
                f"is out of reach, as are all distances, by {-near_dpt:.3g} dpt or "
                "more",
            )
        )
        added_dpt = self.vergence.vergence_dpt(near_dpt) - self.vergence.vergence_dpt(
            far_dpt
        )
        note = Note(
            code,
            f"focus {focus_dpt:g} dpt {reached}: "
            f"accommodation stops at {added_dpt:.3g} dpt",
            focus_dpt=focus_dpt,
            near_point_dpt=near_dpt,
            accommodation_dpt=added_dpt,
        )
        return (note,)


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


State = TypeVar("State", bound=FocusedSurfaces)


class TabulatedFocusing(Focusing, Generic[State]):
    """A `Focusing` eye that is traced, with a table of its refraction.

    *Accommodation* identifies a state of the lens by the change of refraction at
    ``pupil_diameter_mm``.  Through another pupil the change differs.

    Attributes
    ----------
    pupil_diameter_mm : float
        The eye's own pupil, at which accommodation is measured.
    """

    pupil_diameter_mm: float

    _age_amplitude_dpt: float
    _correction_dpt: tuple[float, float]
    _table: FocusTable | None = None

    @abstractmethod
    def _new_focus_table(self) -> FocusTable:
        """Trace the refraction without correction over pupil and accommodation."""

    @abstractmethod
    def states_at(self, accommodations_dpt: ArrayLike) -> Sequence[State]:
        """Return states (P,) at accommodations within the amplitude.

        Their ``focus_dpt`` is that of the eye's own pupil.
        """

    @property
    def _focus_table(self) -> FocusTable:
        """Refraction without correction over pupil and accommodation, traced lazily.

        It is not a cached property, so that storing an eye stores the table too.
        """
        if self._table is None:
            self._table = self._new_focus_table()
        return self._table

    def accommodation_dpt(
        self, focus_dpt: float, *, pupil_diameter_mm: float | None = None
    ) -> float:
        """Return the accommodation for a focus, by default at the eye's own pupil."""
        pupil_mm = pupil_diameter_mm or self.pupil_diameter_mm
        return super().accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm)

    def refraction_at_dpt(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float
    ) -> float:
        """Return least-squares M at 555 nm through a pupil, at an accommodation."""
        bare_dpt = self._focus_table.refraction_dpt(
            pupil_mm=pupil_diameter_mm, accommodation_dpt=accommodation_dpt
        )
        return bare_dpt - self._taken_off_dpt(pupil_diameter_mm)

    def _taken_off_dpt(self, pupil_diameter_mm: float) -> float:
        """Return M of the correction through a pupil."""
        at_center_dpt, per_mm2 = self._correction_dpt
        return at_center_dpt + per_mm2 * (pupil_diameter_mm / 2.0) ** 2

    def accommodation_for_dpt(
        self, refraction_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the accommodation in reach whose M at a pupil is nearest to this."""
        relaxed_dpt = self.refraction_at_dpt(
            pupil_diameter_mm=pupil_diameter_mm, accommodation_dpt=0.0
        )
        least_dpt = relaxed_dpt - self._age_amplitude_dpt
        return self._focus_table.accommodation_dpt(
            pupil_mm=pupil_diameter_mm,
            refraction_dpt=max(refraction_dpt, least_dpt)
            + self._taken_off_dpt(pupil_diameter_mm),
        )

    def largest_accommodation_dpt(self, pupil_diameter_mm: float) -> float:
        """Return the accommodation for the near point through a pupil."""
        return self.accommodation_for_dpt(
            -math.inf, pupil_diameter_mm=pupil_diameter_mm
        )

    def focused(
        self, focus_dpt: float, *, pupil_diameter_mm: float | None = None
    ) -> State:
        """Return the eye focused as near to ``focus_dpt`` as possible."""
        return self.focused_at([focus_dpt], pupil_diameter_mm=pupil_diameter_mm)[0]

    def focused_at(
        self, focuses_dpt: ArrayLike, *, pupil_diameter_mm: float | None = None
    ) -> list[State]:
        """Focus at many distances in one batch of traces.

        Parameters
        ----------
        pupil_diameter_mm : float, optional
            Pupil through which they are sharpest; the eye's own if None.

        Raises
        ------
        ValueError
            A distance is not finite.
        """
        focuses_dpt = np.atleast_1d(np.asarray(focuses_dpt, dtype=np.float64))
        if not np.all(np.isfinite(focuses_dpt)):
            raise ValueError(f"focus {focuses_dpt} dpt: must be finite; infinity is 0")
        pupil_mm = pupil_diameter_mm or self.pupil_diameter_mm
        accommodations_dpt = [
            self.accommodation_dpt(f, pupil_diameter_mm=pupil_mm)
            for f in focuses_dpt.tolist()
        ]
        return [
            replace(
                state,
                focus_dpt=self.sharpest_dpt(
                    state.accommodation_dpt, pupil_diameter_mm=pupil_mm
                ),
                notes=self.focus_notes(focus_dpt, pupil_diameter_mm=pupil_mm),
            )
            for focus_dpt, state in zip(
                focuses_dpt.tolist(), self.states_at(accommodations_dpt), strict=True
            )
        ]


class FocusingEye(Focusing):
    """A `Focusing` eye whose wavefronts are known up to some pupil.

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
