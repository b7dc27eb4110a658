"""Validation of single profile fields; errors name the field and its range."""

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any

from estimator.bounded_files import printable

MAX_COMPARED = 60
MAX_FIELD, MAX_PROBLEM = 200, 400
"""Length limits of the parts of a message that repeat a profile."""

WHOLE = "profile"
"""Field name of an error that concerns the whole profile."""


class ProfileError(ValueError):
    """Wrong or incomplete profile data.

    Attributes
    ----------
    field : str
        Dotted path of the field at fault, e.g. ``correction.axis_deg``.
    problem : str
        Description of the problem.
    allowed : str
        Accepted values of the field.
    """

    def __init__(self, field: str, problem: str, allowed: str):
        self.field = printable(field, most=MAX_FIELD)
        self.problem = printable(problem, most=MAX_PROBLEM)
        self.allowed = printable(allowed)
        named = field if field == WHOLE else f"{WHOLE} field '{self.field}'"
        super().__init__(f"{named}: {self.problem}; allowed: {self.allowed}")


def number(
    data: Mapping[str, Any],
    field: str,
    low: float,
    high: float,
    *,
    default: float | None = None,
    path: str = "",
) -> float:
    """Return a finite number in [low, high]; ``default`` if the field is absent."""
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
    """Return one of ``options``; ``default`` if the field is absent."""
    name, allowed = path + field, "one of " + ", ".join(options)
    value = data.get(field, default)
    if value is None:
        raise ProfileError(name, "is missing", allowed)
    if not isinstance(value, str) or value not in options:
        meant = did_you_mean(value, options)
        raise ProfileError(name, f"{value!r} is unknown{meant}", allowed)
    return value


def did_you_mean(value: object, options: Sequence[str]) -> str:
    """Return a suggestion for an error message, or "" if no option is similar."""
    # A long text is no typing error, and would take long to compare.
    if not isinstance(value, str) or len(value) > MAX_COMPARED:
        return ""
    near = difflib.get_close_matches(value, options, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def mapping(data: object, name: str) -> Mapping[str, Any]:
    """Return ``data`` if it is a mapping with string keys."""
    if not isinstance(data, Mapping) or not all(isinstance(k, str) for k in data):
        raise ProfileError(name, f"{data!r:.60} is not an object", "a JSON object")
    return data


def only_known(
    data: Mapping[str, Any], known: Sequence[str], *, path: str = ""
) -> None:
    """Reject unknown fields, so that a typing error does not pass silently."""
    for field in data:
        if field not in known:
            allowed = "the fields " + ", ".join(known)
            problem = "is not a field of this kind" + did_you_mean(field, known)
            raise ProfileError(path + field, problem, allowed)
