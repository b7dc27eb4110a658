"""Report on two eyes, which begins with their differences.

The two are different eyes, times or corrections.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, cast

from matplotlib.figure import FigureBase

from clients.figures import (
    EyeStudy,
    draw_acuity_of_several,
    draw_mtf_of_several,
    draw_psfs,
    draw_rms_by_order,
    draw_wavefront_map,
    wavefront_range_um,
)
from clients.figures.study import PUPILS_MM
from clients.figures.style import LITERAL, TITLE_PT
from clients.figures.wavefront import (
    LOWEST_HIGHER_ORDER,
    on_circle_um,
    psf_sides_arcmin,
)
from clients.report.content import (
    KNOWN_TITLE,
    NOT_A_DEVICE,
    chart_row,
    field_row,
    legend,
    method_row,
    on_axes,
    section_plot,
    sources,
    subtitle,
)
from clients.report.facts import SIDE_NAMES, EyeFacts, signed
from clients.report.html_page import (
    Document,
    Plot,
    Row,
    Section,
    Table,
    Text,
)
from clients.report.plain import plain_text
from clients.report.tables import (
    REFRACTION_ROWS,
    VISION_ROWS,
    biometry_table,
    change_text,
    coefficient_table,
    pupil_text,
    refraction_text,
    spectacles_text,
    vision_cell,
    vision_note,
)
from clients.report.text import (
    Citations,
    entered_text,
    limits_text,
    method_text,
    provenance_table,
)

PAIR_MAP_MM, PAIR_CURVES_MM, PAIR_FIELD_MM, PAIR_SECTION_MM = 46.0, 49.0, 64.0, 50.0
PAIR_PSF_MM = 60.0
"""Heights in the report of two eyes."""


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
            Row(
                (Text((legend(after.study, after.notation), *_limits(before, after))),)
            ),
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
    """Return the names of the eyes in tables.

    They are labels of one letter, such as A and B, before and after, or their sides.
    """
    first, second = _short_labels(before, after)
    if len(first) == len(second) == 1:
        return first, second
    sides = [facts.study.profile.eye_side for facts in (before, after)]
    if sides[0] == sides[1]:
        return "before", "after"
    return SIDE_NAMES[sides[0]], SIDE_NAMES[sides[1]]


def _limits(before: EyeFacts, after: EyeFacts) -> tuple[str, ...]:
    """Return the limitations that lenses impose on the report, each once."""
    of_all = [limits_text(facts.study.profile) for facts in (before, after)]
    return tuple(dict.fromkeys(text for limits in of_all for text in limits))


def _psfs(study: EyeStudy, label: str, sides_arcmin: tuple[float, float]) -> Plot:
    """Return the PSFs of one eye, at the scale of both."""

    def draw(panel: FigureBase) -> None:
        draw_psfs(panel, study, sides_arcmin=sides_arcmin)
        panel.suptitle(label, fontsize=TITLE_PT, **LITERAL)

    return Plot(draw, PAIR_PSF_MM, f"Point-spread functions: {label}")


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
    name = moment[:1].upper() + moment[1:]
    if facts.label.startswith(moment):
        name = facts.label
    else:
        name += f", {facts.label}"
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


def _short_labels(*both: EyeFacts) -> tuple[str, ...]:
    """Return labels without what explains them, unless they are then the same.

    That is what is in parentheses, or follows a letter and a colon: "A: monofocal".
    """
    labels = tuple(facts.label for facts in both)
    short = tuple(re.split(r" \(|(?<=^\w): ", label)[0] for label in labels)
    return short if all(short) and len({*short}) == len(short) else labels


def _curves(before: EyeFacts, after: EyeFacts) -> Section:
    studies, labels = (before.study, after.study), _short_labels(before, after)

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
