"""The numbers of a report by name, with units, as `--json` prints them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.figures import (
    DrawnPeople,
    EyeStudy,
    PupilWavefront,
    acuity_log_mar,
    rms_by_order_um,
)
from clients.figures.orders import rms_um
from clients.figures.study import FIELD_H_DEG, PUPILS_MM, WAVELENGTH_NM
from clients.figures.transfer_curves import FREQUENCY_CPD
from estimator import (
    EyeProfile,
    Prescription,
    chromatic_refraction_dpt,
    nm_from_index,
    percentiles_of,
    power_vector,
    power_vector_from_zernike,
    prescription_from_power_vector,
    rescale_pupil,
)

PRESCRIBED_PUPIL_MM = 4.0
"""Pupil of reported refractions, unless the measured pupil is smaller."""

SPECTACLE_VERTEX_MM = 12.0
"""Usual distance of spectacles from the cornea."""

REPORTED_CPD = (10.0, 20.0, 30.0)
REPORTED_FIELD_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)


@dataclass(frozen=True)
class Refraction:
    """Refraction at the cornea: power vector and minus cylinder, dpt; axis in deg."""

    m_dpt: float
    j0_dpt: float
    j45_dpt: float

    @property
    def prescription(self) -> Prescription:
        """Return the prescription in minus cylinder, axis as seen by the examiner."""
        return prescription_from_power_vector(self.m_dpt, self.j0_dpt, self.j45_dpt)

    def format_prescription(self) -> str:
        """Return the prescription in the usual notation."""
        return format_prescription(self.prescription)

    def as_mapping(self) -> dict[str, float]:
        """Return all numbers as a mapping."""
        lens = self.prescription
        return {
            "sphere_dpt": lens.sphere_dpt,
            "cylinder_dpt": lens.cylinder_dpt,
            "axis_deg": lens.axis_deg,
            "M_dpt": self.m_dpt,
            "J0_dpt": self.j0_dpt,
            "J45_dpt": self.j45_dpt,
        }


def format_prescription(lens: Prescription) -> str:
    """Return a lens in the usual notation: sphere, cylinder, axis."""
    text = f"{_signed(lens.sphere_dpt)} dpt sph"
    if abs(lens.cylinder_dpt) >= 0.005:
        text += f" {_signed(lens.cylinder_dpt)} cyl x {lens.axis_deg:.0f}°"
    return text


def spectacles_for(refraction: Mapping[str, float]) -> Prescription:
    """Return spectacles at `SPECTACLE_VERTEX_MM` for a refraction at the cornea."""
    sphere_dpt = refraction["sphere_dpt"]
    powers_dpt = [
        power_dpt / (1.0 + SPECTACLE_VERTEX_MM / 1000.0 * power_dpt)
        for power_dpt in (sphere_dpt, sphere_dpt + refraction["cylinder_dpt"])
    ]
    return Prescription(
        sphere_dpt=powers_dpt[0],
        cylinder_dpt=powers_dpt[1] - powers_dpt[0],
        axis_deg=refraction["axis_deg"],
        vertex_mm=SPECTACLE_VERTEX_MM,
    )


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−") if abs(value) >= 0.005 else "0.00"


def refraction_pupil_mm(study: EyeStudy) -> float:
    """Return the pupil of reported refractions."""
    return min(PRESCRIBED_PUPIL_MM, 2.0 * study.found.zernike_radius_mm)


def refraction_of(study: EyeStudy, zernike_um: NDArray[np.float64]) -> Refraction:
    """Return the refraction of coefficients on the study's circle, at 555 nm."""
    radius_mm = study.found.zernike_radius_mm
    reported_mm = refraction_pupil_mm(study) / 2.0
    on_reported = rescale_pupil(zernike_um, radius_ratio=reported_mm / radius_mm)
    m, j0, j45 = power_vector_from_zernike(on_reported, zernike_radius_mm=reported_mm)
    measured_nm = study.found.wavelength_nm
    to_555_dpt = chromatic_refraction_dpt(WAVELENGTH_NM) - chromatic_refraction_dpt(
        measured_nm
    )
    return Refraction(m + float(to_555_dpt), j0, j45)


def worn_refraction_dpt(study: EyeStudy) -> float:
    """Return M of the relaxed eye through its correction, at its entrance pupil."""
    return float(
        study.optics.total_defocus_dpt(
            pupil_diameter_mm=refraction_pupil_mm(study),
            accommodation_dpt=0.0,
            wavelength_nm=WAVELENGTH_NM,
        )
    )


def worn_lens(profile: EyeProfile) -> Refraction | None:
    """Return the correction's power at the cornea; None without a correction."""
    if profile.correction is None:
        return None
    return Refraction(*power_vector(profile.correction))


def state_numbers(seen: PupilWavefront) -> dict[str, Any]:
    """Return the modulation transfer and acuity of a wavefront."""
    found = seen.predicted
    if found is None:
        return {
            "log_mar": None,
            "visual_strehl_ratio": None,
            "modulation": None,
            "is_told": seen.is_readable,
        }
    modulation = seen.transfer().modulation(np.array(REPORTED_CPD))
    return {
        "log_mar": found.log_mar,
        "visual_strehl_ratio": found.visual_strehl_ratio,
        "modulation": {
            f"{cpd:g}_cpd": float(v)
            for cpd, v in zip(REPORTED_CPD, modulation, strict=True)
        },
        "is_told": True,
    }


