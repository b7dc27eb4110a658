"""Accommodation: the lens diameter and chamber depth that focus an eye at a distance.

`lens_change` describes the change of the lens.  The eye is focused at f dpt when its
ray-traced least-squares refraction M at 555 nm, over the given pupil, is -f.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BarycentricInterpolator

from estimator.corrections.worn_lens import worn_refraction
from estimator.eye.assembly import eye_surfaces
from estimator.eye.focus_table import FocusTable, table_pupils_mm
from estimator.eye.focusing import FocusedSurfaces, TabulatedFocusing
from estimator.eye.lens_change import (
    AQUEOUS,
    DIAMETER,
    accommodated,
    accommodated_vectors,
    smallest_diameter_mm,
)
from estimator.eye.parameters import EyeParameters, RetinaShape
from estimator.eye.tracing import (
    TraceFailed,
    refraction_of_vectors,
    seen_refraction_of_vectors,
)
from estimator.optics import prescription as rx
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


@dataclass(frozen=True)
class FocusedEye(FocusedSurfaces):
    """An eye of 45 parameters at one focus."""

    parameters: EyeParameters
    lens_diameter_change_mm: float
    aqueous_thickness_change_mm: float


class ResidualPhase(Protocol):
    """Phase added to that of the traced eye, see `estimate.measured_residual`."""

    def on_axis_um(self, pupil_diameter_mm: ArrayLike) -> NDArray[np.float64]:
        """Return monomials (n, n_terms) at 555 nm in the plane of pupils (n,)."""

    def on_axis_dpt(self, pupil_diameter_mm: float) -> float:
        """Return their least-squares M in a pupil."""


def falling_count(refractions_dpt: NDArray[np.float64]) -> int:
    """Return how many leading refractions are finite and decreasing."""
    usable = np.isfinite(refractions_dpt)
    usable[1:] &= np.diff(refractions_dpt) < 0.0
    usable[0] = True
    return int(np.argmin(usable)) if not usable.all() else usable.size


def polynomial_through(
    x: NDArray[np.float64], y: NDArray[np.float64]
) -> BarycentricInterpolator:
    """Return the polynomial through points, with the same rounding in every process.

    SciPy computes the weights in a random order.  With a generator of its own, two
    processes prepared one eye with wavefronts that differed by the last bits, and
    images by 1e-7.
    """
    return BarycentricInterpolator(x, y, rng=np.random.default_rng(0))


class AccommodatingEye(TabulatedFocusing[FocusedEye]):
    """An eye of 45 parameters that can focus, at any pupil.

    Attributes
    ----------
    refraction_dpt : float
        M of the relaxed eye at the cornea, 555 nm and ``pupil_diameter_mm``, through
        the correction.
    bare_refraction_dpt : float
        M without the correction.
    entrance_pupil_mm : float
        Depth of the relaxed eye's entrance pupil behind the corneal apex.
    lens_range_dpt : float
        Largest accommodation of the lens model.
    amplitude_dpt : float
        The smaller of ``lens_range_dpt`` and the given amplitude (by age), at that
        pupil.

    Parameters
    ----------
    rest : Rest, optional
        Phase added to the traced eye.
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
    ):
        self.parameters = parameters
        self.retina = retina
        self.pupil_diameter_mm = pupil_diameter_mm
        self._vector = parameters.to_vector()
        self.entrance_pupil_mm = entrance_pupil_mm(
            eye_surfaces(parameters, retina=retina),
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
        )
        self.vergence = ObjectVergence.seen_through(
            correction, entrance_pupil_mm=self.entrance_pupil_mm
        )
        diameters_mm, refractions_dpt = self._refraction_table()
        self._bare_dpt = float(refractions_dpt[0])
        self._rest = rest
        self._last_taken_off = (0.0, 0.0)
        at_cornea_dpt = 0.0
        if correction is not None:
            at_cornea_dpt, *_ = rx.power_vector(correction)
        self._correction_dpt = worn_refraction(
            correction, entrance_pupil_mm=self.entrance_pupil_mm
        )
        self.bare_refraction_dpt = refraction_at_cornea_dpt(
            self._bare_dpt + float(self._rest_dpt(pupil_diameter_mm)[0]),
            entrance_pupil_mm=self.entrance_pupil_mm,
        )
        self.refraction_dpt = self.bare_refraction_dpt - at_cornea_dpt
        self._diameters_mm = diameters_mm
        self._accommodations_dpt = self._bare_dpt - refractions_dpt
        self.lens_range_dpt = float(self._accommodations_dpt[-1])
        self._age_amplitude_dpt = amplitude_dpt
        self.amplitude_dpt = min(amplitude_dpt, self.lens_range_dpt)

    def _rest_dpt(self, pupil_diameter_mm: ArrayLike) -> NDArray[np.float64]:
        """Return M (n,) of the residual on round pupils (n,)."""
        radius_mm = np.atleast_1d(pupil_diameter_mm) / 2.0
        if self._rest is None:
            return np.zeros(radius_mm.size)
        rest_um = self._rest.on_axis_um(pupil_diameter_mm)
        zernike_um = zernike_from_polynomial(rest_um, radius_mm)
        return total_defocus_dpt(zernike_um, radius_mm)

    def _taken_off_dpt(self, pupil_diameter_mm: float) -> float:
        """Return M of the correction minus that of the residual, on a round pupil.

        That of the last pupil is cached: a frame asks for one pupil several times.
        """
        last = self._last_taken_off
        if last[0] != pupil_diameter_mm:
            taken_off_dpt = super()._taken_off_dpt(pupil_diameter_mm)
            if self._rest is not None:
                taken_off_dpt -= self._rest.on_axis_dpt(pupil_diameter_mm)
            self._last_taken_off = last = pupil_diameter_mm, taken_off_dpt
        return last[1]

    def _new_focus_table(self) -> FocusTable:
        """Trace the table, without M of the residual on a round pupil.

        In wide pupils the residual is stretched, so its M is no polynomial over the
        pupil.  The table holds only its difference between the pupil and a round one.
        """
        pupils_mm = np.array(table_pupils_mm(self.pupil_diameter_mm))
        some = np.unique(
            np.linspace(0, self._diameters_mm.size - 1, N_FOCUS).astype(int)
        )
        states = accommodated_vectors(
            self._vector, lens_diameter_mm=self._diameters_mm[some]
        )
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

        M is that of the eye alone, through its own pupil, as the networks use it.  The
        table ends where light no longer passes or M no longer falls: at the cornea a
        pupil is wider than in its own plane, and a strongly curved lens passes less of
        it.
        """
        refractions_dpt = refraction_of_vectors(
            accommodated_vectors(self._vector, lens_diameter_mm=self._diameters_mm),
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
        found_dpt: NDArray[np.float64] = polynomial_through(known_dpt, refractions_dpt)(
            np.minimum(used_dpt, known_dpt[-1])
        )
        return found_dpt

    def accommodations_at_cornea_dpt(
        self, refractions_dpt: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return accommodations (n,) within the amplitude for M at the cornea (n,)."""
        known_dpt, at_cornea_dpt = self._cornea_table()
        if known_dpt.size == 1:
            return np.zeros(np.shape(refractions_dpt))
        wanted_dpt = np.clip(refractions_dpt, at_cornea_dpt[-1], at_cornea_dpt[0])
        used_dpt = polynomial_through(at_cornea_dpt, known_dpt)(wanted_dpt)
        within_dpt: NDArray[np.float64] = np.clip(used_dpt, 0.0, self.amplitude_dpt)
        return within_dpt

    def _refraction_table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return falling lens diameters and refractions, as far as those fall."""
        relaxed_mm = self._vector[DIAMETER]
        smallest_mm = smallest_diameter_mm(self._vector)
        diameters_mm = np.linspace(relaxed_mm, smallest_mm, N_TABLE)
        vectors = accommodated_vectors(self._vector, lens_diameter_mm=diameters_mm)
        refractions_dpt = self._refractions_dpt(vectors)
        if not np.isfinite(refractions_dpt[0]):
            raise TraceFailed(
                f"light does not pass the relaxed eye at {self.pupil_diameter_mm:g} mm"
            )
        count = falling_count(refractions_dpt)
        return diameters_mm[:count], refractions_dpt[:count]

    def _refractions_dpt(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        return refraction_of_vectors(
            vectors,
            retina=self.retina,
            pupil_diameter_mm=self.pupil_diameter_mm,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
            at_pupil=True,
        )

    def lens_diameters_mm(self, accommodations_dpt: ArrayLike) -> NDArray[np.float64]:
        """Return lens diameters (P,) for accommodations (P,) within the amplitude.

        One polynomial inverts the table; secant steps, all in batches, then refine the
        result until the traced refraction is met to `REFRACTION_TOLERANCE_DPT`.
        """
        wanted_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
        known_dpt, known_mm = self._accommodations_dpt, self._diameters_mm
        if known_mm.size == 1:
            return np.full(wanted_dpt.shape, known_mm[0])
        # The table is smooth and short: linear interpolation would be 1e-2 dpt off,
        # and every further step costs a trace for each focus.
        curve = polynomial_through(known_dpt, known_mm)
        diameters_mm: NDArray[np.float64] = np.clip(
            curve(wanted_dpt), known_mm[-1], known_mm[0]
        )
        slopes = np.gradient(known_mm, known_dpt)
        slope_mm_dpt = np.interp(wanted_dpt, known_dpt, slopes)
        for _ in range(MAX_REFINEMENTS):
            vectors = accommodated_vectors(self._vector, lens_diameter_mm=diameters_mm)
            reached_dpt = self._bare_dpt - self._refractions_dpt(vectors)
            error_dpt = wanted_dpt - reached_dpt
            if np.max(np.abs(error_dpt)) < REFRACTION_TOLERANCE_DPT:
                break
            step_mm = slope_mm_dpt * error_dpt
            diameters_mm = np.clip(diameters_mm + step_mm, known_mm[-1], known_mm[0])
        return diameters_mm

    def changes_mm(self, accommodations_dpt: ArrayLike) -> NDArray[np.float64]:
        """Return changes (P, 2) of lens diameter and aqueous thickness."""
        vectors = accommodated_vectors(
            self._vector, lens_diameter_mm=self.lens_diameters_mm(accommodations_dpt)
        )
        return (vectors - self._vector)[:, [DIAMETER, AQUEOUS]]

    def states_at(self, accommodations_dpt: ArrayLike) -> list[FocusedEye]:
        """Return states (P,) at accommodations within the amplitude, traced in a batch.

        Their ``focus_dpt`` is that of the eye's own pupil.
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
        eye = accommodated(relaxed, lens_diameter_mm=diameter_mm)
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
