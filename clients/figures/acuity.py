"""Visual acuity of an eye by distance, as limited by its optics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clients.figures.pupil_wavefront import PupilWavefront
from estimator import EyeOptics, log_mar_of

STEP_COUNT, ACCOMMODATED_COUNT = 11, 3
"""Number of distances of a curve, and of its part within the accommodation range."""

FINE_STEP_DPT = 0.25
"""Step of the curve of a lens with several foci, which lie 1 dpt apart."""

PAST_LAST_FOCUS_DPT = 1.0

NEAREST_DPT = 5.0
PAST_FAR_POINT_DPT = 2.0
HIGHEST_DPT = 20.0
MIN_ACCOMMODATION_DPT = 1e-6
"""Smallest accommodation range; an eye with less is treated as fixed-focus."""


class Eye(Protocol):
    """The interface required of an eye, which `EyeStudy` implements."""

    @property
    def optics(self) -> EyeOptics:
        """Return the optics on the axis, in all states of focus."""

    def wavefront(
        self,
        pupil_diameter_mm: float,
        *,
        object_dpt: float = 0.0,
        focus_dpt: float = 0.0,
    ) -> PupilWavefront:
        """Return the wavefront of a point in the pupil."""


@dataclass(frozen=True)
class AcuityByDistance:
    """Acuity through one pupil, logMAR; infinite where the blur is too wide.

    Attributes
    ----------
    object_dpt : (n,)
        Distances, far to near.
    far_log_mar, near_log_mar : (n,)
        Acuity of the eye focused far, and accommodating for each distance.
    """

    object_dpt: NDArray[np.float64]
    far_log_mar: NDArray[np.float64]
    near_log_mar: NDArray[np.float64]


def acuity_by_distance(study: Eye, pupil_diameter_mm: float) -> AcuityByDistance:
    """Return the acuity of an eye from far to 20 cm, or past its far point."""
    object_dpt = distances_dpt(study, pupil_diameter_mm)
    far = through_focus_log_mar(study, pupil_diameter_mm, object_dpt)
    near = accommodated_log_mar(study, pupil_diameter_mm, object_dpt, far)
    return AcuityByDistance(object_dpt, far, near)


def acuity_log_mar(wavefront: PupilWavefront) -> float:
    """Return the acuity of a wavefront; infinite if it is too steep to be resolved.

    NaN through lenslets: how people read through them is not known.
    """
    if not wavefront.is_readable:
        return np.nan
    try:
        return log_mar_of(wavefront.transfer())
    except ValueError:
        return np.inf


def distances_dpt(study: Eye, pupil_diameter_mm: float) -> NDArray[np.float64]:
    """Return the distances (n,) of a curve: far to 20 cm, and past the far point."""
    pupil_mm = study.optics.usable_pupil_mm(pupil_diameter_mm)
    far_dpt, _ = study.optics.focus_limits_dpt(pupil_mm)
    nearest = min(max(NEAREST_DPT, far_dpt + PAST_FAR_POINT_DPT), HIGHEST_DPT)
    even = np.linspace(0.0, np.ceil(nearest), STEP_COUNT)
    peaks_dpt = np.array([far_dpt])
    seen = study.wavefront(pupil_mm)
    if seen.rings is not None and seen.is_readable:
        peaks_dpt = far_dpt + seen.rings.main_dpt(seen.wavelength_nm)
        last_dpt = float(peaks_dpt.max()) + PAST_LAST_FOCUS_DPT
        nearest = max(nearest, last_dpt)
        first_dpt = max(far_dpt - PAST_LAST_FOCUS_DPT, 0.0)
        fine = np.arange(first_dpt, last_dpt, FINE_STEP_DPT)
        even = np.union1d(np.linspace(0.0, np.ceil(nearest), STEP_COUNT), fine)
    return np.union1d(even, peaks_dpt[(peaks_dpt > 0.0) & (peaks_dpt < nearest)])


def through_focus_log_mar(
    study: Eye, pupil_diameter_mm: float, object_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the acuity (n,) of an eye focused far, logMAR, at distances (n,)."""
    return np.array(
        [
            acuity_log_mar(study.wavefront(pupil_diameter_mm, object_dpt=distance_dpt))
            for distance_dpt in object_dpt.tolist()
        ]
    )


def accommodated_log_mar(
    study: Eye,
    pupil_diameter_mm: float,
    object_dpt: NDArray[np.float64],
    far_log_mar: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the acuity (n,) of an eye that accommodates for each distance, logMAR.

    Within the accommodation range acuity changes slowly: it is computed at three
    distances and interpolated.

    Parameters
    ----------
    far_log_mar : (n,)
        Acuity of the same eye focused far, which applies beyond its far point.
    """
    pupil_mm = study.optics.usable_pupil_mm(pupil_diameter_mm)
    far_dpt, near_dpt = study.optics.focus_limits_dpt(pupil_mm)
    if near_dpt - far_dpt < MIN_ACCOMMODATION_DPT:
        return far_log_mar.copy()

    def predict(distances: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(
            [
                acuity_log_mar(study.wavefront(pupil_mm, object_dpt=d, focus_dpt=d))
                for d in distances.tolist()
            ]
        )

    found = far_log_mar.copy()
    is_near = object_dpt > near_dpt
    found[is_near] = predict(object_dpt[is_near])
    within = object_dpt[(object_dpt >= max(far_dpt, 0.0)) & ~is_near]
    if within.size:
        sampled_dpt = np.unique(np.linspace(within[0], within[-1], ACCOMMODATED_COUNT))
        found[np.isin(object_dpt, within)] = np.interp(
            within, sampled_dpt, predict(sampled_dpt)
        )
    return found
