"""Report on one eye, which begins with a summary page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from matplotlib.figure import FigureBase

from clients.acuity_text import Notation
from clients.acuity_text import acuity_text as acuity_in
from clients.figures import (
    EyeStudy,
    draw_cross_section,
    draw_field_line,
    draw_field_maps,
    draw_mtf,
    draw_psfs,
    draw_rms_by_order,
    draw_terms,
    draw_through_focus_acuity,
    draw_wavefront_maps,
)
from clients.figures.study import PUPILS_MM
from clients.report.facts import DISTANCES_M, SIDE_NAMES, EyeFacts, chart_rows
from clients.report.html_page import (
    Block,
    Document,
    Mark,
    Picture,
    Plot,
    Row,
    Section,
    Text,
)
from clients.report.tables import (
    NOTATION_WORDS,
    acuity_text,
    coefficient_table,
    field_table_block,
    people_table,
    refraction_table,
    vision_table,
)
from clients.report.text import (
    Citations,
    limits_text,
    method_text,
    near_text,
    people_text,
    provenance_table,
    treatment_text,
)
from clients.scenes.letter_chart import smallest_row

DAY_MM, DUSK_MM = PUPILS_MM

FIELD_TITLE = "Over the visual field, and by distance"
KNOWN_TITLE = "What is known"

MAP_MM, PSF_MM = 39.0, 44.0
FIELD_MM, CURVE_MM, TERMS_MM = 76.0, 60.0, 40.0
NOT_A_DEVICE = (
    "A simulation for research and explanation, not a medical device: no diagnosis or "
    "treatment may rest on it."
)

KIND_LABELS = {
    "prescription": "a prescription",
    "zernike": "a measured wavefront",
    "zernike_set": "a set of measured wavefronts",
    "eye": "a given eye model",
    "surfaces": "a given eye, by its surfaces",
    "pseudophakic": "biometry and the geometry of an implant",
    "published": "a schematic eye of the literature",
    "synteyes": "an eye of a statistical model of biometry",
}


def eye_document(facts: EyeFacts) -> Document:
    """Return the report of one eye."""
    cite = Citations()
    cite("csoba", "osa", "vectors")
    return Document(
        title=f"Eye report: {_title(facts)}",
        subtitle=subtitle(facts.study),
        sections=(
            summary(facts),
            Section(
                FIELD_TITLE,
                (
                    field_row(facts),
                    *_people_rows(facts),
                    _distance_row(facts),
                    chart_row(facts, DUSK_MM),
                    method_row(*method_text(facts.study), *people_text(facts)),
                ),
            ),
            Section(
                KNOWN_TITLE,
                (
                    Row((provenance_table([facts.study], cite, people=facts.people),)),
                    *_coefficient_rows(facts),
                ),
            ),
            sources(cite),
        ),
        footer=NOT_A_DEVICE,
    )


def _title(facts: EyeFacts) -> str:
    """Return the name of an eye, or its side, and the name of its preset."""
    profile = facts.study.profile
    label = facts.label or SIDE_NAMES[profile.eye_side]
    if facts.study.is_example and profile.name not in label:
        label += f", {profile.name}"
    return label


def subtitle(study: EyeStudy) -> str:
    """Return one line on the eye: side, age and source."""
    profile = study.profile
    age = "age not given"
    if profile.age_years is not None:
        age = f"{profile.age_years:g} years"
    side = f"{SIDE_NAMES[profile.eye_side]} ({profile.eye_side})"
    source = f"from {KIND_LABELS[profile.kind]}"
    if study.is_example:
        source = f"example eye (preset {profile.name})"
    treatment = treatment_text(study)
    return f"{side}, {age}, {source}{f'; {treatment}' if treatment else ''}"


def summary(facts: EyeFacts) -> Section:
    """Return the summary section."""
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
        lambda axes: draw_mtf(
            axes,
            study,
            drawn_modulation=facts.people.modulation if facts.people else None,
        ),
        PSF_MM,
        "Modulation transfer functions through 3 and 5 mm",
    )
    texts = (
        legend(study, facts.notation) + _band_text(facts),
        *limits_text(study.profile),
    )
    return Section(
        "Summary",
        (
            Row((refraction_table(facts), vision_table(facts)), (1.0, 1.15)),
            Row((maps, orders), (2.0, 1.0)),
            Row((points, contrast), (1.0, 1.4)),
            chart_row(facts, DAY_MM),
            Row((Text(texts),)),
        ),
    )


def legend(study: EyeStudy, notation: Notation = "decimal") -> str:
    """Return the explanation of a report's maps, states and charts."""
    return (
        "Wavefront at the cornea, without a correction, as the examiner faces the eye "
        "(T temporal, N nasal). Point images and charts as the person sees them; light "
        "on a logarithmic scale of three decades. “As it is”: focused far, "
        "accommodating where that helps"
        + (", through the worn correction" if study.profile.correction else "")
        + ". “Best corrected”: with the sphere and cylinder of the highest visual "
        "Strehl ratio through that pupil, and an acuity not below “as it is”. Charts: "
        "the eye tries to focus on each; rows in "
        f"{NOTATION_WORDS[notation]}, ◂ the row nearest to the predicted acuity; the "
        "rows below it are shown but not read."
    )


