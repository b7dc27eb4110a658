"""Reports on one eye, or on two: different eyes, times or corrections.

A report on one eye begins with a summary page, a report on two with the differences.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from matplotlib.figure import FigureBase

from clients.acuity_text import Notation
from clients.acuity_text import acuity_text as acuity_in
from clients.figures import (
    EyeStudy,
    draw_acuity_of_several,
    draw_cross_section,
    draw_field_line,
    draw_field_maps,
    draw_mtf,
    draw_mtf_of_several,
    draw_psfs,
    draw_rms_by_order,
    draw_terms,
    draw_through_focus_acuity,
    draw_wavefront_map,
    draw_wavefront_maps,
    wavefront_range_um,
)
from clients.figures.study import PUPILS_MM
from clients.figures.style import LITERAL, TITLE_PT
from clients.figures.wavefront import (
    LOWEST_HIGHER_ORDER,
    on_circle_um,
    psf_sides_arcmin,
)
from clients.report.facts import DISTANCES_M, SIDE_NAMES, EyeFacts, chart_rows, signed
from clients.report.html_page import (
    Block,
    Document,
    Mark,
    Picture,
    Plot,
    Row,
    Section,
    Table,
    Text,
)
from clients.report.plain import plain_text
from clients.report.tables import (
    NOTATION_WORDS,
    REFRACTION_ROWS,
    VISION_ROWS,
    acuity_text,
    biometry_table,
    change_text,
    coefficient_table,
    field_table_block,
    people_table,
    pupil_text,
    refraction_table,
    refraction_text,
    spectacles_text,
    vision_cell,
    vision_note,
    vision_table,
)
from clients.report.text import (
    Citations,
    entered_text,
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
PAIR_MAP_MM, PAIR_CURVES_MM, PAIR_FIELD_MM, PAIR_SECTION_MM = 46.0, 49.0, 64.0, 50.0
"""Heights in the report of two eyes."""


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
        "on a logarithmic scale of two decades. “As it is”: focused far, "
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


def comparison_document(before: EyeFacts, after: EyeFacts) -> Document:
    """Return the report of two eyes: first the differences, then each eye."""
    cite = Citations()
    cite("csoba", "osa", "vectors")
    return Document(
        title=f"Eye report: {before.label} → {after.label}",
        subtitle=f"{subtitle(before.study)} → {subtitle(after.study)}",
        sections=(
            _difference(before, after),
            _curves(before, after),
            _known(before, after, cite),
            _field(before, after),
            sources(cite),
        ),
        footer=NOT_A_DEVICE,
    )


def _difference(before: EyeFacts, after: EyeFacts) -> Section:
    studies, labels = (before.study, after.study), (before.label, after.label)
    pairs = list(zip(studies, labels, strict=True))
    tables = [_refraction_table(before, after), _vision_table(before, after)]
    if all("biometry" in facts.numbers["eye"] for facts in (before, after)):
        tables.append(biometry_table((before, after), _moments(before, after)))
    bars = on_axes(
        lambda axes: draw_rms_by_order(axes, studies, labels=labels),
        PAIR_MAP_MM,
        "Root mean square by radial order of both eyes",
    )
    return Section(
        "Before and after"
        if _moments(before, after) == ("before", "after")
        else "Both eyes of this report",
        (
            Row((Text((plain_text(before, after),)),)),
            *(Row((table,)) for table in tables),
            Row((*(_map(*pair, studies) for pair in pairs), bars)),
            Row(tuple(_psfs(*pair, psf_sides_arcmin(studies)) for pair in pairs)),
            Row((Text((legend(after.study, after.notation),)),)),
            *(Row((Text(limits),)) for limits in _limits(before, after)),
        ),
    )


def _known(before: EyeFacts, after: EyeFacts, cite: Citations) -> Section:
    """Return the section on known and assumed data; shared entries appear once."""
    studies, labels = (before.study, after.study), (before.label, after.label)
    methods = [method_text(study) for study in studies]
    shared = [text for text in methods[0] if text in methods[1]]
    own = [
        f"{label}: {text}"
        for label, texts in zip(labels, methods, strict=True)
        for text in texts
        if text not in shared
    ]
    return Section(
        KNOWN_TITLE,
        (
            Row((provenance_table(studies, cite, labels=labels),)),
            method_row(*shared, *own),
            Row((coefficient_table((before, after), _moments(before, after)),)),
        ),
    )


def _field(before: EyeFacts, after: EyeFacts) -> Section:
    both = before, after
    return Section(
        "Over the visual field, and section of the eye",
        (
            *(
                field_row(
                    facts,
                    name=moment,
                    height_mm=PAIR_FIELD_MM,
                    compared=(before.study, after.study),
                )
                for facts, moment in zip(both, _moments(before, after), strict=True)
            ),
            Row(tuple(section_plot(f.study, height_mm=PAIR_SECTION_MM) for f in both)),
        ),
    )


def _moments(before: EyeFacts, after: EyeFacts) -> tuple[str, str]:
    """Return the names of the eyes in tables: before and after, or their sides."""
    sides = [facts.study.profile.eye_side for facts in (before, after)]
    if sides[0] == sides[1]:
        return "before", "after"
    return SIDE_NAMES[sides[0]], SIDE_NAMES[sides[1]]


def _limits(before: EyeFacts, after: EyeFacts) -> tuple[tuple[str, ...], ...]:
    """Return the limitations that lenses impose on the report, each once."""
    of_all = [limits_text(f.study.profile) for f in (before, after)]
    return tuple(dict.fromkeys(limits for limits in of_all if limits))


def _psfs(study: EyeStudy, label: str, sides_arcmin: tuple[float, float]) -> Plot:
    """Return the PSFs of one eye, at the scale of both."""

    def draw(panel: FigureBase) -> None:
        draw_psfs(panel, study, sides_arcmin=sides_arcmin)
        panel.suptitle(label, fontsize=TITLE_PT, **LITERAL)

    return Plot(draw, PSF_MM, f"Point-spread functions: {label}")


def _map(study: EyeStudy, label: str, studies: tuple[EyeStudy, ...]) -> Plot:
    """Return the higher orders of one eye: on the smaller circle, in equal colors."""
    radius_mm = min(other.found.zernike_radius_mm for other in studies)
    range_um = max(
        wavefront_range_um(
            on_circle_um(other, radius_mm), from_order=LOWEST_HIGHER_ORDER
        )
        for other in studies
    )
    return on_axes(
        lambda axes: draw_wavefront_map(
            axes,
            on_circle_um(study, radius_mm),
            radius_mm=radius_mm,
            eye_side=study.profile.eye_side,
            from_order=LOWEST_HIGHER_ORDER,
            title=f"{label}\norders 3 to 6{study.assumed_suffix}",
            range_um=range_um,
        ),
        PAIR_MAP_MM,
        f"Map of the higher orders: {label}",
    )


def _refraction_table(before: EyeFacts, after: EyeFacts) -> Table:
    both = before, after
    eyes = [facts.numbers["eye"] for facts in both]
    moments = _moments(before, after)
    rows = [
        (
            moment,
            *(refraction_text(eye["refraction"], n) for n in REFRACTION_ROWS.values()),
        )
        for moment, eye in zip(moments, eyes, strict=True)
    ]
    first, last = (eye["refraction"] for eye in eyes)
    rows.append(
        (
            "change",
            *(
                "" if name == "axis_deg" else change_text(first[name], last[name])
                for name in REFRACTION_ROWS.values()
            ),
        )
    )
    head = ("at the cornea", *REFRACTION_ROWS)
    if any(facts.study.profile.correction for facts in both):
        worn_dpt = [eye["refraction_through_correction_dpt"] for eye in eyes]
        through = (*map(signed, worn_dpt), change_text(*worn_dpt))
        rows = [(*row, text) for row, text in zip(rows, through, strict=True)]
        head = (*head, "M as worn")
    return Table(
        "Refraction of the estimated eyes, dpt",
        tuple(rows),
        head=tuple(cell.removesuffix(", dpt") for cell in head),
        note=" ".join(
            _eye_note(moment, facts)
            for moment, facts in zip(moments, both, strict=True)
        )
        + " Relaxed, 555 nm.",
    )


def _eye_note(moment: str, facts: EyeFacts) -> str:
    """Return the name of an eye, its powers as entered, and spectacles for it."""
    entered = entered_text(facts.study.profile)
    spectacles = f"{spectacles_text(facts)}."
    name = moment.capitalize()
    if facts.label != moment:
        name += f" ({facts.label})"
    return " ".join(text for text in (f"{name}:", entered, spectacles) if text)


def _vision_table(before: EyeFacts, after: EyeFacts) -> Table:
    pupils = before.numbers["pupils"], after.numbers["pupils"]
    of_pupils = list(zip(*pupils, strict=True))
    groups = tuple(
        # with a star if it is wider than measured in one of the eyes
        (f"{pupil_text(max(pair, key=lambda eye: eye['is_beyond_measured']))} pupil", 2)
        for pair in of_pupils
    )
    head = ("far object, 555 nm", *_moments(before, after) * len(of_pupils))
    rows = tuple(
        (
            label,
            *(
                vision_cell(label, numbers, facts)
                for pair in of_pupils
                for numbers, facts in zip(pair, (before, after), strict=True)
            ),
        )
        for label in VISION_ROWS
    )
    return Table(
        "Vision on the axis",
        rows,
        head=head,
        groups=(("", 1), *groups),
        note=vision_note(
            [numbers for found in pupils for numbers in found], before.notation
        ),
    )


def _curves(before: EyeFacts, after: EyeFacts) -> Section:
    studies, labels = (before.study, after.study), (before.label, after.label)

    def by_pupil(draw: Callable[..., None], alt: str) -> tuple[Plot, ...]:
        return tuple(
            on_axes(
                cast(
                    "Callable[[Any], None]",
                    lambda axes, mm=pupil_mm: draw(
                        axes, studies, labels=labels, pupil_mm=mm
                    ),
                ),
                PAIR_CURVES_MM,
                f"{alt}, {pupil_mm:g} mm",
            )
            for pupil_mm in PUPILS_MM
        )

    mtfs = by_pupil(draw_mtf_of_several, "Modulation transfer of both")
    acuities = by_pupil(draw_acuity_of_several, "Acuity of both by distance")
    return Section(
        "Contrast, acuity and charts",
        (
            Row(mtfs),
            Row(acuities),
            *(
                chart_row(facts, pupil_mm, name=facts.label)
                for pupil_mm in PUPILS_MM
                for facts in (before, after)
                if facts.charts or pupil_mm == PUPILS_MM[0]
            ),
        ),
    )
