"""The same person before and after: what stays, and the refraction that remains.

- ``stays``: largest change of length, K (not of a laser) and the phase of the periphery
  at 25 deg, from the eye without to the eye with the correction.  Goal: 0.
- ``refraction``: largest difference of sphere-equivalent, J0 and J45 through 4 mm from
  the residual that the profile asks for, traced as `ocufilter field` does.  Goal: 0.02.
- ``formula``: power of an implant less that of SRK/T, Haigis, Holladay 1 and Hoffer Q,
  whose constants are matched in the emmetropic eye; the lens is where the formula puts
  it.
- ``pseudophakic``: refraction of an eye of that kind, whose power was solved from its
  biometry, less the residual, in the plane of the pupil.

Times are those of an eye, estimated and operated.
"""

import time
from functools import partial

import numpy as np
from scipy.optimize import brentq

from estimator import power_vector
from estimator.estimate.biometry import eye_biometry
from estimator.estimate.model import eye_model
from estimator.field.field_table import field_table
from estimator.field.traced_fields import peripheral_residual
from estimator.optics.prescription import Prescription
from estimator.profiles.parse import parse_profile
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.numerical.iol_formulas import FORMULAS

MINUTES = 1
PERSONS = {
    "myope, 68": {"kind": "prescription", "sphere_dpt": -2.5, "age_years": 68},
    "astigmat, 30": {
        "kind": "prescription",
        "sphere_dpt": -4,
        "cylinder_dpt": -2.25,
        "axis_deg": 20,
        "age_years": 30,
    },
    "hyperope, 60": {"kind": "prescription", "sphere_dpt": 3, "age_years": 60},
    "keratoconus": {"kind": "preset", "name": "keratoconus"},
    "cataract": {"kind": "preset", "name": "cataract"},
}
CORRECTIONS = {
    "spectacles": {"sphere_dpt": -2.5, "vertex_mm": 12},
    "contact lens": {"kind": "contact_lens", "sphere_dpt": -2.5},
    "implant": {"kind": "iol", "residual_sphere_dpt": 0},
    "implant, -1.00 -0.50 x 30": {
        "kind": "iol",
        "residual_sphere_dpt": -1,
        "residual_cylinder_dpt": -0.5,
        "residual_axis_deg": 30,
    },
    "laser": {"kind": "laser"},
}
SURGERIES = [name for name in CORRECTIONS if name.startswith(("implant", "laser"))]
row = partial(row_of, "surgery")
SPHERES_DPT = (-6.0, -3.0, 2.0, 4.0)
NODES_DEG = np.linspace(-30.0, 30.0, 5), np.zeros(1)
AT_DEG = np.array([-25.0, 25.0]), np.zeros(2)


def _timed_eye(body: dict):
    start_s = time.perf_counter()
    eye = eye_model(parse_profile(body))
    return eye, 1e3 * (time.perf_counter() - start_s)


def _stays_rows(person: str, body: dict, names: list[str]) -> list[Row]:
    """Return a row of each correction for each quantity that it leaves alone."""
    before, _ = _timed_eye(body)
    lengths = eye_biometry(before.relaxed)
    phase_um = peripheral_residual(before, NODES_DEG).at(*AT_DEG)
    rows = []
    for name in names:
        eye, time_ms = _timed_eye({**body, "correction": CORRECTIONS[name]})
        found = eye_biometry(eye.relaxed)
        changes = {
            "length, mm": found.axial_length_mm - lengths.axial_length_mm,
            "K, dpt": found.keratometry_dpt - lengths.keratometry_dpt,
            "phase at 25 deg, um": np.abs(
                peripheral_residual(eye, NODES_DEG).at(*AT_DEG) - phase_um
            ).max(),
        }
        if name == "laser":
            del changes["K, dpt"]
        rows += [
            row("stays", person, name, [time_ms], what, abs(change), "before")
            for what, change in changes.items()
        ]
    return rows


