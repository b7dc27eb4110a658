"""Names of the eyes of a report: given, of the profile, or by side and order."""

from __future__ import annotations

from estimator import EyeProfile

SIDE_NAMES = {"OD": "right eye", "OS": "left eye"}
ORDINALS = ("first", "second")


def own_name(profile: EyeProfile) -> str:
    """Return a profile's name; empty if it has none."""
    return "" if profile.name == profile.kind else profile.name


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
