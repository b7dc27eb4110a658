"""An eye given by surfaces that focuses by changing between the states of its profile.

Light is traced through the surfaces as they are: no typical aberration, periphery or
chromatic correction is added.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.accommodation import (
    N_FOCUS,
    N_TABLE,
    TabulatedFocusing,
)
from estimator.eye.focusing import FocusedSurfaces, FocusTable, table_pupils_mm
from estimator.eye.surface_model import SurfaceModel
from estimator.eye.tracing import TraceFailed, refraction_of_packed, seen_refraction_dpt
from estimator.optics import prescription as rx
from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.raytrace import obstruction
from estimator.optics.surfaces import EyeSurfaces, media_indices, pack_eye
from estimator.optics.units import REFERENCE_WAVELENGTH_NM


def _entrance_pupil_mm(eye: EyeSurfaces) -> float:
    return entrance_pupil_mm(eye, wavelength_nm=REFERENCE_WAVELENGTH_NM)


class SurfaceEye(TabulatedFocusing[FocusedSurfaces]):
    """An eye given by surfaces that can focus, at any pupil.

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
        count = N_TABLE if model.accommodated else 1
        self._tabulate(
            np.linspace(0.0, model.largest_dpt, count),
            correction=correction,
            amplitude_dpt=amplitude_dpt,
        )

    def _obstruction(self, pupil_diameter_mm: float) -> str:
        reason = obstruction(
            self.model.relaxed,
            radius_mm=pupil_diameter_mm / 2.0,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
        )
        return f" ({reason})" if reason else ""

    def _refractions_dpt(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        eyes = [self.model.at(nominal_dpt) for nominal_dpt in nodes.tolist()]
        return refraction_of_packed(
            np.stack([pack_eye(eye) for eye in eyes]),
            np.stack([media_indices(eye, REFERENCE_WAVELENGTH_NM) for eye in eyes]),
            pupil_z_mm=[_entrance_pupil_mm(eye) for eye in eyes],
            pupil_diameter_mm=self.pupil_diameter_mm,
        )

    def _new_focus_table(self) -> FocusTable:
        """Trace the table."""
        pupils_mm = np.array(table_pupils_mm(self.pupil_diameter_mm))
        some = np.unique(np.linspace(0, self._nodes.size - 1, N_FOCUS).astype(int))
        columns = []
        for nominal_dpt in self._nodes[some].tolist():
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
                + self._obstruction(pupils_mm[0])
            )
        return FocusTable(pupils_mm, self._accommodations_dpt[some], found_dpt)

    def states_at(self, accommodations_dpt: ArrayLike) -> Sequence[FocusedSurfaces]:
        """Return states (P,) at accommodations within the amplitude.

        Their ``focus_dpt`` is that of the eye's own pupil.
        """
        wanted_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
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
                self._nodes_at(wanted_dpt).tolist(), wanted_dpt.tolist(), strict=True
            )
        ]