def _band_text(facts: EyeFacts) -> str:
    """Return the explanation of bands in the summary; empty without them."""
    if facts.people is None or not facts.people.modulation:
        return ""
    return (
        " Bands: best corrected, from the 5th to the 95th percentile of "
        f"{facts.people.count} persons drawn from the population."
    )


def on_axes(draw: Callable[[Any], None], height_mm: float, alt: str) -> Plot:
    """Return a plot of one pair of axes."""

    def draw_panel(panel: FigureBase) -> None:
        draw(panel.subplots())

    return Plot(draw_panel, height_mm, alt)


def chart_row(facts: EyeFacts, pupil_mm: float, *, name: str = "") -> Row:
    """Return the charts at all distances through one pupil."""
    if not facts.charts:
        return Row((Text((f"No letter charts: {facts.chart_problem}.",)),))
    start, unit = (f"{name}, ", "") if name else ("", "logMAR ")
    pictures: list[Block] = []
    for distance_m in DISTANCES_M:
        where = f"{100 * distance_m:.0f} cm" if distance_m < 1 else f"{distance_m:g} m"
        found = facts.chart_numbers[pupil_mm, distance_m]
        near = near_text(facts.study.profile.correction) if distance_m < 1 else ""
        pictures.append(
            Picture(
                facts.charts[pupil_mm, distance_m],
                f"{start}{where}, {pupil_mm:g} mm: {unit}{acuity_text(found)}{near}",
                _row_marks(found, facts.notation),
            )
        )
    return Row(tuple(pictures))


def _row_marks(found: dict[str, Any], notation: Notation) -> tuple[Mark, ...]:
    """Return the size of each row, and which one the acuity is nearest to."""
    rows = chart_rows()
    sizes = [log_mar for log_mar, _ in rows]
    acuity = found["log_mar"]
    read = None if acuity is None else smallest_row(sizes, acuity)
    return tuple(
        Mark(y_ratio, _row_text(log_mar, notation), k == read)
        for k, (log_mar, y_ratio) in enumerate(rows)
    )


def _row_text(log_mar: float, notation: Notation) -> str:
    """Return the size of a row in logMAR, and in the notation if it is another."""
    notations: tuple[Notation, ...] = ("log_mar", notation)
    return " · ".join(acuity_in(log_mar, each) for each in dict.fromkeys(notations))


def field_row(
    facts: EyeFacts,
    *,
    name: str = "",
    height_mm: float = FIELD_MM,
    compared: tuple[EyeStudy, ...] = (),
) -> Row:
    """Return the field of an eye as maps, in the colors of `compared`, and a table."""
    study = facts.study
    maps = Plot(
        lambda panel: draw_field_maps(panel, study, compared=compared),
        height_mm,
        "Maps of M, J0, J45 and blur over 60 by 40 degrees",
    )
    return Row((maps, field_table_block(facts, name=name)), (2.4, 1.0))


def _people_rows(facts: EyeFacts) -> tuple[Row, ...]:
    """Return the refraction of drawn persons along the horizontal meridian."""
    people = facts.people
    if people is None:
        return ()
    line = on_axes(
        lambda axes: draw_field_line(axes, facts.study, people),
        CURVE_MM,
        "M along the horizontal meridian, median and bands of drawn persons",
    )
    return (Row((line, people_table(facts)), (1.3, 1.0)),)


def _distance_row(facts: EyeFacts) -> Row:
    """Return acuity by distance, and the section of an eye."""
    study = facts.study
    acuity = on_axes(
        lambda axes: draw_through_focus_acuity(
            axes, study, drawn_log_mar=facts.people.log_mar if facts.people else None
        ),
        CURVE_MM,
        "Acuity by distance, focused far and accommodating",
    )
    return Row((acuity, section_plot(study)))


def section_plot(study: EyeStudy, *, height_mm: float = CURVE_MM) -> Plot:
    """Return the section of an eye."""
    return on_axes(
        lambda axes: draw_cross_section(axes, study),
        height_mm,
        "Vertical section of the estimated eye, with rays from infinity",
    )


def method_row(*texts: str) -> Row:
    """Return the list of how eyes were computed."""
    return Row((Text(texts, "How it was computed", is_list=True),))


def _coefficient_rows(facts: EyeFacts) -> tuple[Row, ...]:
    """Return the coefficients of an eye as a chart and as a table."""
    study = facts.study
    terms = on_axes(
        lambda axes: draw_terms(axes, study),
        TERMS_MM,
        "Coefficients of orders 3 to 6, measured and of the estimated eye",
    )
    return Row((terms,)), Row((coefficient_table([facts]),))


def sources(cite: Citations) -> Section:
    """Return the section of cited papers."""
    return Section("Sources", (Row((Text((" ".join(cite.listed()),), n_columns=2),)),))
