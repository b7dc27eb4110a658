"""Identification of a report: patient, reference, date, version and profiles."""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import datetime

from clients.report.facts import EyeFacts
from clients.report.labels import check_text
from filter_service import __version__

SHOWN_DIGITS = 16
"""Digits of a profile's digest that are shown: 64 bits."""


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
