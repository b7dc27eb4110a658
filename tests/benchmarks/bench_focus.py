"""Best focus of eyes compared with the requested focus, by forward ray tracing.

Every eye is asked, as a frame asks it, to look at distances through pupils of 2 to 7
mm.  Rays from points at many distances then run inwards to the retina: error is how far
the distance of the smallest RMS wavefront lies from the focus that the eye reported.
"""

import time

import numpy as np

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.field.traced_eye import TracedEye
from estimator.optics.units import RGB_WAVELENGTHS_NM
from estimator.profiles.parse import EyeProfile, parse_profile, preset_names
from tests.benchmarks.forward_rays import WAVELENGTH_NM, ForwardEye
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of

MINUTES = 1
PUPILS_MM = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
FOCI_DPT = (0.0, 1.5, 3.0, 4.5, 6.0)
SPHERES_DPT = (-6.0, 0.0, 4.0)
REFERENCE = "smallest RMS wavefront of rays from the object to the retina"
REACH_MARGIN_DPT = 1e-3


def profiles() -> dict[str, EyeProfile]:
    """Eyes by name: three prescriptions and every preset."""
    found = {
        f"{sphere_dpt:+g} dpt": parse_profile(
            {
                "kind": "prescription",
                "sphere_dpt": sphere_dpt,
                "higher_order": "none",
            }
        )
        for sphere_dpt in SPHERES_DPT
    }
    for name in preset_names():
        found[name] = parse_profile({"kind": "preset", "name": name})
    return found


def _row(method, case, setting, times_ms, name, error, **more) -> Row:
    return row_of(
        *("focus", method, case, setting, times_ms, name, error, REFERENCE), **more
    )


def prepared(eye: EstimatedEye) -> TracedEye:
    """Return the eye as a service prepares it for all these frames, on its axis."""
    return TracedEye.trace(
        eye,
        pupil_diameters_mm=PUPILS_MM,
        focus_range_dpt=(FOCI_DPT[0], FOCI_DPT[-1]),
        wavelengths_nm=RGB_WAVELENGTHS_NM,
    )


def focus_rows(name: str, profile: EyeProfile, pupils_mm, foci_dpt) -> list[Row]:
    """A row for each pupil and focus."""
    estimated = estimate_eye(profile)
    eye, rows = prepared(estimated), []
    rest = estimated.rest(WAVELENGTH_NM)
    for pupil_mm in pupils_mm:
        for focus_dpt in foci_dpt:
            asked = {"focus_dpt": focus_dpt, "pupil_diameter_mm": pupil_mm}
            started_s = time.perf_counter()
            used_dpt = eye.accommodation_dpt(**asked)
            said_dpt = eye.reachable_focus_dpt(**asked)
            time_ms = 1e3 * (time.perf_counter() - started_s)
            (state,) = estimated.accommodating.states_at([used_dpt])
            forward = ForwardEye.of(
                state.surfaces,
                pupil_diameter_mm=pupil_mm,
                rest_um=rest.on_axis_um(pupil_mm)[0],
            )
            error_dpt = forward.sharpest_dpt(said_dpt) - said_dpt
            setting = f"{pupil_mm:g} mm, asked {focus_dpt:g}, reached {said_dpt:.3f}"
            reaches = abs(said_dpt - focus_dpt) <= REACH_MARGIN_DPT
            method = "in reach" if reaches else "end of reach"
            rows.append(
                _row(method, name, setting, [time_ms], "best focus, dpt", error_dpt)
            )
    return rows


def summary_rows(rows: list[Row]) -> list[Row]:
    """Largest and median error of each method over all eyes."""
    found = []
    for method in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == method]
        errors = np.abs([row.error for row in own])
        times_ms = [row.median_ms for row in own]
        for label, value in (("median", np.median(errors)), ("largest", errors.max())):
            found.append(
                _row(method, "all eyes", label, times_ms, own[0].error_name, value)
            )
    return found


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes, or of one with one pupil and focus."""
    rows = []
    for name, profile in [*profiles().items()][: 1 if run.is_quick else None]:
        asked = ((4.0,), (1.5,)) if run.is_quick else (PUPILS_MM, FOCI_DPT)
        rows += focus_rows(name, profile, *asked)
    return summary_rows(rows) + rows
