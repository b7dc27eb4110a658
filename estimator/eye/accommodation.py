"""Accommodation: the lens diameter and chamber depth that focus an eye at a distance.

`assembly` describes the change of the lens.  The eye is focused at f dpt when its
ray-traced least-squares refraction M at 555 nm, over the given pupil, is -f.

Refraction over pupil and accommodation is interpolated: over accommodation by a
polynomial through traced states of the lens; over the pupil by a polynomial in its
square, in which a wavefront's spherical terms are a short series.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.worn_lens import worn_refraction
from estimator.eye.assembly import (
    AQUEOUS,
    DIAMETER,
    accommodated,
    accommodated_vectors,
    eye_surfaces,
    smallest_diameter_mm,
)
from estimator.eye.focusing import (
    FocusedSurfaces,
    Focusing,
    FocusTable,
    table_pupils_mm,
)
from estimator.eye.parameters import EyeParameters, RetinaShape
from estimator.eye.tracing import (
    TraceFailed,
    refraction_of_vectors,
    seen_refraction_of_vectors,
)
from estimator.optics import prescription as rx
from estimator.optics.interpolation import polynomial_through
from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.vergence import ObjectVergence, refraction_at_cornea_dpt
from estimator.optics.zernike import N_TERMS
from estimator.wavefront.field_wavefronts import (
    total_defocus_dpt,
    zernike_from_polynomial,
)

N_TABLE = 10
"""Lens diameters at which the refraction is traced before the root is refined."""

N_FOCUS = 6
"""Number of these diameters that are traced at other pupils as well."""

REFRACTION_TOLERANCE_DPT = 1e-6
MAX_REFINEMENTS = 6


def falling_count(refractions_dpt: NDArray[np.float64]) -> int:
    """Return how many leading refractions are finite and decreasing."""
    usable = np.isfinite(refractions_dpt)
    usable[1:] &= np.diff(refractions_dpt) < 0.0
    usable[0] = True
    return int(np.argmin(usable)) if not usable.all() else usable.size


class ResidualPhase(Protocol):
    """Phase added to the traced eye's wavefront (`estimate.measured_residual`)."""

    def on_axis_um(self, pupil_diameter_mm: ArrayLike) -> NDArray[np.float64]:
        """Return monomials (n, n_terms) at 555 nm in the plane of pupils (n,)."""

    def on_axis_dpt(self, pupil_diameter_mm: float) -> float:
        """Return their least-squares M in a pupil."""


State = TypeVar("State", bound=FocusedSurfaces)


