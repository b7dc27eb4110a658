"""The content of a report on one eye, computed before it is written.

Numbers are named with their units, as `--json` prints them.  Letter charts as the eye
sees them near and far are filtered by an `EyeFilter`.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.acuity_text import Notation
from clients.figures import (
    DrawnPeople,
    EyeStudy,
    PupilWavefront,
    acuity_log_mar,
    drawn_people,
    rms_by_order_um,
)
from clients.figures.curves import FREQUENCY_CPD
from clients.figures.study import (
    FIELD_H_DEG,
    PUPILS_MM,
    WAVELENGTH_NM,
    Profile,
    ProgressCallback,
)
from clients.figures.wavefront import ARCMIN_PER_MRAD, ray_directions_mrad, rms_um
from clients.scenes.letter_chart import letter_chart
from estimator import (
    EyeProfile,
    Prescription,
    chromatic_refraction_dpt,
    eye_biometry,
    nm_from_index,
    percentiles_of,
    power_vector,
    power_vector_from_zernike,
    prescription_from_power_vector,
    rescale_pupil,
)
from estimator.bounded_files import printable
from filter_service import Camera, EyeFilter, FilterError, FilterSettings

SIDE_NAMES = {"OD": "right eye", "OS": "left eye"}
ORDINALS = ("first", "second")

MAX_TEXT_LENGTH = 60
"""Maximum length of a text, so that all texts fit in the page margin."""

JOINERS = "\u200c\u200d"
"""Invisible characters that some scripts need."""

PRESCRIBED_PUPIL_MM = 4.0
"""Pupil of reported refractions, unless the measured pupil is smaller."""

SPECTACLE_VERTEX_MM = 12.0
"""Usual distance of spectacles from the cornea."""

REPORTED_CPD = (10.0, 20.0, 30.0)
REPORTED_FIELD_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
DISTANCES_M = (0.4, 1.0, 6.0)
FIELD_DEG = 8.2
LOG_MAR = tuple(round(1.0 - 0.1 * k, 1) for k in range(13))
SIDE_PX, LEAST_SIDE_PX = 860, 180
LARGEST_BLUR_PX = 190.0
"""Largest blur radius that PSFs are computed for, with a margin for the edge."""

Chart = tuple[float, float]
"""Pupil, mm, and distance, m."""

NUMBERS_START_FRACTION, CHARTS_START_FRACTION = 0.1, 0.5
"""Progress fractions at which numbers and charts begin."""

PEOPLE_START_FRACTION = 0.5
"""Progress fraction at which drawn persons begin, after everything else."""


def check_text(field: str, text: str) -> None:
    """Reject a text that cannot be printed in one line of the page margin.

    Raises
    ------
    ValueError
        If it is too long, or contains a line break or another control character.
    """
    if len(text) > MAX_TEXT_LENGTH:
        raise ValueError(
            f"{field} has {len(text)} characters; allowed: at most {MAX_TEXT_LENGTH}"
        )
    for character in text:
        is_space = unicodedata.category(character) == "Zs"  # also wide ones
        if not (character.isprintable() or is_space or character in JOINERS):
            raise ValueError(
                f"{field} contains {character!a}; allowed: printable characters"
            )


def shortened(name: str) -> str:
    """Return the name of a profile or file as a text that fits."""
    return printable(printable(name), most=MAX_TEXT_LENGTH)


def own_name(profile: EyeProfile) -> str:
    """Return a profile's name, shortened; empty if it has none."""
    return "" if profile.name == profile.kind else shortened(profile.name)


def distinct_labels(labels: tuple[str, str], sides: tuple[str, str]) -> tuple[str, str]:
    """Return two labels that differ: by side if the sides differ, otherwise by order.

    Parameters
    ----------
    labels : (str, str)
        Names of the eyes; empty for an eye without a name.
    sides : (str, str)
        OD or OS.
    """
    differ = sides[0] != sides[1]
    names = [
        label or (SIDE_NAMES[side] if differ else f"{ordinal} eye")
        for label, side, ordinal in zip(labels, sides, ORDINALS, strict=True)
    ]
    if names[0] == names[1]:
        marks = [SIDE_NAMES[side] for side in sides] if differ else ORDINALS
        names = [f"{name} ({mark})" for name, mark in zip(names, marks, strict=True)]
    return names[0], names[1]


