"""Errors of profiles, which name the field and the allowed values."""

import difflib
from collections.abc import Sequence

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


def did_you_mean(value: object, options: Sequence[str]) -> str:
    """Return a suggestion for an error message, or "" if no option is similar."""
    # A long text is no typing error, and would take long to compare.
    if not isinstance(value, str) or len(value) > MAX_COMPARED:
        return ""
    near = difflib.get_close_matches(value, options, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""
