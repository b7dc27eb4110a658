"""Identification of a report: patient, reference, date, version and profiles."""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import datetime
from importlib.metadata import version

from clients.report.facts import EyeFacts

SHOWN_DIGITS = 16
"""Digits of a profile's digest that are shown: 64 bits."""

MAX_TEXT_LENGTH = 60
"""Maximum length of a text, so that all texts fit in the page margin."""


@dataclass(frozen=True)
class Record:
    """Identification of a report entered by the user; empty texts are omitted.

    Raises
    ------
    ValueError
        If a text is too long.
    """

    patient: str = ""
    examiner: str = ""
    reference: str = ""

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):
            length = len(getattr(self, name))
            if length > MAX_TEXT_LENGTH:
                raise ValueError(
                    f"{name} has {length} characters; allowed: at most "
                    f"{MAX_TEXT_LENGTH}"
                )


def origin_of(eyes: list[EyeFacts], record: Record) -> tuple[tuple[str, str], ...]:
    """Return names and values that identify a report."""
    digests = " → ".join(facts.study.profile.digest[:SHOWN_DIGITS] for facts in eyes)
    entries = (
        ("Patient", record.patient),
        ("Examiner", record.examiner),
        ("Reference", record.reference),
        ("Date", f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"),
        ("Version", f"ocufilter {version('ocufilter')}"),
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
