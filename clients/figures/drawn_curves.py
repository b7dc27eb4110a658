"""Curves of persons drawn from the population, for the bands of a report.

They have the prescription of an eye, or its wavefront on the axis, and differ in
everything else.  Their curves are coarser than those of an `EyeStudy`: a person takes
0.3 s instead of 5 s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.figures.orders import rms_um
from clients.figures.study import (
    FIELD_H_DEG,
    FIELD_PUPIL_MM,
    PUPILS_MM,
    WAVELENGTH_NM,
    EyeStudy,
)
from clients.figures.transfer_curves import FREQUENCY_CPD
from estimator import (
    DrawnFields,
    drawn_fields,
    drawn_profiles,
    draws_axis,
    log_mar_of,
)

ACUITY_PUPIL_MM = PUPILS_MM[0]
"""Pupil of the acuity of drawn persons; the larger one would take another 0.1 s."""

SHARP_STEP_CPD, BLURRED_STEP_CPD, N_SAMPLES, N_BISECTIONS = 1.0, 0.5, 64, 8
"""Coarser than by default.  In 12 persons of three prescriptions, modulation is within
0.003 (of one in three at 5 mm 0.012) and acuity within 0.05 logMAR (one value 0.08)."""

WORST_LOG_MAR = 2.5
"""Acuity of wavefronts that are too steep to be resolved, as for `log_mar_of`."""


@dataclass(frozen=True)
class DrawnPeople:
    """Persons drawn from the population.

    Attributes
    ----------
    count : int
        Number N of persons.
    field : DrawnFields
        Relaxed, along the horizontal meridian (`FIELD_H_DEG`), through 4 mm.
    modulation : dict of (N, n)
        MTFs of a far object by pupil, best corrected, at `FREQUENCY_CPD`.  This and
        the following are empty if the axis is not drawn, and through lenslets.
    higher_order_rms_um : dict of (N,)
        By pupil, in the entrance pupil.
    log_mar : dict of (N, n)
        Acuity of accommodating persons by pupil, at the distances of the study.
    """

    count: int
    field: DrawnFields
    modulation: dict[float, NDArray[np.float64]]
    higher_order_rms_um: dict[float, NDArray[np.float64]]
    log_mar: dict[float, NDArray[np.float64]]


def drawn_people(
    study: EyeStudy, count: int, *, progress: Callable[[float], None] | None = None
) -> DrawnPeople:
    """Draw persons with the profile of a study.

    Parameters
    ----------
    count : int
        Number of persons, 2 to 1000.
    progress : callable, optional
        Called with the completed fraction.

    Raises
    ------
    ValueError
        The count is not allowed, or persons with this profile do not differ.
    """
    has_axis = draws_axis(study.profile) and study.far(ACUITY_PUPIL_MM).is_readable
    steps = (1 + has_axis) * count
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done / steps)

    field = drawn_fields(
        study.profile,
        count,
        progress=advance,
        h_deg=FIELD_H_DEG,
        v_deg=0.0,
        pupil_diameter_mm=study.optics.usable_pupil_mm(FIELD_PUPIL_MM),
        wavelength_nm=WAVELENGTH_NM,
    )
    axes = []
    for profile in drawn_profiles(study.profile, count) if has_axis else ():
        axes.append(_axis_of(study, EyeStudy.of(profile)))
        advance()
    if not axes:
        return DrawnPeople(count, field, {}, {}, {})
    modulation, higher_order_rms_um, log_mar = zip(*axes, strict=True)
    return DrawnPeople(
        count,
        field,
        dict(zip(PUPILS_MM, np.stack(modulation, axis=1), strict=True)),
        dict(zip(PUPILS_MM, np.stack(higher_order_rms_um, axis=1), strict=True)),
        {ACUITY_PUPIL_MM: np.stack(log_mar)},
    )


def _axis_of(
    study: EyeStudy, person: EyeStudy
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the MTFs (pupils, n), RMS (pupils,) and acuity (m,) of a person."""
    seen = [person.far(pupil_mm) for pupil_mm in PUPILS_MM]
    modulation = [
        wavefront.near_best_corrected(n_samples=N_SAMPLES)
        .transfer(frequency_step_cpd=SHARP_STEP_CPD)
        .modulation(FREQUENCY_CPD)
        for wavefront in seen
    ]
    rms = [rms_um(wavefront.zernike_um) for wavefront in seen]
    return np.array(modulation), np.array(rms), _acuity(study, person)


def _acuity(study: EyeStudy, person: EyeStudy) -> NDArray[np.float64]:
    """Return the acuity (n,) of a person at the distances of the study.

    The difference from the eye of the study is computed at the first and last distance
    and around both ends of accommodation, where it changes most, and interpolated.
    """
    known = study.acuity(ACUITY_PUPIL_MM)
    own = np.minimum(known.near_log_mar, WORST_LOG_MAR)
    last = own.size - 1
    limits_dpt = study.optics.focus_limits_dpt(
        study.optics.usable_pupil_mm(ACUITY_PUPIL_MM)
    )
    far, near = np.abs(known.object_dpt[:, None] - limits_dpt).argmin(axis=0)
    chosen = np.clip([0, far - 1, far, near, near + 1, near + 3, last], 0, last)
    chosen = np.unique(chosen)
    at_dpt = known.object_dpt[chosen]
    difference = [_log_mar(person, distance_dpt) for distance_dpt in at_dpt.tolist()]
    return own + np.interp(known.object_dpt, at_dpt, difference - own[chosen])


def _log_mar(person: EyeStudy, distance_dpt: float) -> float:
    seen = person.wavefront(
        ACUITY_PUPIL_MM, object_dpt=distance_dpt, focus_dpt=distance_dpt
    )
    try:
        transfer = seen.transfer(frequency_step_cpd=BLURRED_STEP_CPD)
    except ValueError:
        return WORST_LOG_MAR
    return log_mar_of(transfer, n_bisections=N_BISECTIONS)
