"""Reports from profiles: as HTML text, as a file, or as numbers."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import ImageFile

from clients.acuity_text import Notation
from clients.figures.study import PUPILS_MM, Profile, ProgressCallback, profile_of
from clients.report.comparison import comparison_document
from clients.report.content import eye_document
from clients.report.facts import EyeFacts, check_text, distinct_labels, facts_of
from clients.report.html_page import Document, html_of
from estimator import drawn_profiles, thread_count
from filter_service import __version__
from filter_service.atomic_files import write_atomically

SHOWN_DIGITS = 16
"""Digits of a profile's digest that are shown: 64 bits."""

SUFFIXES = (".html", ".pdf")
PANGO_PACKAGES = ("libpango-1.0-0", "libpangoft2-1.0-0", "libharfbuzz-subset0")
"""Debian packages of the system libraries that WeasyPrint loads."""

WRITING_START_FRACTION = 0.85
"""Progress fraction at which computation ends and writing begins."""


@dataclass(frozen=True)
class Record:
    """Identification of a report entered by the user; empty texts are omitted.

    Raises
    ------
    ValueError
        If a text is too long or cannot be printed.
    """

    patient: str = ""
    examiner: str = ""
    reference: str = ""

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):
            check_text(name, getattr(self, name))


def origin_of(eyes: list[EyeFacts], record: Record) -> tuple[tuple[str, str], ...]:
    """Return names and values that identify a report."""
    digests = " → ".join(facts.study.profile.digest[:SHOWN_DIGITS] for facts in eyes)
    entries = (
        ("Patient", record.patient),
        ("Examiner", record.examiner),
        ("Reference", record.reference),
        ("Date", f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"),
        ("Version", f"ocufilter {__version__}"),
        ("Profile", digests),
    )
    return tuple((name, value) for name, value in entries if value)


def running_footer(title: str, origin: tuple[tuple[str, str], ...]) -> str:
    """Return the text in the footer of every page, which identifies the report."""
    shown = [
        value if name == "Date" else f"{name} {value}"
        for name, value in origin
        if name in ("Patient", "Reference", "Date")
    ]
    return " · ".join([title, *shown])


class ReportError(RuntimeError):
    """Raised when a dependency for writing a report is missing."""


def report_html(
    profile: Profile,
    after: Profile | None = None,
    *,
    label: str = "",
    after_label: str = "",
    reference: str = "",
    patient: str = "",
    examiner: str = "",
    has_charts: bool = True,
    people: int | None = None,
    notation: Notation = "decimal",
    progress: ProgressCallback | None = None,
) -> str:
    """Return a report on one or two eyes as a single HTML document.

    Letter charts use `EyeFilter` instances shared by the process.  Call this from the
    thread that uses them, or pass ``has_charts=False``.

    Parameters
    ----------
    profile, after : EyeProfile, mapping, preset name or path
        With ``after``, the report starts with the differences.
    label, after_label : str
        Names of the eyes, instead of their profiles' names; at most 60 characters.
    reference, patient, examiner : str
        Record or order number, patient name and examiner name, shown in the header; at
        most 60 characters each.
    has_charts : bool
        Whether to filter letter charts (about a quarter of the run time).
    people : int, optional
        Number of persons, 2 to 1000, to draw from the population: curves of one eye get
        bands of them (0.3 s per person on two cores).
    notation : {"decimal", "feet", "meters", "log_mar"}
        Notation of acuities, beside logMAR.
    progress : callable, optional
        Called with a fraction and a stage.

    Raises
    ------
    ValueError
        If a profile is invalid, no light passes through an eye, a text is too long or
        cannot be printed, or there is nothing to draw.
    """
    record = Record(patient=patient, examiner=examiner, reference=reference)
    eyes = compute_eye_facts(
        [profile] if after is None else [profile, after],
        labels=(label, after_label),
        has_charts=has_charts,
        people=people,
        notation=notation,
        progress=progress,
    )
    text = html_of(document_of(eyes, record))
    if progress is not None:
        progress(1.0, "writing")
    return text


def compute_eye_facts(
    profiles: list[Profile],
    *,
    labels: tuple[str, ...] = ("", ""),
    has_charts: bool = True,
    people: int | None = None,
    notation: Notation = "decimal",
    progress: ProgressCallback | None = None,
) -> list[EyeFacts]:
    """Compute the content of a report on one or two eyes.

    Raises
    ------
    ValueError
        If a profile or a label is invalid, no light passes through an eye, or persons
        cannot be drawn: for two eyes, or because they would not differ.
    """
    for field, label in zip(("label", "after_label"), labels, strict=False):
        check_text(field, label)
    if people is not None:
        if len(profiles) > 1:
            raise ValueError(
                f"people is {people}, but a comparison of two eyes draws no persons; "
                "expected one profile"
            )
        drawn_profiles(profile_of(profiles[0]), people)  # fail early
    share = WRITING_START_FRACTION / len(profiles)
    report = progress or (lambda fraction, stage: None)

    def part_of_progress(k: int) -> ProgressCallback:
        return lambda done, stage: report((k + done) * share, stage)

    eyes = [
        facts_of(
            profile,
            label=label,
            has_charts=has_charts,
            people=people,
            notation=notation,
            progress=part_of_progress(k),
        )
        for k, (profile, label) in enumerate(zip(profiles, labels, strict=False))
    ]
    report(WRITING_START_FRACTION, "writing")
    if len(eyes) == 1:
        return eyes
    before, after = eyes
    names = distinct_labels(
        (before.label, after.label),
        (before.study.profile.eye_side, after.study.profile.eye_side),
    )
    return [replace(facts, label=name) for facts, name in zip(eyes, names, strict=True)]


def _compute_curves(eyes: list[EyeFacts]) -> None:
    """Compute the curves of acuity by distance on all cores, before they are drawn.

    They take a third of the time of a report with a multifocal lens.
    """
    curves = [(facts.study, pupil_mm) for facts in eyes for pupil_mm in PUPILS_MM]
    with ThreadPoolExecutor(thread_count()) as pool:
        for curve in [pool.submit(study.acuity, mm) for study, mm in curves]:
            curve.result()


def document_of(eyes: list[EyeFacts], record: Record | None = None) -> Document:
    """Return the report document for one eye, or a comparison of two."""
    _compute_curves(eyes)
    document = eye_document(*eyes) if len(eyes) == 1 else comparison_document(*eyes)
    origin = origin_of(eyes, record or Record())
    return replace(
        document, origin=origin, running=running_footer(document.title, origin)
    )


def write_report(
    eyes: list[EyeFacts], path: Path, record: Record | None = None
) -> None:
    """Write a report as ``.html``, or as ``.pdf`` tagged for screen readers.

    Only the owner can read the file, because it contains names and prescriptions.

    Raises
    ------
    ReportError
        If PDF output is unavailable (missing dependency).
    OSError
        If the file cannot be written.
    """
    text = html_of(document_of(eyes, record))
    if path.suffix.lower() != ".pdf":
        write_atomically(path, text)
        return
    pdf: bytes = check_pdf()(string=text).write_pdf(pdf_variant="pdf/ua-1")
    write_atomically(path, pdf)


def check_pdf() -> Any:
    """Return the class that writes PDF files from HTML.

    Raises
    ------
    ReportError
        If PDF output is unavailable (missing dependency).
    """
    accepts_truncated = ImageFile.LOAD_TRUNCATED_IMAGES
    try:
        from weasyprint import HTML
    except ImportError:
        raise ReportError(
            "PDF output requires WeasyPrint: `pip install 'ocufilter[report]'`. HTML "
            "reports need no extra packages."
        ) from None
    except OSError as error:
        raise ReportError(
            f"PDF output requires the system library Pango ({error}): `apt-get install "
            f"{' '.join(PANGO_PACKAGES)}`. HTML reports need no extra packages."
        ) from None
    finally:  # WeasyPrint has all images of the process accepted that end early
        ImageFile.LOAD_TRUNCATED_IMAGES = accepts_truncated
    return HTML


def report_numbers(eyes: list[EyeFacts]) -> dict[str, Any]:
    """Return the numbers of a report, ready for JSON."""
    if len(eyes) == 1:
        return eyes[0].numbers
    return {"before": eyes[0].numbers, "after": eyes[1].numbers}
