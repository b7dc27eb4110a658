"""Write a report on one eye, or a comparison of two.

    ocufilter report keratoconus -o eye.html
    ocufilter report eye.json -o eye.pdf
    ocufilter report before.json after.json -o surgery.pdf
    ocufilter report myopia -o eye.html --people 20

A profile is a preset name, a .json, .abp, .csv or .zmx file, or a JSON object.  The
report begins with a summary: refraction, acuity, wavefront, point images, contrast, a
letter chart near and far.  Then it shows the visual field, acuity by distance, the
estimated eye, which data were measured or assumed, and the literature references.  The
HTML file is self-contained and prints on A4.  The PDF is tagged for screen readers; it
needs the packages of ocufilter[report].

With --people, the report of one eye shows how people with this prescription, or with
this wavefront on the axis, differ: bands around curves from the 5th to the 95th
percentile of persons drawn from the population.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from clients.figures.study import profile_of
from clients.report.labels import check_text, shortened
from clients.report.make import (
    SUFFIXES,
    ReportError,
    check_pdf,
    compute_eye_facts,
    report_numbers,
    write_report,
)
from clients.report.origin import Record
from filter_service.errors import FilterError
from filter_service.image_files import check_output
from filter_service.progress import Progress


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports errors in one line, like other errors."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see --help")


def arguments_of(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = _Parser(
        prog="ocufilter report",
        allow_abbrev=False,
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "profile", help="preset name, .json, .abp, .csv or .zmx file, or JSON object"
    )
    parser.add_argument(
        "after",
        nargs="?",
        help="profile to compare with, such as after surgery or with spectacles",
    )
    parser.add_argument(
        "-o", "--out", type=Path, metavar="OUT", help="file to write: .html or .pdf"
    )
    parser.add_argument(
        "--name", default="", help="name of the first eye in the report"
    )
    parser.add_argument(
        "--after-name", default="", help="name of the second eye in the report"
    )
    parser.add_argument(
        "--reference",
        default="",
        metavar="TEXT",
        help="record or order number, shown on each page",
    )
    parser.add_argument(
        "--patient", default="", metavar="TEXT", help="patient name, shown on each page"
    )
    parser.add_argument(
        "--examiner",
        default="",
        metavar="TEXT",
        help="examiner name, shown in the header",
    )
    parser.add_argument(
        "--no-charts", action="store_true", help="omit the letter charts (faster)"
    )
    parser.add_argument(
        "--people",
        type=int,
        metavar="N",
        help="persons to draw for bands around the curves, 2 to 1000; takes 0.3 s per "
        "person on two cores, 0.1 s with a wavefront measured on the axis",
    )
    parser.add_argument(
        "--json", action="store_true", help="print the numbers as one JSON object"
    )
    return parser.parse_args(argv)


def run(options: argparse.Namespace) -> str:
    """Write the requested report; return the text to print.

    Raises
    ------
    ValueError
        If a profile, a text or a file name is invalid.
    ReportError
        If PDF output is unavailable (missing dependency).
    """
    _check_out(options)
    record = Record(
        patient=options.patient,
        examiner=options.examiner,
        reference=options.reference,
    )
    if options.out is not None and options.out.suffix.lower() == ".pdf":
        check_pdf()
    check_text("--name", options.name)
    check_text("--after-name", options.after_name)
    sources = [options.profile] + ([options.after] if options.after else [])
    profiles = [profile_of(source) for source in sources]  # fail early
    labels = tuple(
        name or _default_name(source)
        for name, source in zip(
            (options.name, options.after_name), sources, strict=False
        )
    )
    started_s = time.monotonic()
    with Progress(quiet=options.json) as progress:
        task = progress.task("Report", total=1.0, unit="%")
        eyes = compute_eye_facts(
            list(profiles),
            labels=labels,
            has_charts=not options.no_charts and options.out is not None,
            people=options.people,
            progress=task.update,
        )
        if options.out is not None:
            write_report(eyes, options.out, record)
        task.update(1.0, "written")
    if options.json:
        return json.dumps(report_numbers(eyes), allow_nan=False)
    for eye in eyes:
        if eye.chart_problem and not options.no_charts:
            print(f"note: no letter charts: {eye.chart_problem}", file=sys.stderr)
    names = "".join(f"{eye.label}, " for eye in eyes if eye.label)
    return f"{options.out}: {names}{time.monotonic() - started_s:.1f} s"


def _check_out(options: argparse.Namespace) -> None:
    out = options.out
    if out is None:
        if not options.json:
            raise ValueError("--out is missing; expected a .html or .pdf file")
        return
    check_output(out, SUFFIXES)


def _default_name(source: str) -> str:
    """Return a file's name without its suffix, or a preset's name; empty for JSON."""
    if source.lstrip().startswith("{"):
        return ""
    return shortened(Path(source).stem if Path(source).suffix else source)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code."""
    try:
        sys.stdout.write(run(arguments_of(argv)) + "\n")
    except KeyboardInterrupt:
        return 130
    except (FilterError, ValueError) as error:
        bad_input = isinstance(error, ValueError)
        print(f"report: {' '.join(str(error).split())}", file=sys.stderr)
        return 2 if bad_input else 1
    except (OSError, ReportError) as error:
        print(f"report: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