def refraction_numbers(m_dpt: float, j0_dpt: float, j45_dpt: float) -> dict[str, float]:
    """Return a refraction, dpt, also in minus cylinder, axis as the examiner sees."""
    lens = prescription_from_power_vector(m_dpt, j0_dpt, j45_dpt)
    return {
        "sphere_dpt": lens.sphere_dpt,
        "cylinder_dpt": lens.cylinder_dpt,
        "axis_deg": lens.axis_deg,
        "M_dpt": m_dpt,
        "J0_dpt": j0_dpt,
        "J45_dpt": j45_dpt,
    }


def format_prescription(lens: Prescription) -> str:
    """Return a lens in the usual notation: sphere, cylinder, axis."""
    text = f"{signed(lens.sphere_dpt)} dpt sph"
    if abs(lens.cylinder_dpt) >= 0.005:
        text += f" {signed(lens.cylinder_dpt)} cyl x {lens.axis_deg:.0f}°"
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


def signed(value: float) -> str:
    """Return a number with its sign, rounded to a hundredth."""
    return f"{value:+.2f}".replace("-", "−") if abs(value) >= 0.005 else "0.00"


def refraction_pupil_mm(study: EyeStudy) -> float:
    """Return the pupil of reported refractions."""
    return min(PRESCRIBED_PUPIL_MM, 2.0 * study.found.zernike_radius_mm)


def refraction_of(study: EyeStudy, zernike_um: NDArray[np.float64]) -> dict[str, float]:
    """Return the refraction of coefficients on the study's circle, at 555 nm."""
    radius_mm = study.found.zernike_radius_mm
    reported_mm = refraction_pupil_mm(study) / 2.0
    on_reported = rescale_pupil(zernike_um, radius_ratio=reported_mm / radius_mm)
    m, j0, j45 = power_vector_from_zernike(on_reported, zernike_radius_mm=reported_mm)
    measured_nm = study.found.wavelength_nm
    to_555_dpt = chromatic_refraction_dpt(WAVELENGTH_NM) - chromatic_refraction_dpt(
        measured_nm
    )
    return refraction_numbers(m + float(to_555_dpt), j0, j45)


def state_numbers(seen: PupilWavefront, notation: Notation) -> dict[str, Any]:
    """Return the modulation transfer and acuity of a wavefront."""
    found = seen.predicted
    if found is None:
        return {
            "log_mar": None,
            "notation": notation,
            "visual_strehl_ratio": None,
            "modulation": None,
            "is_told": seen.is_readable,
        }
    modulation = seen.transfer().modulation(np.array(REPORTED_CPD))
    return {
        "log_mar": found.log_mar,
        "notation": notation,
        "visual_strehl_ratio": found.visual_strehl_ratio,
        "modulation": {
            f"{cpd:g}_cpd": float(v)
            for cpd, v in zip(REPORTED_CPD, modulation, strict=True)
        },
        "is_told": True,
    }


def pupil_numbers(
    study: EyeStudy, pupil_diameter_mm: float, notation: Notation
) -> dict[str, Any]:
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
        "as_it_is": state_numbers(seen, notation),
        "best_corrected": state_numbers(seen.best_corrected, notation),
    }


def is_beyond_measured(study: EyeStudy, pupil_diameter_mm: float) -> bool:
    """Return whether a pupil is wider than the measured one."""
    return pupil_diameter_mm > study.profile.max_pupil_diameter_mm + 1e-6


def chart_numbers(
    study: EyeStudy,
    pupil_diameter_mm: float,
    distance_m: float,
    notation: Notation = "decimal",
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
        "notation": notation,
        "is_told": seen.is_readable,
    }


