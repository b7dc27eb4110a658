"""The tables of a report: refraction, vision, field, coefficients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from clients.acuity_text import Notation
from clients.acuity_text import acuity_text as acuity_in
from clients.figures.study import WAVELENGTH_NM
from clients.report.facts import (
    SPECTACLE_VERTEX_MM,
    EyeFacts,
    format_prescription,
    signed,
    spectacles_for,
)
from clients.report.html_page import Table
from clients.report.text import entered_text, short_text, um_text
from estimator import EyeProfile, EyeWithImplant, WornLens

N_COLUMNS, N_JOINT_COLUMNS = 4, 3
"""Columns of the coefficients of one eye, and of two."""

COEFFICIENTS_TITLE = "Coefficients, µm (OSA; x to the person's right, y up)"

RANGE_NAME = "median (5th to 95th percentile)"

UNKNOWN_ACUITY = "not known"
"""Text in place of an acuity through lenslets; the summary gives the reason."""

REFRACTION_ROWS = {
    "sphere, dpt": "sphere_dpt",
    "cylinder, dpt": "cylinder_dpt",
    "axis, deg": "axis_deg",
    "M, dpt": "M_dpt",
    "J0, dpt": "J0_dpt",
    "J45, dpt": "J45_dpt",
}


def refraction_text(refraction: dict[str, Any], name: str) -> str:
    """Return one number of a refraction as text."""
    if name != "axis_deg":
        return signed(refraction[name])
    has_axis = abs(refraction["cylinder_dpt"]) >= 0.005
    return f"{refraction[name]:.0f}" if has_axis else "–"


def refraction_table(facts: EyeFacts) -> Table:
    """Return the refraction entered or measured, and of the estimated eye."""
    numbers = facts.numbers
    pairs = numbers["measured"]["refraction"], numbers["eye"]["refraction"]
    return Table(
        "Refraction",
        tuple(
            (label, *(refraction_text(pair, name) for pair in pairs))
            for label, name in REFRACTION_ROWS.items()
        ),
        head=(
            "at the cornea, 555 nm",
            facts.study.source_label,
            "estimated",
        ),
        note=_refraction_note(facts),
    )


def _refraction_note(facts: EyeFacts) -> str:
    numbers, fit = facts.numbers, facts.numbers["eye"]
    entered = entered_text(facts.study.profile)
    note = (
        f"{entered}{' ' if entered else ''}{spectacles_text(facts)}. "
        f"{numbers['measured']['refraction_pupil_mm']:.3g} mm pupil, relaxed, without "
        f"correction. The estimated eye is {fit['eye_length_mm']:.2f} mm long and "
        f"misses the wavefront by {um_text(fit['rms_error_um'])} RMS."
    )
    light_nm = facts.study.found.wavelength_nm
    if light_nm != WAVELENGTH_NM:
        note += f" Measured at {light_nm:g} nm, moved to 555 nm by the eye's color."
    if facts.study.profile.correction is not None:
        note += (
            " M through the worn correction: "
            f"{signed(fit['refraction_through_correction_dpt'])} dpt."
        )
    return note


def spectacles_text(facts: EyeFacts) -> str:
    """Return the spectacles that correct an eye."""
    lens = spectacles_for(facts.numbers["eye"]["refraction"])
    return f"As spectacles at {SPECTACLE_VERTEX_MM:g} mm: {format_prescription(lens)}"


def change_text(before: float, after: float) -> str:
    """Return the difference of two numbers as they are shown."""
    return signed(round(after, 2) - round(before, 2))


def vision_table(facts: EyeFacts) -> Table:
    """Return the vision through both pupils, as it is and best corrected."""
    pupils = facts.numbers["pupils"]
    rows = [
        (label, *(vision_cell(label, pupil, facts) for pupil in pupils))
        for label in VISION_ROWS
    ]
    note = vision_note(pupils, facts.notation)
    drawn = facts.numbers.get("people", {"pupils": []})
    if drawn["pupils"]:
        texts = (range_text(p["higher_order_rms_um"]) for p in drawn["pupils"])
        rows.insert(1, ("the same, drawn persons", *texts))
        note += f" Drawn persons: {RANGE_NAME} of {drawn['count']}."
    return Table(
        "Vision on the axis",
        tuple(rows),
        head=("far object, 555 nm", *(pupil_text(p) for p in pupils)),
        note=note,
    )


def vision_note(pupils: list[dict[str, Any]], notation: Notation) -> str:
    """Return the note below numbers of vision through some pupils."""
    note = (
        f"Acuity in {NOTATION_WORDS[notation]}, in white light. Higher orders: in the "
        "entrance pupil; maps and bars show them at the cornea. Accommodation: change "
        "of the sharpest distance through that pupil and the correction; the amplitude "
        "in “What is known” is that of the eye alone."
    )
    if any(p["is_beyond_measured"] for p in pupils):
        note += " * wider than the pupil measured: see “What is known”."
    return note


def distance_text(distance_dpt: float) -> str:
    """Return a far or near point in dpt, and as a distance."""
    if abs(distance_dpt) < 0.02:
        return "infinity"
    if distance_dpt < 0.0:
        return f"{signed(distance_dpt)} (behind)"
    distance_m = 1.0 / distance_dpt
    where = f"{100 * distance_m:.0f} cm" if distance_m < 1.0 else f"{distance_m:.1f} m"
    return f"{distance_dpt:.2f} ({where})"


NOTATION_WORDS: dict[Notation, str] = {
    "decimal": "logMAR and decimal",
    "feet": "logMAR and as 20/20",
    "meters": "logMAR and as 6/6",
    "log_mar": "logMAR",
}
NEAR_POINT, SEVERAL_FOCI = "near point, dpt", "several foci"
LEAST_RATIO = 0.0005
"""Smallest visual Strehl ratio that three decimals show."""

VISION_ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "higher orders, RMS, µm": lambda p: f"{p['higher_order_rms_um']:.2f}",
    "acuity as it is": lambda p: acuity_text(p["as_it_is"]),
    "acuity best corrected": lambda p: acuity_text(p["best_corrected"]),
    "visual Strehl as it is": lambda p: _ratio(p["as_it_is"]["visual_strehl_ratio"]),
    "visual Strehl corrected": lambda p: _ratio(
        p["best_corrected"]["visual_strehl_ratio"]
    ),
    "MTF 10 / 30 cpd, corrected": lambda p: _modulations(
        p["best_corrected"]["modulation"]
    ),
    "far point, dpt": lambda p: distance_text(p["far_point_dpt"]),
    NEAR_POINT: lambda p: distance_text(p["near_point_dpt"]),
    "accommodation, dpt": lambda p: f"{p['near_point_dpt'] - p['far_point_dpt']:.1f}",
}


def pupil_text(pupil: dict[str, Any]) -> str:
    """Return a pupil, with a star if it is wider than the measured one."""
    star = "*" if pupil["is_beyond_measured"] else ""
    return f"{pupil['pupil_diameter_mm']:.3g} mm{star}"


def _ratio(value: float | None) -> str:
    """Return a visual Strehl ratio, which under strong blur is near 0 or negative."""
    if value is None:
        return "–"
    return "< 0.001" if value < LEAST_RATIO else f"{value:.3f}"


def _modulations(values: dict[str, Any] | None) -> str:
    if values is None:
        return "–"
    return f"{values['10_cpd']:.2f} / {values['30_cpd']:.2f}"


def acuity_text(state: dict[str, Any]) -> str:
    """Return the acuity of a state, or that it is not known."""
    if not state["is_told"]:
        return UNKNOWN_ACUITY
    if state["log_mar"] is None:
        return "worse than 2"
    log_mar, notation = state["log_mar"], state["notation"]
    text = f"{log_mar:+.2f}".replace("-", "−")
    return text if notation == "log_mar" else f"{text} ({acuity_in(log_mar, notation)})"


def coefficient_table(
    eyes: Sequence[EyeFacts], names: Sequence[str] = ("µm",)
) -> Table:
    """Return all coefficients of one eye in four columns, or of two in three."""
    measured = [facts.numbers["measured"] for facts in eyes]
    n_columns = N_COLUMNS if len(eyes) == 1 else N_JOINT_COLUMNS
    cells = [
        (
            _term_text(term),
            *(
                f"{m['zernike_um'].get(term, 0.0):+.4f}".replace("-", "−")
                for m in measured
            ),
        )
        for term in dict.fromkeys(term for m in measured for term in m["zernike_um"])
    ]
    notes = [*dict.fromkeys(map(_circle_text, measured))]
    if len(notes) > 1:
        notes = [f"{name}: {note}" for name, note in zip(names, notes, strict=True)]
    return Table(
        COEFFICIENTS_TITLE,
        _side_by_side(cells, n_columns),
        head=("n, m", *names) * n_columns,
        note=" ".join(notes),
    )


def _term_text(name: str) -> str:
    return f"({name.replace(',', ', ')})".replace("-", "−")


def _side_by_side(
    cells: Sequence[tuple[str, ...]], n_columns: int
) -> tuple[tuple[str, ...], ...]:
    n_rows = -(-len(cells) // n_columns)
    return tuple(
        tuple(text for cell in cells[k::n_rows] for text in cell) for k in range(n_rows)
    )


def _circle_text(measured: dict[str, Any]) -> str:
    radius_mm, light_nm = measured["zernike_radius_mm"], measured["wavelength_nm"]
    return (
        f"At the cornea, on a circle of {2 * radius_mm:.3g} mm, {light_nm:g} nm; "
        f"higher orders {measured['higher_order_rms_um']:.3f} µm RMS."
    )


def through_text(profile: EyeProfile) -> str:
    """Return whether a refraction is that of the eye or through what it wears."""
    lens = profile.correction
    if isinstance(lens, WornLens) and lens.kind == "iol":
        return "with the implant"
    if profile.surgery is not None:
        return "after surgery"
    if isinstance(lens, WornLens) and lens.kind == "lenslets":
        return "through the spectacles without their lenslets"
    return "without a correction" if lens is None else f"through the {short_text(lens)}"


def field_table_block(facts: EyeFacts, *, name: str = "") -> Table:
    """Return the refraction along the horizontal meridian."""
    rows = tuple(
        (
            _angle_text(entry["h_deg"]),
            signed(entry["M_dpt"]),
            signed(entry["J0_dpt"]),
        )
        for entry in facts.numbers["field"]
    )
    return Table(
        f"Along the horizontal{f' ({name})' if name else ''}, "
        f"{through_text(facts.study.profile)}",
        rows,
        head=("h, deg", "M, dpt", "J0, dpt"),
        note="Relaxed, 4 mm pupil, at the cornea; h to the person's right.",
    )


def people_table(facts: EyeFacts) -> Table:
    """Return the refraction of drawn persons along the horizontal meridian."""
    drawn = facts.numbers["people"]
    return Table(
        f"{drawn['count']} drawn persons along the horizontal",
        tuple(
            (
                _angle_text(entry["h_deg"]),
                range_text(entry["M_dpt"], signed),
                range_text(entry["J0_dpt"], signed),
            )
            for entry in drawn["field"]
        ),
        head=("h, deg", "M, dpt", "J0, dpt"),
        note=f"{RANGE_NAME.capitalize()}. Relaxed, 4 mm pupil, at the cornea.",
    )


def range_text(
    percentiles: dict[str, float],
    format_value: Callable[[float], str] = "{:.2f}".format,
) -> str:
    """Return the median, and the 5th to 95th percentile in parentheses."""
    low, median, high = (format_value(percentiles[name]) for name in ("5", "50", "95"))
    return f"{median} ({low} to {high})"


def _angle_text(h_deg: float) -> str:
    return f"{h_deg:+.0f}".replace("-", "−") if h_deg else "0"


LENS_ROWS = ("chamber_depth_mm", "lens_thickness_mm", "lens_power_dpt")
BIOMETRY_ROWS = {
    "axial_length_mm": "length, mm",
    "keratometry_dpt": "K, dpt",
    "chamber_depth_mm": "chamber, mm",
    "lens_thickness_mm": "lens thickness, mm",
    "lens_power_dpt": "lens power, dpt",
}


def biometry_table(eyes: Sequence[EyeFacts], moments: Sequence[str]) -> Table:
    """Return lengths and powers of two eyes, and their change."""
    names = BIOMETRY_ROWS
    both = [_known_biometry(facts) for facts in eyes]
    rows = [
        (moment, *(f"{found[name]:.2f}" if name in found else "–" for name in names))
        for moment, found in zip(moments, both, strict=True)
    ]
    changes = (
        change_text(both[0][name], both[1][name])
        if all(name in found for found in both)
        else ""
        for name in names
    )
    label = ""
    if any(isinstance(facts.study.found, EyeWithImplant) for facts in eyes):
        label = (
            " The power of an implant above is the labeled one, which refers to an "
            "aqueous of index 1.336 (ISO 11979-2)."
        )
    return Table(
        "Lengths and powers of the estimated eyes",
        (*rows, ("change", *changes)),
        head=("", *BIOMETRY_ROWS.values()),
        note="K of the front of the cornea, index 1.3375; chamber from the front of "
        f"the cornea to the lens or implant; lens power in the eye, at 555 nm.{label}",
    )


def _known_biometry(facts: EyeFacts) -> dict[str, float]:
    """Return lengths and powers without those of a lens that an implant replaced.

    The model of an eye with an implant that acts as a phase has its natural lens.
    """
    found: dict[str, float] = facts.numbers["eye"]["biometry"]
    lens = facts.study.profile.correction
    is_replaced = isinstance(lens, WornLens) and lens.replaces_lens
    if not is_replaced or isinstance(facts.study.found, EyeWithImplant):
        return found
    return {name: value for name, value in found.items() if name not in LENS_ROWS}


def vision_cell(label: str, pupil: dict[str, Any], facts: EyeFacts) -> str:
    """Return a value of `VISION_ROWS` of an eye; several foci have no near point."""
    rings = facts.study.optics.rings
    if label == NEAR_POINT and rings is not None and rings.lattice_mm is None:
        return SEVERAL_FOCI
    return VISION_ROWS[label](pupil)