def pupil_numbers(study: EyeStudy, pupil_diameter_mm: float) -> dict[str, Any]:
    """Return the numbers of a far object through a pupil, as is and best corrected."""
    seen = study.far(pupil_diameter_mm)
    higher_um = rms_um(seen.zernike_um)
    far_dpt, near_dpt = study.optics.focus_limits_dpt(seen.circle_diameter_mm)
    return {
        "pupil_diameter_mm": seen.circle_diameter_mm,
        "is_beyond_measured": is_beyond_measured(study, seen.circle_diameter_mm),
        "higher_order_rms_um": higher_um,
        "far_point_dpt": far_dpt,
        "near_point_dpt": near_dpt,
        "as_it_is": state_numbers(seen),
        "best_corrected": state_numbers(seen.best_corrected),
    }


def is_beyond_measured(study: EyeStudy, pupil_diameter_mm: float) -> bool:
    """Return whether a pupil is wider than the measured one."""
    return pupil_diameter_mm > study.profile.max_pupil_diameter_mm + 1e-6


def chart_numbers(
    study: EyeStudy, pupil_diameter_mm: float, distance_m: float
) -> dict[str, Any]:
    """Return the predicted acuity on a chart of an eye that accommodates for it."""
    at_dpt = 1.0 / distance_m
    seen = study.wavefront(pupil_diameter_mm, object_dpt=at_dpt, focus_dpt=at_dpt)
    usable_mm = study.optics.usable_pupil_mm(pupil_diameter_mm)
    log_mar = acuity_log_mar(seen)
    return {
        "pupil_diameter_mm": usable_mm,
        "distance_m": distance_m,
        "focus_dpt": study.optics.reachable_focus_dpt(
            at_dpt, pupil_diameter_mm=usable_mm
        ),
        "log_mar": log_mar if np.isfinite(log_mar) else None,
        "is_told": seen.is_readable,
    }


def eye_numbers(study: EyeStudy) -> dict[str, Any]:
    """Return the numbers of one eye, ready for JSON."""
    profile, found = study.profile, study.found
    worn = worn_lens(profile)
    length_mm = found.eye_length_mm
    return {
        "profile": {
            "name": profile.name,
            "kind": profile.kind,
            "eye_side": profile.eye_side,
            "age_years": profile.age_years,
        },
        "measured": measured_numbers(study),
        "eye": {
            "refraction": refraction_of(study, found.zernike_um).as_mapping(),
            "mean_abs_error_um": found.mean_abs_error_um,
            "rms_error_um": float(np.linalg.norm(found.residual_um[3:])),
            "eye_length_mm": length_mm,
            "amplitude_dpt": found.amplitude_dpt,
            "refraction_through_correction_dpt": worn_refraction_dpt(study),
            "on_bound": list(found.on_bound),
        },
        "correction": worn.as_mapping() if worn else None,
        "pupils": [pupil_numbers(study, pupil_mm) for pupil_mm in PUPILS_MM],
        "field": _field_numbers(study),
        "notes": [*study.notes],
    }


def measured_numbers(study: EyeStudy) -> dict[str, Any]:
    """Return the data that the eye was estimated from, with typical aberrations."""
    by_order = rms_by_order_um(study.measured_um)
    return {
        "refraction": refraction_of(study, study.measured_um).as_mapping(),
        "refraction_pupil_mm": refraction_pupil_mm(study),
        "zernike_um": _named(study.measured_um),
        "zernike_radius_mm": study.found.zernike_radius_mm,
        "wavelength_nm": study.found.wavelength_nm,
        "rms_by_order_um": {str(n): value for n, value in by_order.items()},
        "higher_order_rms_um": rms_um(study.measured_um),
    }


def _named(zernike_um: NDArray[np.float64]) -> dict[str, float]:
    return {
        "{},{}".format(*nm_from_index(j)): value
        for j, value in enumerate(zernike_um.tolist())
        if j > 0
    }


def _field_numbers(study: EyeStudy) -> list[dict[str, float]]:
    """Return the relaxed refraction along the horizontal meridian."""
    table = study.field
    on_meridian = np.isin(table.h_deg, REPORTED_FIELD_DEG) & (table.v_deg == 0.0)
    return [
        {"h_deg": h, "v_deg": 0.0, "M_dpt": m, "J0_dpt": j0, "J45_dpt": j45}
        for h, (m, j0, j45) in zip(
            table.h_deg[on_meridian].tolist(),
            table.power_dpt[on_meridian].tolist(),
            strict=True,
        )
    ]


def people_numbers(people: DrawnPeople) -> dict[str, Any]:
    """Return the percentiles of drawn persons, ready for JSON."""
    return {
        "count": people.count,
        "pupils": [
            {
                "pupil_diameter_mm": pupil_mm,
                "higher_order_rms_um": percentiles_of(rms[:, None])[0],
                "modulation_best_corrected": {
                    f"{cpd:g}_cpd": numbers
                    for cpd, numbers in zip(
                        REPORTED_CPD,
                        percentiles_of(_at_reported_cpd(people.modulation[pupil_mm])),
                        strict=True,
                    )
                },
            }
            for pupil_mm, rms in people.higher_order_rms_um.items()
        ],
        "field": [
            {"h_deg": h_deg, "v_deg": 0.0, **numbers}
            for h_deg, numbers in zip(
                FIELD_H_DEG.tolist(), people.field.percentiles(), strict=True
            )
            if h_deg in REPORTED_FIELD_DEG
        ],
    }


def _at_reported_cpd(modulation: NDArray[np.float64]) -> NDArray[np.float64]:
    return modulation[:, np.isin(FREQUENCY_CPD, REPORTED_CPD)]
