"""`ocufilter report`: write a report on one eye, or a comparison of two."""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from clients.acuity_text import Notation
from clients.figures.study import profile_of
from clients.report.facts import check_text, shortened
from clients.report.make import (
    SUFFIXES,
    Record,
    ReportError,
    check_pdf,
    compute_eye_facts,
    report_numbers,
    write_report,
)
from filter_service.command_line import CommandFailed, Json, print_json, print_line
from filter_service.image_files import check_output
from filter_service.progress import Progress


def report(
    profile: Annotated[
        str,
        typer.Argument(
            metavar="PROFILE",
            help="Preset name, .json, .abp, .csv or .zmx file, or JSON object.",
        ),
    ],
    after: Annotated[
        str | None,
        typer.Argument(
            metavar="AFTER",
            help="Profile to compare with, such as after surgery or with spectacles.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="OUT", help="File to write: .html or .pdf."
        ),
    ] = None,
    name: Annotated[
        str, typer.Option(help="Name of the first eye in the report.")
    ] = "",
    after_name: Annotated[
        str, typer.Option(help="Name of the second eye in the report.")
    ] = "",
    reference: Annotated[
        str,
        typer.Option(
            metavar="TEXT", help="Record or order number, shown on each page."
        ),
    ] = "",
    patient: Annotated[
        str, typer.Option(metavar="TEXT", help="Patient name, shown on each page.")
    ] = "",
    examiner: Annotated[
        str, typer.Option(metavar="TEXT", help="Examiner name, shown in the header.")
    ] = "",
    no_charts: Annotated[
        bool, typer.Option("--no-charts", help="Omit the letter charts; faster.")
    ] = False,
    people: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Persons to draw for bands around the curves, 2 to 1000; takes 0.3 s "
            "per person on two cores, 0.1 s with a wavefront measured on the axis.",
        ),
    ] = None,
    notation: Annotated[
        Notation,
        typer.Option(
            help="Notation of acuities beside logMAR: 20/40 (feet), 6/12 (meters) or "
            "0.50 (decimal)."
        ),
    ] = "decimal",
    json_output: Json = False,
) -> None:
    """Write a report on one eye, or a comparison of two, as HTML or PDF.

    ocufilter report keratoconus -o eye.html

    ocufilter report eye.json -o eye.pdf

    ocufilter report before.json after.json -o surgery.pdf

    ocufilter report myopia -o eye.html --people 20

    The report begins with a summary: refraction, acuity, wavefront, point images,
    contrast, and a letter chart near and far.  Then it shows the visual field, acuity
    by distance, the estimated eye, which data were measured or assumed, and the
    literature references.  The HTML file is self-contained and prints on A4.  The PDF
    is tagged for screen readers; it needs the packages of ocufilter[report].

    With --people, the report of one eye shows how people with this prescription, or
    with this wavefront on the axis, differ: bands around curves from the 5th to the
    95th percentile of persons drawn from the population.
    """
    if out is not None:
        check_output(out, SUFFIXES)
    elif not json_output:
        raise ValueError("--out is missing; expected a .html or .pdf file")
    record = Record(patient=patient, examiner=examiner, reference=reference)
    try:
        if out is not None and out.suffix.lower() == ".pdf":
            check_pdf()
    except ReportError as error:
        raise CommandFailed(str(error)) from None
    check_text("--name", name)
    check_text("--after-name", after_name)
    sources = [profile] + ([after] if after else [])
    profiles = [profile_of(source) for source in sources]  # fail early
    labels = tuple(
        given or _default_name(source)
        for given, source in zip((name, after_name), sources, strict=False)
    )
    started_s = time.monotonic()
    with Progress(quiet=json_output) as progress:
        task = progress.task("Report", total=1.0, unit="%")
        eyes = compute_eye_facts(
            list(profiles),
            labels=labels,
            has_charts=not no_charts and out is not None,
            people=people,
            notation=notation,
            progress=task.update,
        )
        if out is not None:
            write_report(eyes, out, record)
        task.update(1.0, "written")
    if json_output:
        print_json(report_numbers(eyes))
        return
    for eye in eyes:
        if eye.chart_problem and not no_charts:
            sys.stderr.write(f"note: no letter charts: {eye.chart_problem}\n")
    names = "".join(f"{eye.label}, " for eye in eyes if eye.label)
    print_line(f"{out}: {names}{time.monotonic() - started_s:.1f} s")


def _default_name(source: str) -> str:
    """Return a file's name without its suffix, or a preset's name; empty for JSON."""
    if source.lstrip().startswith("{"):
        return ""
    return shortened(Path(source).stem if Path(source).suffix else source)
