"""Pupil and focus of each frame: fixed, from a list, or by what the frame shows."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.batch.source import center_depth_m
from filter_service.settings import MAX_PUPIL_MM, MAX_VERGENCE_DPT, MIN_PUPIL_MM

CENTER = "center"
CENTER_RANGE_DPT = (0.0, 10.0)
"""Focus that is chosen by depth: nobody looks at what is nearer than 10 cm."""

COLUMNS = ("frame", "pupil_mm", "focus_dpt")


@dataclass(frozen=True)
class States:
    """The eye's state in each frame.

    Attributes
    ----------
    pupil_mm : float
    focus_dpt : float, optional
        None: at the depth of the frame's middle.
    listed : mapping of frames' names to (pupil_mm, focus_dpt)
        Of a list; None where its columns lack, which the two above are for.
    """

    pupil_mm: float
    focus_dpt: float | None
    listed: dict[str, tuple[float | None, float | None]] | None = None

    def of(self, name: str, depth_m: NDArray[np.float32]) -> tuple[float, float]:
        """Return pupil in mm and focus in dpt of a frame."""
        pupil_mm, focus_dpt = (self.listed or {}).get(name, (None, None))
        if focus_dpt is None:
            focus_dpt = self.focus_dpt
        if focus_dpt is None:
            low_dpt, high_dpt = CENTER_RANGE_DPT
            focus_dpt = min(max(1.0 / center_depth_m(depth_m), low_dpt), high_dpt)
        return self.pupil_mm if pupil_mm is None else pupil_mm, focus_dpt

    @property
    def pupil_range_mm(self) -> tuple[float, float]:
        """Return the smallest and the largest pupil."""
        return self._range(0, (self.pupil_mm, self.pupil_mm))

    @property
    def focus_range_dpt(self) -> tuple[float, float]:
        """Return the farthest and the nearest focus."""
        focus_dpt = self.focus_dpt
        usual = CENTER_RANGE_DPT if focus_dpt is None else (focus_dpt, focus_dpt)
        return self._range(1, usual)

    def _range(self, column: int, usual: tuple[float, float]) -> tuple[float, float]:
        values = [state[column] for state in (self.listed or {}).values()]
        known = [value for value in values if value is not None]
        return (min(known), max(known)) if known else usual

    def described(self) -> dict[str, Any]:
        """Return what decides the states, as plain values."""
        focus = CENTER if self.focus_dpt is None else self.focus_dpt
        return {"pupil_mm": self.pupil_mm, "focus_dpt": focus, "listed": self.listed}

    def check(self, names: Sequence[str]) -> None:
        """Refuse a list that lacks frames.

        Raises
        ------
        ValueError
            Names the first.
        """
        if self.listed is None:
            return
        lacking = [name for name in names if name not in self.listed]
        if lacking:
            raise ValueError(
                f"--states: no line for frame '{lacking[0]}' ({len(lacking)} of "
                f"{len(names)} frames have none)"
            )


def read_states(
    path: Path, names: Sequence[str]
) -> dict[str, tuple[float | None, float | None]]:
    """Read a list of states: CSV with the columns frame, pupil_mm and focus_dpt.

    One of the last two may be left out.  A frame of a video may be given by its
    number alone.

    Raises
    ------
    ValueError
        Names the line, the value and what is allowed.
    """
    by_number = {int(name): name for name in names if name.isdecimal()}
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        columns = rows.fieldnames or []
        if "frame" not in columns or not set(columns) <= set(COLUMNS):
            raise ValueError(
                f"--states '{path}': columns {', '.join(columns) or 'none'}; allowed: "
                f"{', '.join(COLUMNS)}"
            )
        found = {}
        for row in rows:
            name = row["frame"]
            if name not in names and name.isdecimal():
                name = by_number.get(int(name), name)
            where = f"--states '{path}', line {rows.line_num}"
            found[name] = (
                _number(row, "pupil_mm", (MIN_PUPIL_MM, MAX_PUPIL_MM), where),
                _number(row, "focus_dpt", (0.0, MAX_VERGENCE_DPT), where),
            )
    return found


def _number(
    row: dict[str, str | None], column: str, limits: tuple[float, float], where: str
) -> float | None:
    text = row.get(column)
    if text is None and column not in row:
        return None
    low, high = limits
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise ValueError(f"{where}: {column} '{text}'; allowed: {low:g} to {high:g}")
    return value