def eye_numbers(study: EyeStudy, notation: Notation = "decimal") -> dict[str, Any]:
    """Return the numbers of one eye, ready for JSON."""
    profile, found = study.profile, study.found
    worn = profile.correction
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
            "refraction": refraction_of(study, found.zernike_um),
            "mean_abs_error_um": found.mean_abs_error_um,
            "rms_error_um": float(np.linalg.norm(found.residual_um[3:])),
            "eye_length_mm": length_mm,
            **_biometry_numbers(study),
            "amplitude_dpt": found.amplitude_dpt,
            # M of the relaxed eye through its correction, at its entrance pupil
            "refraction_through_correction_dpt": float(
                study.optics.total_defocus_dpt(
                    pupil_diameter_mm=refraction_pupil_mm(study),
                    accommodation_dpt=0.0,
                    wavelength_nm=WAVELENGTH_NM,
                )
            ),
            "on_bound": list(found.on_bound),
        },
        "correction": None if worn is None else refraction_numbers(*power_vector(worn)),
        "pupils": [pupil_numbers(study, mm, notation) for mm in PUPILS_MM],
        "field": _field_numbers(study),
        "notes": [*study.notes],
    }


def _biometry_numbers(study: EyeStudy) -> dict[str, dict[str, float]]:
    """Return lengths and powers; empty for eyes with other surfaces."""
    try:
        return {"biometry": asdict(eye_biometry(study.found.relaxed))}
    except ValueError:
        return {}


