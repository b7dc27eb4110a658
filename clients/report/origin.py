"""Identification of a report: reference, date, version and profiles."""

from __future__ import annotations

from datetime import datetime
from importlib.metadata import version

from clients.report.facts import EyeFacts

SHOWN_DIGITS = 16
"""Digits of a profile's digest that are shown: 64 bits."""


def origin_of(eyes: list[EyeFacts], reference: str) -> tuple[tuple[str, str], ...]:
    """Return names and values that identify a report."""
    digests = " → ".join(facts.study.profile.digest[:SHOWN_DIGITS] for facts in eyes)
    entries = (
        ("Reference", reference),
        ("Date", f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"),
        ("Version", f"ocufilter {version('ocufilter')}"),
        ("Profile", digests),
    )
    return tuple((name, value) for name, value in entries if value)
