"""Numbers as the page prints them: three digits, and units that a reader knows."""

import math
from collections.abc import Sequence
from statistics import median

EMPTY = "–"
SECONDS_OF = {"ms": 1e-3, "s": 1.0, "h": 3600.0}
SMALLEST_PLAIN = 1e-4


def value_text(value: float | str | None, unit: str) -> str:
    """Print one value; a time in whatever unit suits it."""
    if value is None:
        return EMPTY
    if isinstance(value, str):
        return value
    if unit in SECONDS_OF:
        return _time_text(value * SECONDS_OF[unit])
    if unit == "dB":
        return f"{value:.1f} dB"
    if unit in ("layers", "PSFs"):
        return f"{value:,.0f}"
    return f"{number_text(value)} {unit}"


def number_text(value: float) -> str:
    """Print three significant digits, the smallest ones as powers of ten."""
    if value == 0.0:
        return "0"
    size = abs(value)
    if size < SMALLEST_PLAIN:
        exponent = math.floor(math.log10(size))
        return f"{value / 10.0**exponent:.1f}·10<sup>{exponent}</sup>"
    digits = max(0, 2 - math.floor(math.log10(size)))
    return f"{value:,.{digits}f}"


def _time_text(seconds: float) -> str:
    if seconds >= 3600.0:
        return f"{number_text(seconds / 3600.0)} h"
    if seconds >= 1.0:
        return f"{number_text(seconds)} s"
    return f"{number_text(1e3 * seconds)} ms"


def median_text(values: Sequence[float | str | None], unit: str) -> str:
    """Print the median of what are numbers."""
    numbers = _numbers(values)
    return value_text(median(numbers), unit) if numbers else EMPTY


def range_text(values: Sequence[float | str | None], unit: str) -> str:
    """Print the smallest and the largest of what are numbers."""
    numbers = _numbers(values)
    low, high = (value_text(v, unit) for v in (min(numbers), max(numbers)))
    return low if low == high else f"{low} to {high}"


def _numbers(values: Sequence[float | str | None]) -> list[float]:
    return [v for v in values if v is not None and not isinstance(v, str)]