def measured_numbers(study: EyeStudy) -> dict[str, Any]:
    """Return the data that the eye was estimated from, with typical aberrations."""
    by_order = rms_by_order_um(study.measured_um)
    return {
        "refraction": refraction_of(study, study.measured_um),
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
    at_reported = np.isin(FREQUENCY_CPD, REPORTED_CPD)
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
                        percentiles_of(people.modulation[pupil_mm][:, at_reported]),
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


def charts_of(
    study: EyeStudy,
    *,
    pupils_mm: Sequence[float] = PUPILS_MM,
    distances_m: Sequence[float] = DISTANCES_M,
    progress: Callable[[float], None] | None = None,
) -> dict[Chart, NDArray[np.uint8]]:
    """Return the chart for each pupil and distance, with the eye focusing on it.

    The filters of a process share one worker: call from one thread at a time.

    Raises
    ------
    FilterError
        If no engine works here, or the eye's blur is wider than the largest PSF.
    """
    side_px = picture_side_px(study, max(pupils_mm), distances_m)
    camera = Camera.from_fov(FIELD_DEG, width_px=side_px, height_px=side_px)
    views = {
        d: letter_chart(camera, distance_m=d, log_mar=LOG_MAR).view for d in distances_m
    }
    found: dict[Chart, NDArray[np.uint8]] = {}
    with EyeFilter(camera=camera) as eye_filter:
        for pupil_mm in pupils_mm:
            settings = _settings(pupil_mm, distances_m)
            eye_filter.set_profile(study.profile, settings=settings, views=camera)
            eye_filter.wait()
            for distance_m, view in views.items():
                seen = eye_filter.filter(
                    view, pupil_diameter_mm=pupil_mm, focus_dpt=1.0 / distance_m
                )
                found[pupil_mm, distance_m] = seen.color
                if progress is not None:
                    progress(len(found) / (len(pupils_mm) * len(views)))
    return found


@cache
def chart_rows() -> tuple[tuple[float, float], ...]:
    """Return the size of each row, logMAR, and its height in the image, 0 to 1."""
    camera = Camera.from_fov(FIELD_DEG, width_px=LEAST_SIDE_PX, height_px=LEAST_SIDE_PX)
    chart = letter_chart(camera, distance_m=1.0, log_mar=LOG_MAR)
    return tuple((row.log_mar, row.y_px / LEAST_SIDE_PX) for row in chart.rows)


def _settings(pupil_mm: float, distances_m: Sequence[float]) -> FilterSettings:
    at_dpt = tuple(sorted(1.0 / d for d in distances_m))
    return FilterSettings(
        mode="on-axis",  # a chart lies within 4 deg
        pupil_range_mm=(pupil_mm, pupil_mm),
        focus_range_dpt=(at_dpt[0], at_dpt[-1]),
        object_planes_dpt=at_dpt,
    )


def picture_side_px(
    study: EyeStudy, pupil_mm: float, distances_m: Sequence[float]
) -> int:
    """Return the image size that the widest blur allows: blurred images need few px."""
    reach_mrad = 0.0
    for distance_m in distances_m:
        at_dpt = 1.0 / distance_m
        seen = study.wavefront(pupil_mm, object_dpt=at_dpt, focus_dpt=at_dpt)
        slopes = np.linalg.norm(ray_directions_mrad(seen), axis=1)
        aside_mrad = 0.0
        if seen.rings is not None:
            radius_mm = seen.circle_diameter_mm / 2.0
            aside_mrad = float(seen.rings.reach_mrad(radius_mm, seen.wavelength_nm))
        reach_mrad = max(reach_mrad, float(slopes.max()) + aside_mrad)
    reach_arcmin = max(reach_mrad * ARCMIN_PER_MRAD, 1e-6)
    fitting = math.floor(LARGEST_BLUR_PX * FIELD_DEG * 60.0 / reach_arcmin)
    return max(min(SIDE_PX, fitting), LEAST_SIDE_PX)


@dataclass(frozen=True)
class EyeFacts:
    """One eye's study, numbers and images.

    Attributes
    ----------
    label : str
        Name of the eye in this report; empty if it has none.
    charts : dict
        Images (height, width, 3) by pupil, mm, and distance, m.  Empty if they could
        not be computed; ``chart_problem`` gives the reason.
    people : DrawnPeople or None
        Persons drawn from the population, if requested.
    notation : Notation
        Of acuities, beside logMAR.
    """

    study: EyeStudy
    label: str
    numbers: dict[str, Any]
    charts: dict[Chart, NDArray[np.uint8]] = field(default_factory=dict)
    chart_problem: str = ""
    people: DrawnPeople | None = None
    notation: Notation = "decimal"

    @property
    def chart_numbers(self) -> dict[Chart, dict[str, Any]]:
        """Return the predicted numbers of each chart."""
        return {
            (asked_mm, entry["distance_m"]): entry
            for asked_mm, entry in zip(
                np.repeat(PUPILS_MM, len(DISTANCES_M)).tolist(),
                self.numbers["charts"],
                strict=True,
            )
        }


def facts_of(
    profile: Profile,
    *,
    label: str = "",
    has_charts: bool = True,
    people: int | None = None,
    notation: Notation = "decimal",
    progress: ProgressCallback | None = None,
) -> EyeFacts:
    """Compute the content of a report on an eye.

    Parameters
    ----------
    label : str
        Name to use instead of the profile's.
    has_charts : bool
        Whether to filter letter charts (about a quarter of the run time).
    people : int, optional
        Number of persons to draw from the population.
    notation : {"decimal", "feet", "meters", "log_mar"}
        Notation of acuities, beside logMAR.
    progress : callable, optional
        Called with a fraction and a stage.

    Raises
    ------
    ValueError
        If the profile is invalid, no light passes through the eye, or there is nothing
        to draw.
    """
    report = progress or (lambda fraction, stage: None)
    eye_share = 1.0 if people is None else PEOPLE_START_FRACTION
    charts_start = eye_share * CHARTS_START_FRACTION
    report(0.0, "eye")
    study = EyeStudy.of(profile)
    report(eye_share * NUMBERS_START_FRACTION, "numbers")
    numbers = eye_numbers(study, notation)
    numbers["charts"] = [
        chart_numbers(study, pupil_mm, distance_m, notation)
        for pupil_mm in PUPILS_MM
        for distance_m in DISTANCES_M
    ]
    charts, problem = {}, "" if has_charts else "not requested"
    if has_charts:
        report(charts_start, "letter charts")
        share = eye_share - charts_start
        try:
            charts = charts_of(
                study,
                progress=lambda done: report(
                    charts_start + share * done, "letter charts"
                ),
            )
        except FilterError as error:  # the report is useful without them
            problem = str(error)
    drawn = None
    if people is not None:
        drawn = drawn_people(
            study,
            people,
            progress=lambda done: report(
                eye_share + (1.0 - eye_share) * done, "drawn persons"
            ),
        )
        numbers["people"] = people_numbers(drawn)
    return EyeFacts(
        study,
        label or own_name(study.profile),
        numbers,
        charts,
        problem,
        drawn,
        notation,
    )
