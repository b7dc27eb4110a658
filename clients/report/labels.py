"""Names of the eyes of a report: given, of the profile, or by side and order."""

from __future__ import annotations

import unicodedata

from estimator import EyeProfile
from estimator.bounded_files import printable

SIDE_NAMES = {"OD": "right eye", "OS": "left eye"}
ORDINALS = ("first", "second")

MAX_TEXT_LENGTH = 60
"""Maximum length of a text, so that all texts fit in the page margin."""

JOINERS = "\u200c\u200d"
"""Invisible characters that some scripts need."""


def check_text(field: str, text: str) -> None:
    """Reject a text that cannot be printed in one line of the page margin.

    Raises
    ------
    ValueError
        If it is too long, or contains a line break or another control character.
    """
    if len(text) > MAX_TEXT_LENGTH:
        raise ValueError(
            f"{field} has {len(text)} characters; allowed: at most {MAX_TEXT_LENGTH}"
        )
    for character in text:
        is_space = unicodedata.category(character) == "Zs"  # also wide ones
        if not (character.isprintable() or is_space or character in JOINERS):
            raise ValueError(
                f"{field} contains {character!a}; allowed: printable characters"
            )


def shortened(name: str) -> str:
    """Return the name of a profile or file as a text that fits."""
    return printable(printable(name), most=MAX_TEXT_LENGTH)


def own_name(profile: EyeProfile) -> str:
    """Return a profile's name, shortened; empty if it has none."""
    return "" if profile.name == profile.kind else shortened(profile.name)


def distinct_labels(labels: tuple[str, str], sides: tuple[str, str]) -> tuple[str, str]:
    """Return two labels that differ: by side if the sides differ, otherwise by order.

    Parameters
    ----------
    labels : (str, str)
        Names of the eyes; empty for an eye without a name.
    sides : (str, str)
        OD or OS.
    """
    differ = sides[0] != sides[1]
    names = [
        label or (SIDE_NAMES[side] if differ else f"{ordinal} eye")
        for label, side, ordinal in zip(labels, sides, ORDINALS, strict=True)
    ]
    if names[0] == names[1]:
        marks = [SIDE_NAMES[side] for side in sides] if differ else ORDINALS
        names = [f"{name} ({mark})" for name, mark in zip(names, marks, strict=True)]
    return names[0], names[1]
