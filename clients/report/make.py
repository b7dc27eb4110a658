"""Reports from profiles: as HTML text, as a file, or as numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from clients.figures.study import Profile, Report
from clients.report.blocks import Document
from clients.report.comparison import comparison_document
from clients.report.content import eye_document
from clients.report.facts import EyeFacts, facts_of
from clients.report.html_page import html_of
from clients.report.labels import distinct_labels
from clients.report.origin import Record, origin_of, running_text

SUFFIXES = (".html", ".pdf")
PANGO_PACKAGES = ("libpango-1.0-0", "libpangoft2-1.0-0", "libharfbuzz-subset0")
"""Debian packages of the system libraries that WeasyPrint loads."""

WRITING_AT = 0.85
"""Progress at which the eyes are computed and writing begins."""


class ReportError(RuntimeError):
    """A report that cannot be written here."""


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
    progress: Report | None = None,
) -> str:
    """Return the report of one or two eyes as the text of one HTML file.

    Letter charts use the process's `EyeFilter`s: call this in the thread that uses
    them, or without charts.

    Parameters
    ----------
    profile, after : EyeProfile, mapping, preset's name or file
        With ``after``, the report starts with the differences.
    label, after_label : str
        Names of the eyes, instead of their profiles' names.
    reference, patient, examiner : str
        Identifier of a record or an order, and names, shown in the header; 60
        characters at most.
    has_charts : bool
        Whether to filter letter charts, which takes a quarter of the time.
    progress : callable, optional
        Called with a fraction and a stage.

    Raises
    ------
    ValueError
        If a profile is invalid, light does not pass an eye, or a text is too long.
    """
    record = Record(patient=patient, examiner=examiner, reference=reference)
    eyes = eyes_of(
        [profile] if after is None else [profile, after],
        labels=(label, after_label),
        has_charts=has_charts,
        progress=progress,
    )
    text = html_of(document_of(eyes, record))
    if progress is not None:
        progress(1.0, "writing")
    return text


def eyes_of(
    profiles: list[Profile],
    *,
    labels: tuple[str, ...] = ("", ""),
    has_charts: bool = True,
    progress: Report | None = None,
) -> list[EyeFacts]:
    """Compute the content of a report on one or two eyes."""
    share = WRITING_AT / len(profiles)

    def along(k: int) -> Report | None:
        if progress is None:
            return None
        return lambda done, stage: progress((k + done) * share, stage)

    eyes = [
        facts_of(profile, label=label, has_charts=has_charts, progress=along(k))
        for k, (profile, label) in enumerate(zip(profiles, labels, strict=False))
    ]
    if progress is not None:
        progress(WRITING_AT, "writing")
    if len(eyes) == 1:
        return eyes
    before, after = eyes
    names = distinct_labels(
        (before.label, after.label),
        (before.study.profile.eye_side, after.study.profile.eye_side),
    )
    return [replace(facts, label=name) for facts, name in zip(eyes, names, strict=True)]


def document_of(eyes: list[EyeFacts], record: Record | None = None) -> Document:
    """Return the document of one eye, or of the comparison of two."""
    document = eye_document(*eyes) if len(eyes) == 1 else comparison_document(*eyes)
    origin = origin_of(eyes, record or Record())
    return replace(
        document, origin=origin, running=running_text(document.title, origin)
    )


def write_report(
    eyes: list[EyeFacts], path: Path, record: Record | None = None
) -> None:
    """Write a report as ``.html``, or as ``.pdf`` tagged for screen readers.

    Raises
    ------
    ReportError
        If WeasyPrint, or the system library Pango that it needs, is missing.
    OSError
        If the file cannot be written.
    """
    text = html_of(document_of(eyes, record))
    if path.suffix.lower() == ".pdf":
        path.write_bytes(_pdf_of(text))
    else:
        path.write_text(text, encoding="utf-8")


def check_pdf() -> None:
    """Raise an error if PDFs cannot be written here.

    Raises
    ------
    ReportError
        If WeasyPrint, or the system library Pango that it needs, is missing.
    """
    try:
        import weasyprint  # noqa: F401
    except ImportError:
        raise ReportError(
            "PDF needs WeasyPrint: pip install 'ocufilter[report]'; "
            "an .html report needs nothing more"
        ) from None
    except OSError as error:
        raise ReportError(
            f"PDF needs the system library Pango ({error}): apt-get install "
            f"{' '.join(PANGO_PACKAGES)}; an .html report needs nothing more"
        ) from None


def _pdf_of(text: str) -> bytes:
    check_pdf()
    from weasyprint import HTML

    written: bytes = HTML(string=text).write_pdf(pdf_variant="pdf/ua-1")
    return written


def report_numbers(eyes: list[EyeFacts]) -> dict[str, Any]:
    """Return the numbers of a report, ready for JSON."""
    if len(eyes) == 1:
        return eyes[0].numbers
    return {"before": eyes[0].numbers, "after": eyes[1].numbers}
