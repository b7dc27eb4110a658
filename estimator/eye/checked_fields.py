"""Checked reading of one field of a profile: every refusal names field and range."""

import math
from collections.abc import Mapping, Sequence
from typing import Any


class ProfileError(ValueError):
    """Wrong or incomplete profile data.

    Attributes
    ----------
    field : str
        Dotted path of the field at fault, e.g. ``correction.axis_deg``.
    allowed : str
        What the field accepts.
    """

    def __init__(self, field: str, problem: str, allowed: str):
        super().__init__(f"profile field '{field}': {problem}; allowed: {allowed}")
        self.field = field
        self.allowed = allowed


def number(
    data: Mapping[str, Any],
    field: str,
    low: float,
    high: float,
    *,
    default: float | None = None,
    path: str = "",
) -> float:
    """Finite number in [low, high]; ``default`` where the field is absent."""
    name, allowed = path + field, f"a number from {low:g} to {high:g}"
    value = data.get(field, default)
    if value is None:
        raise ProfileError(name, "is missing", allowed)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ProfileError(name, f"{value!r} is not a number", allowed)
    if not math.isfinite(value) or not low <= value <= high:
        raise ProfileError(name, f"{value!r} is out of range", allowed)
    return float(value)


def choice(
    data: Mapping[str, Any],
    field: str,
    options: Sequence[str],
    *,
    default: str | None = None,
    path: str = "",
) -> str:
    """One of ``options``; ``default`` where the field is absent."""
    name, allowed = path + field, "one of " + ", ".join(options)
    value = data.get(field, default)
    if value is None:
        raise ProfileError(name, "is missing", allowed)
    if not isinstance(value, str) or value not in options:
        raise ProfileError(name, f"{value!r} is unknown", allowed)
    return value


def mapping(data: object, name: str) -> Mapping[str, Any]:
    """Return ``data`` if it is a mapping with string keys."""
    if not isinstance(data, Mapping) or not all(isinstance(k, str) for k in data):
        raise ProfileError(name, f"{data!r:.60} is not an object", "a JSON object")
    return data


def only_known(
    data: Mapping[str, Any], known: Sequence[str], *, path: str = ""
) -> None:
    """Refuse a field that nobody reads: a typing slip must not pass silently."""
    for field in data:
        if field not in known:
            allowed = "the fields " + ", ".join(known)
            raise ProfileError(path + field, "is not a field of this kind", allowed)
