"""From a profile to the eye that PSFs are made of, by the service's accuracy setting.

The eye is asked as the PSF build asks it: at the same fields, pupils, focus distances
and colours for every setting, each with its own accommodation and defocus.
"""

from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from estimator.field.traced_eye import TracedEye
from filter_service.camera import Camera
from filter_service.planning.grid import GridSpec
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.settings import Accuracy
from tests.benchmarks import eye_ways
from tests.benchmarks.harness import Row, memory_mb, time_calls
from tests.benchmarks.network_nodes import product_rows
from tests.grid_specs import grid_spec

VERTICAL_TANGENT = np.tan(np.radians(25.0))
SIZE_PX = (1280, 720)
N_H, N_V, N_PUPILS, N_FOCUSES = 7, 5, 4, 4
REFERENCE_ACCURACY = "exact"


@dataclass(frozen=True)
class AccuracyRow(Row):
    """One setting and condition; ``notes`` is what the service says of the eye."""

    notes: tuple[str, ...]


def dynamic_spec(size_px: tuple[int, int] = SIZE_PX, **more) -> GridSpec:
    """What the dynamic mode asks for at 50 degrees of vertical field."""
    up = float(VERTICAL_TANGENT)
    right = up * size_px[0] / size_px[1]
    camera = Camera(*size_px, (-right, right, up, -up))
    return grid_spec(camera, mode="dynamic", **more)


def asked_states(spec: GridSpec, *, max_pupil_mm: float) -> NDArray[np.float64]:
    """Fixed states (n, 5): azimuth, elevation, pupil, focus distance, wavelength."""
    (h_low, h_high), (v_low, v_high) = spec.field_range_deg
    low_mm, high_mm = spec.settings.pupil_range_mm
    return product_rows(
        np.linspace(h_low, h_high, N_H),
        np.linspace(v_low, v_high, N_V),
        np.linspace(low_mm, min(high_mm, max_pupil_mm), N_PUPILS),
        np.linspace(*spec.settings.focus_range_dpt, N_FOCUSES),
        np.unique(spec.wavelengths_nm),
    )


def answered_um(eye: TracedEye, states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients (n, 27) of an eye that is asked to focus, on its own circles."""
    h_deg, v_deg, pupils_mm, focuses_dpt, wavelengths_nm = states.T
    used_dpt = np.array(
        [
            eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm)
            for focus_dpt, pupil_mm in zip(focuses_dpt, pupils_mm, strict=True)
        ]
    )
    state = {
        **{"h_deg": h_deg, "v_deg": v_deg, "pupil_diameter_mm": pupils_mm},
        **{"accommodation_dpt": used_dpt, "wavelength_nm": wavelengths_nm},
    }
    total_dpt = eye.total_defocus_dpt(**state)
    return eye.wavefronts(**state, total_defocus_dpt=total_dpt).zernike_um[:, 1:]


def mean_difference_um(
    eye: TracedEye, exact: TracedEye, spec: GridSpec
) -> tuple[float, int]:
    """Mean absolute difference over 27 terms and all states, and how many states."""
    largest_mm = min(eye.max_pupil_diameter_mm, exact.max_pupil_diameter_mm)
    states = asked_states(spec, max_pupil_mm=largest_mm)
    difference_um = answered_um(eye, states) - answered_um(exact, states)
    return float(np.mean(np.abs(difference_um))), len(states)


def accuracy_rows(case: str, *, repeats: int, spec: GridSpec) -> list[AccuracyRow]:
    """All settings for one condition, against the exact one."""
    profile = eye_ways.preset_profile(case)

    def prepared(accuracy: str):
        return eye_for_spec(profile, spec.with_settings(accuracy=accuracy))

    exact, _ = prepared(REFERENCE_ACCURACY)
    size = f"dynamic {spec.camera.width_px}x{spec.camera.height_px}"
    rows = []
    for accuracy in get_args(Accuracy):
        eye, notes = prepared(accuracy)
        error_um, n_states = mean_difference_um(eye, exact, spec)
        times_ms = time_calls(lambda a=accuracy: prepared(a), repeats=repeats)
        rows.append(
            AccuracyRow(
                *("networks", f"accuracy {accuracy}", case, size),
                *(repeats, *times_ms, memory_mb(), eye_ways.ERROR_NAME, error_um),
                f"accuracy {REFERENCE_ACCURACY}, {n_states} states",
                notes=notes,
            )
        )
    return rows
