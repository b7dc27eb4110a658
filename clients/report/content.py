"""The report of one eye: a page to read first, then the details."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from matplotlib.figure import FigureBase

from clients.figures import (
    EyeStudy,
    draw_cross_section,
    draw_field_maps,
    draw_mtf,
    draw_psfs,
    draw_rms_by_order,
    draw_terms,
    draw_through_focus_acuity,
    draw_wavefront_maps,
)
from clients.figures.study import PUPILS_MM, WAVELENGTH_NM
from clients.report.blocks import (
    Block,
    Document,
    Picture,
    Plot,
    Row,
    Section,
    Table,
    Words,
)
from clients.report.charts import DISTANCES_M
from clients.report.facts import EyeFacts
from clients.report.numbers import SPECTACLE_VERTEX_MM, spectacles_for, written
from clients.report.provenance import provenance_table
from clients.report.sources import Citations

DAY_MM, DUSK_MM = PUPILS_MM

MAP_MM, PSF_MM = 47.0, 57.0
"""Heights at which the first page holds all that belongs on it."""

FIELD_MM, CURVE_MM, TERMS_MM = 84.0, 68.0, 42.0
SIDES = {"OD": "right eye (OD)", "OS": "left eye (OS)"}
NOT_A_DEVICE = (
    "A simulation for research and explanation, not a medical device: no diagnosis or "
    "treatment may rest on it."
)


def eye_document(facts: EyeFacts) -> Document:
    """Return the report of one eye."""
    cite = Citations()
    cite("csoba", "osa", "vectors")
    return Document(
        title=f"Eye report: {facts.label}",
        subtitle=subtitle(facts.study),
        sections=(summary(facts), *details(facts, cite), sources(cite)),
        footer=NOT_A_DEVICE,
    )


def subtitle(study: EyeStudy) -> str:
    """Return whose eye it is, in a line."""
    profile = study.profile
    age = "age not given"
    if profile.age_years is not None:
        age = f"{profile.age_years:g} years"
    return f"{SIDES[profile.eye_side]}, {age}, from a {KIND_WORDS[profile.kind]}"


KIND_WORDS = {
    "prescription": "prescription",
    "zernike": "measured wavefront",
    "zernike_set": "set of measured wavefronts",
    "eye": "given eye model",
}


def summary(facts: EyeFacts) -> Section:
    """Return what one reads first."""
    study = facts.study
    maps = Plot(
        lambda panel: draw_wavefront_maps(panel, study),
        MAP_MM,
        "Maps of the wavefront over the pupil, all and higher orders",
    )
    orders = on_axes(
        lambda axes: draw_rms_by_order(axes, [study]),
        MAP_MM,
        "Root mean square of the wavefront by radial order",
    )
    points = Plot(
        lambda panel: draw_psfs(panel, study),
        PSF_MM,
        "Point-spread functions through 3 and 5 mm, as it is and best corrected",
    )
    contrast = on_axes(
        lambda axes: draw_mtf(axes, study),
        PSF_MM,
        "Modulation transfer functions through 3 and 5 mm",
    )
    return Section(
        "Summary",
        (
            Row((refraction_table(facts), vision_table(facts))),
            Row((maps, orders), (2.0, 1.0)),
            Row((points, contrast), (1.0, 1.4)),
            chart_row(facts, DAY_MM),
            Row((Words((_legend(study),)),)),
        ),
    )


def _legend(study: EyeStudy) -> str:
    return (
        "Wavefront at the cornea, without a correction, as the examiner faces the eye "
        "(T temporal, N nasal). Point images and charts as the person sees them; light "
        "on a logarithmic scale of two decades. “As it is”: looking far away, "
        "accommodating where that helps"
        + (", through the worn correction" if study.profile.correction else "")
        + ". “Best corrected”: sphere and cylinder of that pupil taken off. Charts: "
        "letters of logMAR 1.0 to −0.2, the eye trying to focus on each."
    )


def on_axes(draw: Callable[[Any], None], height_mm: float, alt: str) -> Plot:
    """Return a plot of one pair of axes."""

    def draw_panel(panel: FigureBase) -> None:
        draw(panel.subplots())

    return Plot(draw_panel, height_mm, alt)


REFRACTION_ROWS = {
    "sphere, dpt": "sphere_dpt",
    "cylinder, dpt": "cylinder_dpt",
    "axis, deg": "axis_deg",
    "M, dpt": "M_dpt",
    "J0, dpt": "J0_dpt",
    "J45, dpt": "J45_dpt",
}


def refraction_words(refraction: dict, name: str) -> str:
    """Return one number of a refraction as it is written."""
    if name != "axis_deg":
        return signed(refraction[name])
    has_axis = abs(refraction["cylinder_dpt"]) >= 0.005
    return f"{refraction[name]:.0f}" if has_axis else "–"


def refraction_table(facts: EyeFacts) -> Table:
    """Return the refraction that came in, and that of the eye found."""
    numbers = facts.numbers
    is_entered = facts.study.profile.kind in ("prescription", "eye")
    pairs = numbers["measured"]["refraction"], numbers["eye"]["refraction"]
    return Table(
        "Refraction",
        tuple(
            (word, *(refraction_words(pair, name) for pair in pairs))
            for word, name in REFRACTION_ROWS.items()
        ),
        head=(
            "at the cornea, 555 nm",
            "entered" if is_entered else "measured",
            "eye found",
        ),
        note=_refraction_note(facts),
    )


def _refraction_note(facts: EyeFacts) -> str:
    numbers, fit = facts.numbers, facts.numbers["eye"]
    note = (
        f"{numbers['measured']['refraction_pupil_mm']:.3g} mm pupil, relaxed, without "
        f"correction. The eye found is {fit['eye_length_mm']:.2f} mm long, "
        f"accommodates {fit['amplitude_dpt']:.1f} dpt, and misses the wavefront by "
        f"{fit['rms_error_um']:.1g} µm RMS. As spectacles at "
        f"{SPECTACLE_VERTEX_MM:g} mm: "
        f"{written(spectacles_for(numbers['eye']['refraction']))}."
    )
    light_nm = facts.study.found.wavelength_nm
    if light_nm != WAVELENGTH_NM:
        note += f" Measured at {light_nm:g} nm, moved to 555 nm by the eye's colour."
    lens = facts.study.profile.correction
    if lens is not None:
        note += (
            f" Worn: {written(lens)} at {lens.vertex_mm:g} mm; M through it "
            f"{signed(fit['refraction_through_correction_dpt'])} dpt."
        )
    return note


def signed(value: float) -> str:
    """Return a number with its sign, to a hundredth."""
    if abs(value) < 0.005:
        return "0.00"
    return f"{value:+.2f}".replace("-", "−")


def vision_table(facts: EyeFacts) -> Table:
    """Return what is seen through both pupils, as it is and best corrected."""
    pupils = facts.numbers["pupils"]
    note = "Acuity in logMAR, and as a decimal."
    if any(p["is_beyond_measured"] for p in pupils):
        note += " * wider than the pupil measured: see “What is known”."
    return Table(
        "Vision on the axis",
        tuple((word, *map(words, pupils)) for word, words in VISION_ROWS.items()),
        head=("far object, 555 nm", *(pupil_word(p) for p in pupils)),
        note=note,
    )


def distance_words(distance_dpt: float) -> str:
    """Return a far or near point in dpt, and as people say it."""
    if abs(distance_dpt) < 0.02:
        return "infinity"
    if distance_dpt < 0.0:
        return f"{signed(distance_dpt)} (behind)"
    distance_m = 1.0 / distance_dpt
    where = f"{100 * distance_m:.0f} cm" if distance_m < 1.0 else f"{distance_m:.1f} m"
    return f"{distance_dpt:.2f} ({where})"


VISION_ROWS: dict[str, Callable[[dict], str]] = {
    "higher orders, RMS, µm": lambda p: f"{p['higher_order_rms_um']:.2f}",
    "acuity as it is": lambda p: acuity_words(p["as_it_is"]["log_mar"]),
    "acuity best corrected": lambda p: acuity_words(p["best_corrected"]["log_mar"]),
    "visual Strehl as it is": lambda p: _ratio(p["as_it_is"]["visual_strehl_ratio"]),
    "visual Strehl corrected": lambda p: _ratio(
        p["best_corrected"]["visual_strehl_ratio"]
    ),
    "MTF 10 / 30 cpd, corrected": lambda p: _modulations(
        p["best_corrected"]["modulation"]
    ),
    "far point, dpt": lambda p: distance_words(p["far_point_dpt"]),
    "near point, dpt": lambda p: distance_words(p["near_point_dpt"]),
}


def pupil_word(pupil: dict) -> str:
    """Return a pupil, with a star where it is wider than what was measured."""
    star = "*" if pupil["is_beyond_measured"] else ""
    return f"{pupil['pupil_diameter_mm']:.3g} mm{star}"


def _ratio(value: float | None) -> str:
    return "–" if value is None else f"{max(value, 0.0):.3f}"


def _modulations(values: dict | None) -> str:
    if values is None:
        return "–"
    return f"{values['10_cpd']:.2f} / {values['30_cpd']:.2f}"


def acuity_words(log_mar: float | None) -> str:
    """Return an acuity in logMAR and as a decimal fraction."""
    if log_mar is None:
        return "worse than 2"
    text = f"{log_mar:+.2f}".replace("-", "−")
    return f"{text} ({10.0**-log_mar:.2f})"


def chart_row(facts: EyeFacts, pupil_mm: float) -> Row:
    """Return the chart at all distances through one pupil."""
    if not facts.charts:
        return Row((Words((f"No letter charts: {facts.chart_problem}.",)),))
    pictures: list[Block] = []
    for distance_m in DISTANCES_M:
        log_mar = facts.chart_log_mar[pupil_mm, distance_m]
        where = f"{100 * distance_m:.0f} cm" if distance_m < 1 else f"{distance_m:g} m"
        pictures.append(
            Picture(
                facts.charts[pupil_mm, distance_m],
                f"{where}, {pupil_mm:g} mm: logMAR {acuity_words(log_mar)}",
            )
        )
    return Row(tuple(pictures))


def details(facts: EyeFacts, cite: Citations, *, name: str = "") -> tuple[Section, ...]:
    """Return what lies behind the summary."""
    of_whom = f" ({name})" if name else ""
    return _field_section(facts, of_whom), _known_section(facts, cite, of_whom)


def _field_section(facts: EyeFacts, of_whom: str) -> Section:
    study = facts.study
    maps = Plot(
        lambda panel: draw_field_maps(panel, study),
        FIELD_MM,
        "Maps of M, J0, J45 and blur over 60 by 40 degrees",
    )
    acuity = on_axes(
        lambda axes: draw_through_focus_acuity(axes, study),
        CURVE_MM,
        "Acuity by distance, looking far and accommodating",
    )
    section = on_axes(
        lambda axes: draw_cross_section(axes, study),
        CURVE_MM,
        "Vertical section of the eye found, with rays from far away",
    )
    return Section(
        f"Over the visual field, and by distance{of_whom}",
        (
            Row((maps, field_table_block(facts)), (2.4, 1.0)),
            Row((acuity, section)),
            chart_row(facts, DUSK_MM),
            Row((Words(study.field.notes, "How it was computed", is_list=True),)),
        ),
        starts_page=True,
    )


def _known_section(facts: EyeFacts, cite: Citations, of_whom: str) -> Section:
    study = facts.study
    terms = on_axes(
        lambda axes: draw_terms(axes, study),
        TERMS_MM,
        "Coefficients of orders 3 to 6, as they came and of the eye",
    )
    return Section(
        f"What is known{of_whom}",
        (
            Row((provenance_table(study, cite),)),
            Row((terms,)),
            Row((coefficient_table(facts),)),
        ),
        starts_page=True,
    )


def coefficient_table(facts: EyeFacts) -> Table:
    """Return all coefficients in three columns."""
    measured = facts.numbers["measured"]
    cells = [
        (
            f"({name.replace(',', ', ')})".replace("-", "−"),
            f"{value:+.4f}".replace("-", "−"),
        )
        for name, value in measured["zernike_um"].items()
    ]
    third = -(-len(cells) // 3)
    rows = tuple(
        tuple(text for cell in cells[k::third] for text in cell) for k in range(third)
    )
    radius_mm, light_nm = measured["zernike_radius_mm"], measured["wavelength_nm"]
    return Table(
        "Coefficients, µm (OSA; x to the person's right, y up)",
        rows,
        head=("n, m", "µm") * 3,
        note=f"At the cornea, on a circle of {2 * radius_mm:.3g} mm, {light_nm:g} nm; "
        f"higher orders {measured['higher_order_rms_um']:.3f} µm RMS.",
    )


def field_table_block(facts: EyeFacts) -> Table:
    """Return the refraction along the horizontal meridian."""
    rows = tuple(
        (
            f"{entry['h_deg']:+.0f}".replace("-", "−") if entry["h_deg"] else "0",
            signed(entry["M_dpt"]),
            signed(entry["J0_dpt"]),
        )
        for entry in facts.numbers["field"]
    )
    return Table(
        "Along the horizontal",
        rows,
        head=("h, deg", "M, dpt", "J0, dpt"),
        note="Relaxed, 4 mm pupil, at the cornea; h to the person's right.",
    )


def sources(cite: Citations) -> Section:
    """Return the papers that were named."""
    return Section("Sources", (Row((Words(cite.listed()),)),))
