"""The report of two eyes, or of one eye before and after surgery, lenses or years."""

from __future__ import annotations

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
)
from clients.figures.orders import FIRST_HIGHER, on_circle_um
from clients.figures.psfs import psf_sides_arcmin
from clients.figures.study import PUPILS_MM
from clients.figures.style import TITLE_PT
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
from clients.report.content import (
    DAY_MM,
    DUSK_MM,
    NOT_A_DEVICE,
    chart_row,
    details,
    on_axes,
    sources,
    subtitle,
)
from clients.report.correction_text import limits_text
from clients.report.facts import EyeFacts
from clients.report.sources import Citations
from clients.report.tables import (
    REFRACTION_ROWS,
    VISION_ROWS,
    acuity_text,
    pupil_text,
    refraction_text,
    signed,
)

NEAR_M, FAR_M = DISTANCES_M[0], DISTANCES_M[-1]
MAP_MM, PSF_MM = 52.0, 54.0

CURVES_MM = 64.0
"""Height of curves of both eyes."""


def comparison_document(before: EyeFacts, after: EyeFacts) -> Document:
    """Return the report of two eyes: first the differences, then each eye."""
    cite = Citations()
    cite("csoba", "osa", "vectors")
    of_each = [details(facts, cite, name=facts.label) for facts in (before, after)]
    return Document(
        title=f"Eye report: {before.label} → {after.label}",
        subtitle=f"{subtitle(before.study)} → {subtitle(after.study)}",
        sections=(
            _difference(before, after),
            _curves(before, after),
            *(section for pair in zip(*of_each, strict=True) for section in pair),
            sources(cite),
        ),
        footer=NOT_A_DEVICE,
    )


def _difference(before: EyeFacts, after: EyeFacts) -> Section:
    studies, labels = (before.study, after.study), (before.label, after.label)
    pairs = list(zip(studies, labels, strict=True))
    tables = _refraction_table(before, after), _vision_table(before, after)
    bars = on_axes(
        lambda axes: draw_rms_by_order(axes, studies, labels=labels),
        MAP_MM,
        "Root mean square by radial order, before and after",
    )
    return Section(
        "Before and after",
        (
            *(Row((table,)) for table in tables),
            Row((*(_map(*pair, studies) for pair in pairs), bars)),
            Row(tuple(_psfs(*pair, psf_sides_arcmin(studies)) for pair in pairs)),
            _charts(before, after, DAY_MM),
            *(Row((Words(limits),)) for limits in _limits(before, after)),
        ),
    )


def _limits(before: EyeFacts, after: EyeFacts) -> tuple[tuple[str, ...], ...]:
    """Return the limitations that lenses impose on the report, each once."""
    of_all = [limits_text(f.study.profile.correction) for f in (before, after)]
    return tuple(dict.fromkeys(limits for limits in of_all if limits))


def _psfs(study: EyeStudy, label: str, sides_arcmin: tuple[float, float]) -> Plot:
    """Return the PSFs of one eye, at the scale of both."""

    def draw(panel: FigureBase) -> None:
        draw_psfs(panel, study, sides_arcmin=sides_arcmin)
        panel.suptitle(label, fontsize=TITLE_PT)

    return Plot(draw, PSF_MM, f"Point-spread functions: {label}")


def _map(study: EyeStudy, label: str, studies: tuple[EyeStudy, ...]) -> Plot:
    """Return the higher orders of one eye on the smaller of both circles."""
    radius_mm = min(other.found.zernike_radius_mm for other in studies)
    return on_axes(
        lambda axes: draw_wavefront_map(
            axes,
            on_circle_um(study, radius_mm),
            radius_mm=radius_mm,
            eye_side=study.profile.eye_side,
            from_order=FIRST_HIGHER,
            title=f"{label}\norders 3 to 6{study.assumed_suffix}",
        ),
        MAP_MM,
        f"Map of the higher orders: {label}",
    )


def _refraction_table(before: EyeFacts, after: EyeFacts) -> Table:
    eyes = [facts.numbers["eye"] for facts in (before, after)]
    rows = [
        (
            when,
            *(refraction_text(eye["refraction"], n) for n in REFRACTION_ROWS.values()),
        )
        for when, eye in zip(("before", "after"), eyes, strict=True)
    ]
    first, last = (eye["refraction"] for eye in eyes)
    rows.append(
        (
            "change",
            *(
                "" if name == "axis_deg" else signed(last[name] - first[name])
                for name in REFRACTION_ROWS.values()
            ),
        )
    )
    head = ("at the cornea", *REFRACTION_ROWS)
    if any(facts.study.profile.correction for facts in (before, after)):
        worn_dpt = [eye["refraction_through_correction_dpt"] for eye in eyes]
        through_dpt = (*worn_dpt, worn_dpt[1] - worn_dpt[0])
        rows = [(*row, signed(dpt)) for row, dpt in zip(rows, through_dpt, strict=True)]
        head = (*head, "M as worn")
    return Table(
        "Refraction of the estimated eyes, dpt",
        tuple(rows),
        head=tuple(cell.removesuffix(", dpt") for cell in head),
        note=f"Before: {before.label}; after: {after.label}. Relaxed, 555 nm.",
    )


def _vision_table(before: EyeFacts, after: EyeFacts) -> Table:
    of_pupils = list(
        zip(before.numbers["pupils"], after.numbers["pupils"], strict=True)
    )
    groups = tuple((f"{pupil_text(pair[0])} pupil", 2) for pair in of_pupils)
    head = ("far object, 555 nm", *("before", "after") * len(of_pupils))
    rows = tuple(
        (word, *(words(numbers) for pair in of_pupils for numbers in pair))
        for word, words in VISION_ROWS.items()
    )
    return Table(
        "Vision on the axis",
        rows,
        head=head,
        groups=(("", 1), *groups),
        note="Acuity in logMAR, and as a decimal. * wider than the pupil measured.",
    )


def _charts(before: EyeFacts, after: EyeFacts, pupil_mm: float) -> Row:
    """Return near and far charts of both eyes through one pupil."""
    pictures: list[Block] = []
    for facts in (before, after):
        if not facts.charts:
            return chart_row(facts, pupil_mm)
        for distance_m, where in ((NEAR_M, "40 cm"), (FAR_M, "6 m")):
            told = acuity_text(facts.chart_numbers[pupil_mm, distance_m])
            pictures.append(
                Picture(
                    facts.charts[pupil_mm, distance_m],
                    f"{facts.label}, {where}, {pupil_mm:g} mm: {told}",
                )
            )
    return Row(tuple(pictures))


def _curves(before: EyeFacts, after: EyeFacts) -> Section:
    studies, labels = (before.study, after.study), (before.label, after.label)

    def by_pupil(draw: Callable[..., None], told: str) -> tuple[Plot, ...]:
        return tuple(
            on_axes(
                cast(
                    "Callable[[Any], None]",
                    lambda axes, mm=pupil_mm: draw(
                        axes, studies, labels=labels, pupil_mm=mm
                    ),
                ),
                CURVES_MM,
                f"{told}, {pupil_mm:g} mm",
            )
            for pupil_mm in PUPILS_MM
        )

    mtfs = by_pupil(draw_mtf_of_several, "Modulation transfer of both")
    acuities = by_pupil(draw_acuity_of_several, "Acuity of both by distance")
    return Section(
        "Contrast and acuity, before and after",
        (
            Row(mtfs),
            Row(acuities),
            _charts(before, after, DUSK_MM),
        ),
    )