class TabulatedFocusing(Focusing, Generic[State]):
    """A `Focusing` eye that is traced, with a table of its refraction.

    *Accommodation* identifies a state of the lens by the change of refraction at
    ``pupil_diameter_mm``.  Through another pupil the change differs.

    Attributes
    ----------
    pupil_diameter_mm : float
        The eye's own pupil, at which accommodation is measured.
    refraction_dpt : float
        M of the relaxed eye at the cornea, 555 nm and ``pupil_diameter_mm``, through
        the correction.
    bare_refraction_dpt : float
        M without the correction.
    entrance_pupil_mm : float
        Depth of the relaxed eye's entrance pupil behind the corneal apex.
    amplitude_dpt : float
        The smaller of the accommodation of the last state of the lens and the given
        amplitude (by age), at that pupil.
    """

    pupil_diameter_mm: float
    entrance_pupil_mm: float
    bare_refraction_dpt: float

    _table: FocusTable | None = None
    _rest: ResidualPhase | None = None
    _last_taken_off = (0.0, 0.0)

    def _tabulate(
        self,
        nodes: NDArray[np.float64],
        *,
        correction: rx.Prescription | None,
        amplitude_dpt: float,
    ) -> None:
        """Trace the refraction at states of the lens, from the relaxed one on.

        The table ends where the refraction no longer falls.

        Parameters
        ----------
        nodes : (n,)
            Numbers that place the states.

        Raises
        ------
        TraceFailed
            Light does not pass the relaxed eye.
        """
        refractions_dpt = self._refractions_dpt(nodes)
        if not np.isfinite(refractions_dpt[0]):
            raise TraceFailed(
                f"light does not pass the relaxed eye at {self.pupil_diameter_mm:g} mm"
                + self._obstruction(self.pupil_diameter_mm)
            )
        count = falling_count(refractions_dpt)
        self._nodes, self._bare_dpt = nodes[:count], float(refractions_dpt[0])
        self._accommodations_dpt = self._bare_dpt - refractions_dpt[:count]
        self._age_amplitude_dpt = amplitude_dpt
        self.amplitude_dpt = min(amplitude_dpt, float(self._accommodations_dpt[-1]))
        self.vergence = ObjectVergence.seen_through(
            correction, entrance_pupil_mm=self.entrance_pupil_mm
        )
        self._correction_dpt = worn_refraction(
            correction, entrance_pupil_mm=self.entrance_pupil_mm
        )
        self.bare_refraction_dpt = refraction_at_cornea_dpt(
            self._bare_dpt + float(self._rest_dpt(self.pupil_diameter_mm)[0]),
            entrance_pupil_mm=self.entrance_pupil_mm,
        )
        at_cornea_dpt = 0.0
        if correction is not None:
            at_cornea_dpt, *_ = rx.power_vector(correction)
        self.refraction_dpt = self.bare_refraction_dpt - at_cornea_dpt

    @abstractmethod
    def _refractions_dpt(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Trace M (n,) at the eye's own pupil, in states of the lens (n,)."""

    def _obstruction(self, pupil_diameter_mm: float) -> str:
        """Return the reason why light does not pass, in parentheses, if it is known."""
        return ""

    def _nodes_at(self, accommodations_dpt: ArrayLike) -> NDArray[np.float64]:
        """Return states of the lens (P,) at accommodations (P,) within the amplitude.

        One polynomial inverts the table; secant steps, all in batches, then refine the
        result until the traced refraction is met to `REFRACTION_TOLERANCE_DPT`.
        """
        wanted_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
        known_dpt, nodes = self._accommodations_dpt, self._nodes
        if nodes.size == 1:
            return np.full(wanted_dpt.shape, nodes[0])
        low, high = sorted(nodes[[0, -1]].tolist())
        # The table is smooth and short: linear interpolation would be 1e-2 dpt off,
        # and every further step costs a trace for each focus.
        found = np.clip(polynomial_through(known_dpt, nodes)(wanted_dpt), low, high)
        slope = np.interp(wanted_dpt, known_dpt, np.gradient(nodes, known_dpt))
        for _ in range(MAX_REFINEMENTS):
            error_dpt = wanted_dpt - (self._bare_dpt - self._refractions_dpt(found))
            if np.max(np.abs(error_dpt)) < REFRACTION_TOLERANCE_DPT:
                break
            found = np.clip(found + slope * error_dpt, low, high)
        return found

    @abstractmethod
    def _new_focus_table(self) -> FocusTable:
        """Trace the refraction without correction over pupil and accommodation."""

    @abstractmethod
    def states_at(self, accommodations_dpt: ArrayLike) -> Sequence[State]:
        """Return states (P,) at accommodations within the amplitude.

        Their ``focus_dpt`` is the focus through the eye's own pupil.
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

    def _rest_dpt(self, pupil_diameter_mm: ArrayLike) -> NDArray[np.float64]:
        """Return M (n,) of the residual on round pupils (n,)."""
        radius_mm = np.atleast_1d(pupil_diameter_mm) / 2.0
        if self._rest is None:
            return np.zeros(radius_mm.size)
        rest_um = self._rest.on_axis_um(pupil_diameter_mm)
        zernike_um = zernike_from_polynomial(rest_um, radius_mm)
        return total_defocus_dpt(zernike_um, radius_mm)

    def _taken_off_dpt(self, pupil_diameter_mm: float) -> float:
        """Return M of the correction minus M of the residual, on a round pupil.

        The last result is cached: a frame requests the same pupil several times.
        """
        last = self._last_taken_off
        if last[0] != pupil_diameter_mm:
            at_center_dpt, per_mm2 = self._correction_dpt
            taken_off_dpt = at_center_dpt + per_mm2 * (pupil_diameter_mm / 2.0) ** 2
            if self._rest is not None:
                taken_off_dpt -= self._rest.on_axis_dpt(pupil_diameter_mm)
            self._last_taken_off = last = pupil_diameter_mm, taken_off_dpt
        return last[1]

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


@dataclass(frozen=True)
class FocusedEye(FocusedSurfaces):
    """An eye of 45 parameters at one focus."""

    parameters: EyeParameters
    lens_diameter_change_mm: float
    aqueous_thickness_change_mm: float


class AccommodatingEye(TabulatedFocusing[FocusedEye]):
    """An eye of 45 parameters that can focus, at any pupil.

    Attributes
    ----------
    lens_range_dpt : float
        Largest accommodation of the lens model.

    Parameters
    ----------
    rest : Rest, optional
        Phase added to the traced eye.
    keeps_conics : bool
        Whether the lens keeps its conic constants, as it does for the focus network.
    """

    def __init__(
        self,
        parameters: EyeParameters,
        *,
        retina: RetinaShape | None = None,
        pupil_diameter_mm: float = 4.0,
        amplitude_dpt: float = math.inf,
        correction: rx.Prescription | None = None,
        rest: ResidualPhase | None = None,
        keeps_conics: bool = False,
    ):
        self.parameters = parameters
        self._keeps_conics = keeps_conics
        self.retina = retina
        self.pupil_diameter_mm = pupil_diameter_mm
        self._vector = parameters.to_vector()
        self.entrance_pupil_mm = entrance_pupil_mm(
            eye_surfaces(parameters, retina=retina),
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
        )
        self._rest = rest
        relaxed_mm = self._vector[DIAMETER]
        smallest_mm = smallest_diameter_mm(self._vector)
        self._tabulate(
            np.linspace(relaxed_mm, smallest_mm, N_TABLE),
            correction=correction,
            amplitude_dpt=amplitude_dpt,
        )
        self.lens_range_dpt = float(self._accommodations_dpt[-1])

    def _vectors(self, diameters_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the eye (P, 45) with lens diameters (P,)."""
        return accommodated_vectors(
            self._vector,
            lens_diameter_mm=diameters_mm,
            keeps_conics=self._keeps_conics,
        )

    def _new_focus_table(self) -> FocusTable:
        """Trace the table, without M of the residual on a round pupil.

        In wide pupils the residual is stretched, so its M is no polynomial over the
        pupil.  The table holds only its difference between the pupil and a round one.
        """
        pupils_mm = np.array(table_pupils_mm(self.pupil_diameter_mm))
        some = np.unique(np.linspace(0, self._nodes.size - 1, N_FOCUS).astype(int))
        states = self._vectors(self._nodes[some])
        rest_um = np.zeros((pupils_mm.size, N_TERMS))
        if self._rest is not None:
            rest_um = self._rest.on_axis_um(pupils_mm)
        found_dpt = seen_refraction_of_vectors(
            np.tile(states, (pupils_mm.size, 1)),
            retina=self.retina,
            pupil_diameter_mm=np.repeat(pupils_mm, len(states)),
            added_um=np.repeat(rest_um, len(states), axis=0),
        ).reshape(pupils_mm.size, len(states))
        found_dpt -= self._rest_dpt(pupils_mm)[:, None]
        return FocusTable(pupils_mm, self._accommodations_dpt[some], found_dpt)

    def _cornea_table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return accommodations of the table, and M at the cornea of the traced eye.

        M refers to the eye alone, through its own pupil, as the networks use it.  The
        table ends where light no longer passes or M no longer falls: at the cornea a
        pupil is wider than in its own plane, and a strongly curved lens passes less of
        it.
        """
        refractions_dpt = refraction_of_vectors(
            self._vectors(self._nodes),
            retina=self.retina,
            pupil_diameter_mm=self.pupil_diameter_mm,
        )
        if not np.isfinite(refractions_dpt[0]):
            raise TraceFailed(
                "light does not pass the relaxed eye's cornea at "
                f"{self.pupil_diameter_mm:g} mm"
            )
        count = falling_count(refractions_dpt)
        return self._accommodations_dpt[:count], refractions_dpt[:count]

    def at_cornea_dpt(self, accommodations_dpt: ArrayLike) -> NDArray[np.float64]:
        """Return M at the cornea (n,) of the traced eye alone, at accommodations (n,).

        Accommodations at which light does not pass are clamped to the last at which it
        does.
        """
        used_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
        known_dpt, refractions_dpt = self._cornea_table()
        return polynomial_through(known_dpt, refractions_dpt)(
            np.minimum(used_dpt, known_dpt[-1])
        )

    def accommodations_at_cornea_dpt(
        self, refractions_dpt: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return accommodations (n,) within the amplitude for M at the cornea (n,)."""
        known_dpt, at_cornea_dpt = self._cornea_table()
        if known_dpt.size == 1:
            return np.zeros(np.shape(refractions_dpt))
        wanted_dpt = np.clip(refractions_dpt, at_cornea_dpt[-1], at_cornea_dpt[0])
        used_dpt = polynomial_through(at_cornea_dpt, known_dpt)(wanted_dpt)
        return np.clip(used_dpt, 0.0, self.amplitude_dpt)

    def _refractions_dpt(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        return refraction_of_vectors(
            self._vectors(nodes),
            retina=self.retina,
            pupil_diameter_mm=self.pupil_diameter_mm,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
            at_pupil=True,
        )

    def lens_diameters_mm(self, accommodations_dpt: ArrayLike) -> NDArray[np.float64]:
        """Return lens diameters (P,) for accommodations (P,) within the amplitude."""
        return self._nodes_at(accommodations_dpt)

    def changes_mm(self, accommodations_dpt: ArrayLike) -> NDArray[np.float64]:
        """Return changes (P, 2) of lens diameter and aqueous thickness."""
        vectors = self._vectors(self.lens_diameters_mm(accommodations_dpt))
        return (vectors - self._vector)[:, [DIAMETER, AQUEOUS]]

    def states_at(self, accommodations_dpt: ArrayLike) -> list[FocusedEye]:
        """Return states (P,) at accommodations within the amplitude, traced in a batch.

        Their ``focus_dpt`` is the focus through the eye's own pupil.
        """
        diameters_mm = self.lens_diameters_mm(accommodations_dpt)
        return self.with_diameters(accommodations_dpt, diameters_mm)

    def with_diameters(
        self, accommodations_dpt: ArrayLike, diameters_mm: ArrayLike
    ) -> list[FocusedEye]:
        """Return states (P,) with known lens diameters."""
        states = zip(*map(np.ravel, (accommodations_dpt, diameters_mm)), strict=True)
        return [self._state(*map(float, state)) for state in states]

    def _state(self, accommodation_dpt: float, diameter_mm: float) -> FocusedEye:
        relaxed = self.parameters
        eye = accommodated(
            relaxed, lens_diameter_mm=diameter_mm, keeps_conics=self._keeps_conics
        )
        return FocusedEye(
            parameters=eye,
            surfaces=eye_surfaces(eye, retina=self.retina),
            focus_dpt=self.sharpest_dpt(
                accommodation_dpt, pupil_diameter_mm=self.pupil_diameter_mm
            ),
            accommodation_dpt=accommodation_dpt,
            lens_diameter_change_mm=diameter_mm - relaxed.lens_diameter_mm,
            aqueous_thickness_change_mm=(
                eye.aqueous_thickness_mm - relaxed.aqueous_thickness_mm
            ),
            notes=(),
        )
