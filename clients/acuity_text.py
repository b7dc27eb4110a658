"""Visual acuity in the notations that people use: 20/40, 6/12, 0.50, logMAR 0.3."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

Notation = Literal["decimal", "feet", "meters", "log_mar"]

NOTATION_TITLES: Mapping[Notation, str] = {
    "decimal": "Decimal, 1.00",
    "feet": "20/20",
    "meters": "6/6",
    "log_mar": "logMAR alone",
}

NUMERATORS: Mapping[Notation, int] = {"feet": 20, "meters": 6}
"""Distance of the chart in feet or meters, the first number of a Snellen fraction."""


def acuity_text(log_mar: float, notation: Notation) -> str:
    """Return an acuity in a notation, without its name.

    Parameters
    ----------
    log_mar : float
        Logarithm of the minimum angle of resolution in arcmin; 0 is 20/20.
    notation : "decimal", "feet", "meters" or "log_mar"
        The second number of a fraction has one decimal below 10, else none.

    Raises
    ------
    ValueError
        If the acuity is not finite, or the notation is unknown.
    """
    if not math.isfinite(log_mar):
        raise ValueError(f"log_mar is {log_mar}; allowed: finite numbers")
    if notation == "log_mar":
        rounded = round(log_mar, 1) + 0.0  # no minus before 0
        return f"{rounded:.1f}".replace("-", "\N{MINUS SIGN}")
    if notation == "decimal":
        return f"{10.0**-log_mar:.2f}"
    if notation not in NUMERATORS:
        allowed = ", ".join(NOTATION_TITLES)
        raise ValueError(f"notation is {notation!r}; allowed: {allowed}")
    numerator = NUMERATORS[notation]
    below = numerator * 10.0**log_mar
    shown = f"{below:.0f}" if below >= 9.95 else f"{below:.1f}".removesuffix(".0")
    return f"{numerator}/{shown}"
