"""An eye given by surfaces that focuses by changing between the states of its profile.

Light is traced through the surfaces as they are: no typical aberration, periphery or
chromatic correction is added.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.worn_lens import worn_refraction
from estimator.eye.accommodation import (
    MAX_REFINEMENTS,
    N_FOCUS,
    N_TABLE,
    REFRACTION_TOLERANCE_DPT,
    falling_count,
    polynomial_through,
)
from estimator.eye.focus_table import FocusTable, table_pupils_mm
from estimator.eye.focusing import FocusedSurfaces, TabulatedFocusing
from estimator.eye.surface_model import SurfaceModel
from estimator.eye.tracing import TraceFailed, refraction_of_packed, seen_refraction_dpt
from estimator.optics import prescription as rx
from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.raytrace import obstruction
from estimator.optics.surfaces import EyeSurfaces, media_indices, pack_eye
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.vergence import ObjectVergence, refraction_at_cornea_dpt


def _reason(eye: EyeSurfaces, pupil_diameter_mm: float) -> str:
    reason = obstruction(
        eye,
        radius_mm=pupil_diameter_mm / 2.0,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
    )
    return f" ({reason})" if reason else ""


def _entrance_pupil_mm(eye: EyeSurfaces) -> float:
    return entrance_pupil_mm(eye, wavelength_nm=REFERENCE_WAVELENGTH_NM)


class SurfaceEye(TabulatedFocusing[FocusedSurfaces]):
    """An eye given by surfaces that can focus, at any pupil.

    Attributes
    ----------
    refraction_dpt : float
        M of the relaxed eye at the cornea, 555 nm and ``pupil_diameter_mm``, through
        the correction.
    entrance_pupil_mm : float
        Depth of the relaxed eye's entrance pupil behind the corneal apex.
    amplitude_dpt : float
        The smaller of the accommodation of the last state and the given amplitude (by
        age), at that pupil.

    Raises
    ------
    TraceFailed
        Light does not pass the relaxed eye.
    """

    def __init__(
        self,
        model: SurfaceModel,
        *,
        pupil_diameter_mm: float = 4.0,
        amplitude_dpt: float = math.inf,
        correction: rx.Prescription | None = None,
    ):
        self.model = model
        self.pupil_diameter_mm = pupil_diameter_mm
        self.entrance_pupil_mm = _entrance_pupil_mm(model.relaxed)
        if not math.isfinite(self.entrance_pupil_mm):
            raise TraceFailed("the eye has no entrance pupil: the stop images to none")
        self.vergence = ObjectVergence.seen_through(
            correction, entrance_pupil_mm=self.entrance_pupil_mm
        )
        self._nominal_dpt, refractions_dpt = self._refraction_table()
        self._bare_dpt = float(refractions_dpt[0])
        self._accommodations_dpt = self._bare_dpt - refractions_dpt
        self._correction_dpt = worn_refraction(
            correction, entrance_pupil_mm=self.entrance_pupil_mm
        )
        at_cornea_dpt = 0.0
        if correction is not None:
            at_cornea_dpt, *_ = rx.power_vector(correction)
        bare_dpt = refraction_at_cornea_dpt(
            self._bare_dpt, entrance_pupil_mm=self.entrance_pupil_mm
        )
        self.refraction_dpt = bare_dpt - at_cornea_dpt
        self._age_amplitude_dpt = amplitude_dpt
        self.amplitude_dpt = min(amplitude_dpt, float(self._accommodations_dpt[-1]))

    def _refraction_table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return nominal accommodations and refractions, as far as those fall."""
        count = N_TABLE if self.model.accommodated else 1
        nominal_dpt = np.linspace(0.0, self.model.largest_dpt, count)
        refractions_dpt = self._refractions_dpt(nominal_dpt)
        if not np.isfinite(refractions_dpt[0]):
            raise TraceFailed(
                f"light does not pass the relaxed eye at {self.pupil_diameter_mm:g} mm"
                + _reason(self.model.relaxed, self.pupil_diameter_mm)
            )
        falling = falling_count(refractions_dpt)
        return nominal_dpt[:falling], refractions_dpt[:falling]

    def _refractions_dpt(self, nominal_dpt: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return M (P,) in the plane of the entrance pupil, at the eye's own pupil."""
        eyes = [self.model.at(nominal) for nominal in nominal_dpt.tolist()]
        return refraction_of_packed(
            np.stack([pack_eye(eye) for eye in eyes]),
            np.stack([media_indices(eye, REFERENCE_WAVELENGTH_NM) for eye in eyes]),
            pupil_z_mm=[_entrance_pupil_mm(eye) for eye in eyes],
            pupil_diameter_mm=self.pupil_diameter_mm,
        )

    def _new_focus_table(self) -> FocusTable:
        """Trace the table."""
        pupils_mm = np.array(table_pupils_mm(self.pupil_diameter_mm))
        some = np.unique(
            np.linspace(0, self._nominal_dpt.size - 1, N_FOCUS).astype(int)
        )
        columns = []
        for nominal_dpt in self._nominal_dpt[some].tolist():
            eye = self.model.at(nominal_dpt)
            columns.append(
                seen_refraction_dpt(
                    np.repeat(pack_eye(eye)[None], pupils_mm.size, axis=0),
                    media_indices(eye, REFERENCE_WAVELENGTH_NM),
                    pupil_z_mm=_entrance_pupil_mm(eye),
                    pupil_diameter_mm=pupils_mm,
                )
            )
        found_dpt = np.stack(columns, axis=1)
        if not np.isfinite(found_dpt).all(axis=1).any():
            raise TraceFailed(
                f"light does not fill a pupil of {pupils_mm[0]:g} mm in every state"
                + _reason(self.model.relaxed, pupils_mm[0])
            )
        return FocusTable(pupils_mm, self._accommodations_dpt[some], found_dpt)

    def _nominals_dpt(
        self, accommodations_dpt: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return nominal accommodations (P,) for accommodations (P,), by secant steps.

        They are refined until the traced refraction is met to
        `REFRACTION_TOLERANCE_DPT`.
        """
        known_dpt, nominal_dpt = self._accommodations_dpt, self._nominal_dpt
        if nominal_dpt.size == 1:
            return np.zeros(accommodations_dpt.shape)
        found_dpt: NDArray[np.float64] = np.clip(
            polynomial_through(known_dpt, nominal_dpt)(accommodations_dpt),
            *nominal_dpt[[0, -1]],
        )
        slope = np.interp(
            accommodations_dpt, known_dpt, np.gradient(nominal_dpt, known_dpt)
        )
        for _ in range(MAX_REFINEMENTS):
            reached_dpt = self._bare_dpt - self._refractions_dpt(found_dpt)
            error_dpt = accommodations_dpt - reached_dpt
            if np.max(np.abs(error_dpt)) < REFRACTION_TOLERANCE_DPT:
                break
            found_dpt = np.clip(found_dpt + slope * error_dpt, *nominal_dpt[[0, -1]])
        return found_dpt

    def states_at(self, accommodations_dpt: ArrayLike) -> Sequence[FocusedSurfaces]:
        """Return states (P,) at accommodations within the amplitude.

        Their ``focus_dpt`` is that of the eye's own pupil.
        """
        wanted_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
        nominals_dpt = self._nominals_dpt(wanted_dpt)
        return [
            FocusedSurfaces(
                surfaces=self.model.at(nominal_dpt),
                focus_dpt=self.sharpest_dpt(
                    accommodation_dpt, pupil_diameter_mm=self.pupil_diameter_mm
                ),
                accommodation_dpt=accommodation_dpt,
                notes=(),
            )
            for nominal_dpt, accommodation_dpt in zip(
                nominals_dpt.tolist(), wanted_dpt.tolist(), strict=True
            )
        ]
