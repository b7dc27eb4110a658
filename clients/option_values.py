"""Numbers on the command line: errors name the value and the likely mistake.

All commands and programs use these, whichever parser they have.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence

OTHER_UNITS = {
    # unit of an option: other units, and how many of the option's they are
    "mm": (("m", 1000.0), ("um", 0.001)),
    "nm": (("um", 1000.0), ("m", 1e9)),
    "m": (("mm", 0.001), ("cm", 0.01)),
    "deg": (("rad", 57.29577951308232),),
    "s": (("ms", 0.001),),
}
"""Units that people give by mistake, the likely ones first."""

UNITS = (*OTHER_UNITS, "dpt", "px", "hz", "ms", "arcmin", "mrad", "um")
_NUMBER_AND_UNIT = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\W\d]{1,12}|°|%)\s*"
)


def a_number(text: str) -> float:
    """Return a number, as an argparse type.

    Raises
    ------
    argparse.ArgumentTypeError
        If the text is not a number.  The message names the likely mistake.
    """
    try:
        return float(text)
    except ValueError:
        problem = f"'{text:.60}' is not a number{likely_number(text)}"
        raise argparse.ArgumentTypeError(problem) from None


def likely_number(text: str) -> str:
    """Return the number that text probably means, as the end of an error."""
    if text.count(",") == 1:
        with_point = text.replace(",", ".")
        if _is_number(with_point):
            return f"; allowed: a decimal point, as in {with_point.strip()}"
    if match := _NUMBER_AND_UNIT.fullmatch(text):
        return f"; allowed: a number without '{match[2]}', as in {match[1]}"
    return "; allowed: a number"


def check_range(option: str, value: float, limits: tuple[float, float]) -> None:
    """Check that a number is within ``limits`` and not NaN.

    Raises
    ------
    ValueError
        If it is not.  The message names the option, the value, the range and, if the
        value fits in another unit, that unit.
    """
    low, high = limits
    if not low <= value <= high:
        hint = likely_unit(option, value, limits)
        raise ValueError(f"{option} is {value:g}; allowed: {low:g} to {high:g}{hint}")


def likely_unit(name: str, value: float, limits: tuple[float, float]) -> str:
    """Return the unit in which a value fits an option, as the end of an error."""
    unit = re.split("[-_]", name)[-1]
    low, high = limits
    for other, factor in OTHER_UNITS.get(unit, ()):
        if low <= factor * value <= high:
            return f" {unit} ({value:g} {other} is {factor * value:.4g} {unit})"
    return f" {unit}" if unit in UNITS else ""


def given_value(options: Sequence[str], arguments: Sequence[str]) -> str | None:
    """Return the last text that a command line gives for an option with these names."""
    found = None
    for k, argument in enumerate(arguments):
        name, is_joined, value = argument.partition("=")
        if name in options:
            found = value if is_joined else next(iter(arguments[k + 1 :]), None)
    return found


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