def _refraction_rows(person: str, body: dict, names: list[str]) -> list[Row]:
    rows = []
    for name in names:
        correction = CORRECTIONS[name]
        profile = parse_profile({**body, "correction": correction})
        start_s = time.perf_counter()
        found = field_table(
            profile,
            h_deg=np.zeros(1),
            v_deg=np.zeros(1),
            pupil_diameter_mm=4.0,
            wavelength_nm=555.0,
        ).power_dpt[0]
        time_ms = 1e3 * (time.perf_counter() - start_s)
        wanted = power_vector(
            Prescription(
                correction.get("residual_sphere_dpt", 0.0),
                correction.get("residual_cylinder_dpt", 0.0),
                correction.get("residual_axis_deg", 0.0),
            )
        )
        error_dpt = np.abs(found - wanted).max()
        rows.append(
            row("refraction", person, name, [time_ms], "dpt", error_dpt, "residual")
        )
    return rows


def _planned(sphere_dpt: float, center_mm: float | None = None):
    """Return an implant, its time, and length, K and chamber depth before surgery."""
    body = {"kind": "prescription", "sphere_dpt": sphere_dpt, "higher_order": "none"}
    lens = dict(CORRECTIONS["implant"])
    if center_mm is not None:
        lens["depth_mm"] = center_mm
    eye, time_ms = _timed_eye({**body, "correction": lens})
    found = eye_biometry(eye.natural.relaxed)
    numbers = found.axial_length_mm, found.keratometry_dpt, found.chamber_depth_mm
    return eye.implant, time_ms, numbers


def formula_rows(spheres_dpt: tuple[float, ...]) -> list[Row]:
    """Return a row for each formula and refraction before surgery."""
    mean, _, emmetropic = _planned(0.0)
    rows = []
    for name, (power_dpt, position_mm) in FORMULAS.items():
        own_mm = position_mm(*emmetropic)
        constant_mm = brentq(
            lambda c, power_dpt=power_dpt, own_mm=own_mm: (
                power_dpt(*emmetropic[:2], own_mm + c) - mean.power_dpt
            ),
            -4.0,
            8.0,
        )
        for sphere_dpt in spheres_dpt:
            _, _, numbers = _planned(sphere_dpt)
            lens_mm = position_mm(*numbers)
            found, time_ms, _ = _planned(sphere_dpt, mean.center_mm + lens_mm - own_mm)
            expected_dpt = power_dpt(*numbers[:2], lens_mm + constant_mm)
            error_dpt = found.power_dpt - expected_dpt
            rows.append(
                row("formula", f"{sphere_dpt:+g} dpt", name, [time_ms], "dpt of the "
                     "implant", error_dpt, name)
            )  # fmt: skip
    return rows


def pseudophakic_rows(lengths_mm: tuple[float, ...]) -> list[Row]:
    """Return a row for each length: a power solved from biometry alone."""
    rows = []
    for length_mm in lengths_mm:
        body = {
            "kind": "pseudophakic",
            "axial_length_mm": length_mm,
            "keratometry_dpt": [43.5, 43.5],
            "acd_mm": 3.1,
            "lens_thickness_mm": 4.6,
            "implant": {"residual_dpt": -0.5},
        }
        eye, time_ms = _timed_eye(body)
        error_dpt = eye.refraction_dpt + 0.5
        rows.append(
            row("pseudophakic", f"{length_mm:g} mm", "residual -0.5 dpt", [time_ms],
                 "dpt", error_dpt, "residual")
        )  # fmt: skip
    return rows


def measure(run: Run) -> list[Row]:
    """Return the rows of all persons and powers, or of a few."""
    rows = []
    for person, body in list(PERSONS.items())[: 1 if run.is_quick else None]:
        rows += _stays_rows(person, body, [*CORRECTIONS])
        rows += _refraction_rows(person, body, SURGERIES)
    rows += formula_rows(SPHERES_DPT[:1] if run.is_quick else SPHERES_DPT)
    return rows + pseudophakic_rows((23.5,) if run.is_quick else (22.0, 23.5, 26.0))
