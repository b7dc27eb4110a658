"""Pupil and focus of each frame: fixed, from a list, or from the frame's depth."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.batch.layout_pairs import same_text
from clients.batch.source import center_depth_m
from estimator.bounded_files import InvalidFile, read_text
from filter_service.settings import MAX_PUPIL_MM, MAX_VERGENCE_DPT, MIN_PUPIL_MM

CENTER = "center"
CENTER_RANGE_DPT = (0.0, 10.0)
"""Range of a focus that follows depth: few eyes focus closer than 10 cm."""

COLUMNS = ("frame", "pupil_mm", "focus_dpt")


@dataclass(frozen=True)
class States:
    """State of the eye in each frame.

    Attributes
    ----------
    pupil_mm : float
        Pupil of frames whose pupil is not listed.
    focus_dpt : float or None
        Focus of frames whose focus is not listed; None is the depth at the center.
    listed : dict, optional
        (pupil_mm, focus_dpt) by frame name; a missing column is None.
    """

    pupil_mm: float
    focus_dpt: float | None
    listed: dict[str, tuple[float | None, float | None]] | None = None

    def of(self, name: str, depth_m: NDArray[np.float32]) -> tuple[float, float]:
        """Return the pupil in mm and the focus in dpt of a frame."""
        pupil_mm, focus_dpt = (self.listed or {}).get(name, (None, None))
        if focus_dpt is None:
            focus_dpt = self.focus_dpt
        if focus_dpt is None:
            low_dpt, high_dpt = CENTER_RANGE_DPT
            nearest_m = 1.0 / high_dpt  # avoids division by a tiny depth
            focus_dpt = max(1.0 / max(center_depth_m(depth_m), nearest_m), low_dpt)
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
        """Return the parameters that determine the states, for JSON."""
        focus = CENTER if self.focus_dpt is None else self.focus_dpt
        return {"pupil_mm": self.pupil_mm, "focus_dpt": focus, "listed": self.listed}

    def check(self, names: Sequence[str]) -> None:
        """Check that the list contains all frames.

        Raises
        ------
        ValueError
            If it does not.  The message names the first missing frame.
        """
        if self.listed is None:
            return
        lacking = [name for name in names if name not in self.listed]
        if lacking:
            raise ValueError(
                f"--states: no line for frame '{lacking[0]}' ({len(lacking)} of "
                f"{len(names)} frames are missing)"
            )


def read_states(
    path: Path, names: Sequence[str]
) -> dict[str, tuple[float | None, float | None]]:
    """Read a list of states: CSV with the columns frame, pupil_mm and focus_dpt.

    One of the last two may be omitted. A frame of a video may be named by its number.

    Raises
    ------
    InvalidFile
        If a value is invalid.  The message names the line, the value and the range.
    """
    text = read_text(path, option="states")
    try:
        return _states_of(text, path, names)
    except csv.Error as error:
        raise InvalidFile(path, f"not CSV ({error})", "CSV", "states") from None


def _states_of(
    text: str, path: Path, names: Sequence[str]
) -> dict[str, tuple[float | None, float | None]]:
    known = {same_text(name): name for name in names}
    by_number = {int(name): name for name in names if _is_number(name)}
    rows = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    columns = rows.fieldnames or []
    if "frame" not in columns or not set(columns) <= set(COLUMNS):
        found_text = f"columns {', '.join(columns) or 'none':.100}"
        raise InvalidFile(path, found_text, ", ".join(COLUMNS), "states")
    found = {}
    for row in rows:
        where = f"line {rows.line_num}"
        name = row["frame"]
        if name is None:
            raise InvalidFile(path, f"{where}: no frame", "a name", "states")
        if same_text(name) in known:
            name = known[same_text(name)]
        elif _is_number(name):
            name = by_number.get(int(name), name)
        state = []
        for column, low, high in (
            ("pupil_mm", MIN_PUPIL_MM, MAX_PUPIL_MM),
            ("focus_dpt", 0.0, MAX_VERGENCE_DPT),
        ):
            value = _number(row.get(column)) if column in row else None
            if value is not None and not low <= value <= high:
                found_text = f"{where}: {column} '{row[column]!s:.40}'"
                allowed = f"{low:g} to {high:g}"
                raise InvalidFile(path, found_text, allowed, "states")
            state.append(value)
        found[name] = (state[0], state[1])
    return found


def _is_number(name: str) -> bool:
    return name.isdecimal() and len(name) < 20


def _number(text: str | None) -> float:
    """Return a number, or NaN for other text."""
    try:
        return float(text or "")
    except ValueError:
        return float("nan")
