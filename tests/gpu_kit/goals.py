"""Goals beside what was measured; goals.json has them, each with its source."""

import json
from dataclasses import dataclass, field
from pathlib import Path

FILE = Path(__file__).parent / "goals.json"

MET, MISSED, NOT_JUDGED, NOT_MEASURED = "met", "missed", "not judged", "not measured"


@dataclass(frozen=True)
class Goal:
    """What a number of a result should be.

    Attributes
    ----------
    what, unit, source : str
    step : str
        Whose result it is read from.
    row : dict
        Fields of the row.
    value : str
        Which number of the row.
    quick_row : dict
        Fields that differ in a quick run, whose frames are smaller.
    at_most, at_least : float or None
        A goal without either is only reported.
    """

    what: str
    unit: str
    step: str
    row: dict
    value: str
    source: str
    quick_row: dict = field(default_factory=dict)
    at_most: float | None = None
    at_least: float | None = None

    @property
    def wanted(self) -> str:
        """The bound in words."""
        if self.at_most is not None:
            return f"<= {self.at_most:g} {self.unit}"
        if self.at_least is not None:
            return f">= {self.at_least:g} {self.unit}"
        return "-"

    def measured(self, content: dict, *, is_quick: bool = False) -> float | None:
        """Return the number in a result; None where the row is not there.

        Raises
        ------
        ValueError
            Several rows are meant.
        """
        wanted = self.row | (self.quick_row if is_quick else {})
        found = [row for row in content.get("rows", []) if _fits(row, wanted)]
        if len(found) > 1:
            raise ValueError(f"goal '{self.what}': {len(found)} rows are {wanted}")
        return found[0].get(self.value) if found else None

    def verdict(self, value: float | None, *, is_judged: bool = True) -> str:
        """Say whether a number is what it should be."""
        if value is None:
            return NOT_MEASURED
        if not is_judged or self.at_most is self.at_least is None:
            return NOT_JUDGED
        low = -float("inf") if self.at_least is None else self.at_least
        high = float("inf") if self.at_most is None else self.at_most
        return MET if low <= value <= high else MISSED


def _fits(row: dict, wanted: dict) -> bool:
    """Whether a row has these fields; methods are indented in some results."""
    return all(str(row.get(name, "")).strip() == text for name, text in wanted.items())


def read_goals(file: Path = FILE) -> list[Goal]:
    """Read all goals."""
    return [Goal(**body) for body in json.loads(file.read_text(encoding="utf-8"))]
