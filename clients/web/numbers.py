"""Numeric entries with limits; error messages contain the allowed range."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

DEGREE = "°"
MINUS_SIGNS = str.maketrans({"\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", ",": "."})

_POWER = r"([+-]?\d+(?:\.\d+)?)"
_PRESCRIPTION = re.compile(
    rf"{_POWER}\s*(?:[/;]\s*|\s+|(?=[+-])){_POWER}\s*"
    r"(?:[x×*@/;]|ax(?:is|e)?\.?|\s)\s*(\d{1,3})\s*°?",
    re.IGNORECASE | re.ASCII,
)


@dataclass(frozen=True)
class NumberField:
    """One number of a form.

    Attributes
    ----------
    name : str
        Profile field, with its unit.
    label, unit : str
        As displayed.
    low, high : float
        Allowed range.
    step : float
        Step of arrow keys and sliders.
    digits : int
        Decimals shown.
    is_signed : bool
        Whether a plus sign is shown, as on a prescription.
    """

    name: str
    label: str
    unit: str
    low: float
    high: float
    step: float
    digits: int = 2
    is_signed: bool = False

    @property
    def allowed(self) -> str:
        """Return the range as text."""
        limits = f"{self.low:g} to {self.with_unit(f'{self.high:g}')}"
        return limits.replace("-", "\N{MINUS SIGN}")

    def read(self, text: str) -> float:
        """Return the number in a text; a comma may be the decimal point.

        Raises
        ------
        ValueError
            If it is not a number or out of range; the message contains the text and the
        allowed range.
        """
        shown = text.strip()
        if not shown:
            raise ValueError(f"{self.label} is empty; allowed: {self.allowed}")
        try:
            value = float(shown.translate(MINUS_SIGNS))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"“{shown:.20}” is not a number; allowed: {self.allowed}")
        if not self.low <= value <= self.high:
            raise ValueError(f"{shown:.20} is out of range; allowed: {self.allowed}")
        return value

    def within(self, sent: object) -> float | None:
        """Return a browser's value clamped to the range; None if it is not a number."""
        if not isinstance(sent, int | float) or math.isnan(sent):
            return None
        return float(min(max(sent, self.low), self.high))

    def problem(self, text: str) -> str | None:
        """Return the error message for a text, or None."""
        try:
            self.read(text)
        except ValueError as error:
            return str(error)
        return None

    def show(self, value: float) -> str:
        """Return a value as displayed in the form."""
        sign = "+" if self.is_signed and value > 0 else ""
        return f"{sign}{value:.{self.digits}f}"

    def normalized(self, text: str) -> str:
        """Return a valid text as displayed, "-4" as "-4.00"; others unchanged."""
        try:
            return self.show(self.read(text))
        except ValueError:
            return text

    def with_unit(self, text: str) -> str:
        """Return a number's text followed by its unit."""
        return f"{text}{'' if self.unit == DEGREE else ' '}{self.unit}"

    def stepped(self, text: str, steps: int) -> str:
        """Return the text of the value changed by some steps, within the range."""
        try:
            value = self.read(text)
        except ValueError:
            return text
        grid = round(value / self.step) + steps
        return self.show(min(max(grid * self.step, self.low), self.high))


def distance_text(vergence_dpt: float) -> str:
    """Return a distance in dpt and in meters or centimeters."""
    if vergence_dpt < 0.005:
        return "0 dpt · far away"
    meters = 1.0 / vergence_dpt
    distance = f"{100 * meters:.0f} cm" if meters < 1.0 else f"{meters:.1f} m"
    return f"{vergence_dpt:.2f} dpt · {distance}"


def prescription_texts(text: str) -> tuple[str, str, str] | None:
    """Return sphere, cylinder and axis of a text as "-3.5 -1.25 x 80".

    None if the text has another form.
    """
    found = _PRESCRIPTION.fullmatch(text.strip().translate(MINUS_SIGNS))
    return None if found is None else (found[1], found[2], found[3])
