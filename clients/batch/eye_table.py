"""Eyes of single images from a table: a row per image, or per glob.

image,profile,pupil_mm,focus_dpt,distance_m,gaze_h_deg,gaze_v_deg
cats/*,myopia,3.5,0.5,2,0,0
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import translate
from pathlib import Path
from typing import Any

from clients.batch.eyes import NamedEye, narrow_settings
from clients.batch.source import (
    CENTER,
    CENTER_RANGE_DPT,
    Constant,
    FrameEye,
    SourceFrame,
    States,
    number_or_nan,
    same_text,
)
from clients.batch.views import DISTANCE_LIMITS_M
from clients.batch.work import checked_settings
from clients.provenance import fingerprint, folder_name, profile_name
from estimator import (
    InvalidFile,
    parse_profile,
    preset_names,
    profile_body,
    published_names,
)
from estimator.bounded_files import read_text
from filter_service import FilterSettings
from filter_service.settings import (
    MAX_GAZE_DEG,
    MAX_PUPIL_MM,
    MAX_VERGENCE_DPT,
    MIN_PUPIL_MM,
)

LIMITS = {
    "pupil_mm": (MIN_PUPIL_MM, MAX_PUPIL_MM),
    "focus_dpt": (0.0, MAX_VERGENCE_DPT),
    "distance_m": DISTANCE_LIMITS_M,
    "gaze_h_deg": (-MAX_GAZE_DEG, MAX_GAZE_DEG),
    "gaze_v_deg": (-MAX_GAZE_DEG, MAX_GAZE_DEG),
}
STATE_COLUMNS = ("profile", "pupil_mm", "focus_dpt")
COLUMNS = ("image", "profile", *LIMITS)
MAX_GLOBS = 1000
"""Globs in a table, each of which is compared with the names of all images."""

MAX_DIGITS = 20
"""Digits of the number of a frame."""

_GLOB = re.compile(r"[*?\[]")


@dataclass(frozen=True)
class EyeRow:
    """A row of a table.

    Attributes
    ----------
    line : int
        Number of the line in the file.
    image : str
        Name of an image, or a glob.
    eye : NamedEye
    values : dict
        Values of the columns `LIMITS`; a column is missing if its cell is empty, and
        ``focus_dpt`` is None for the depth at the center.
    """

    line: int
    image: str
    eye: NamedEye
    values: Mapping[str, float | None]


def is_table_of_eyes(path: Path) -> bool:
    """Return whether a table of states has a column of profiles."""
    header = read_text(path, option="states").partition("\n")[0]
    return "profile" in [cell.strip(' "\r') for cell in header.split(",")]


def read_eyes(
    path: Path,
    *,
    option: str = "eyes",
    named: Mapping[str, Mapping[str, Any]],
) -> list[EyeRow]:
    """Read a table of eyes: CSV with the columns `COLUMNS`.

    All columns but the first one may be omitted.  In a table of states, the first one
    is ``frame``, and the others are `STATE_COLUMNS`.

    Parameters
    ----------
    path : Path
    option : "eyes" or "states"
        Option that gives the table.
    named : mapping
        Profiles that rows may name; if there is only one, rows without a profile have
        it.

    Raises
    ------
    InvalidFile
        If a value is invalid.  The message names the line, the column and the value.
    """
    key = "image" if option == "eyes" else "frame"
    allowed = COLUMNS if option == "eyes" else (key, *STATE_COLUMNS)
    rows = csv.DictReader(
        io.StringIO(read_text(path, option=option), newline=""), skipinitialspace=True
    )
    try:
        columns, lines = rows.fieldnames or [], [(rows.line_num, row) for row in rows]
    except csv.Error as error:
        raise InvalidFile(path, f"not CSV ({error})", "CSV", option) from None
    if key not in columns or not set(columns) <= set(allowed):
        found = f"columns {', '.join(columns) or 'none':.100}"
        raise InvalidFile(path, found, ", ".join(allowed), option)
    if len(set(columns)) < len(columns):
        found = f"columns {', '.join(columns):.100}"
        raise InvalidFile(path, found, "each column once", option)
    if not lines:
        raise InvalidFile(path, "no rows", "a row per image", option)
    table = _Table(path, option, named)
    found_rows = []
    for line, row in lines:
        if None in row or None in row.values():
            found = f"line {line}: another number of cells than columns"
            raise InvalidFile(path, found, f"{len(columns)} cells", option)
        values = {
            column: table.value(line, column, row[column])
            for column in columns
            if column in LIMITS and row[column].strip()
        }
        eye = table.eye(line, (row.get("profile") or "").strip())
        found_rows.append(EyeRow(line, row[key], eye, values))
    return found_rows


class _Table:
    """Values of the cells of a table."""

    def __init__(
        self, path: Path, option: str, named: Mapping[str, Mapping[str, Any]]
    ) -> None:
        self._path, self._option = path, option
        self._named = {
            name: NamedEye(name, parse_profile(body), body)
            for name, body in named.items()
        }
        self._by_text: dict[str, NamedEye] = dict(self._named)
        if len(self._named) == 1:
            self._by_text[""] = next(iter(self._named.values()))
        self._names = {eye.name: fingerprint(eye.given) for eye in self._named.values()}

    def value(self, line: int, column: str, cell: str) -> float | None:
        """Return the value of a cell that is not empty."""
        low, high = LIMITS[column]
        is_focus = column == "focus_dpt"
        if is_focus and cell.strip() == CENTER:
            return None
        value = number_or_nan(cell)
        if not low <= value <= high:
            allowed = f"{low:g} to {high:g}" + (f", or {CENTER}" if is_focus else "")
            raise InvalidFile(
                self._path, f"line {line}: {column} '{cell:.40}'", allowed, self._option
            )
        return value

    def eye(self, line: int, cell: str) -> NamedEye:
        """Return the eye of a profile, which is read once."""
        if cell not in self._by_text:
            if not cell:
                allowed = "a profile in each row, or --profile once"
                found = f"line {line}: profile ''"
                raise InvalidFile(self._path, found, allowed, self._option)
            try:
                self._by_text[cell] = self._read(cell)
            except ValueError as error:
                found = f"line {line}: profile '{cell:.60}': {error}"
                allowed = "a preset, a file, JSON, or the name of a --profile"
                raise InvalidFile(self._path, found, allowed, self._option) from None
        return self._by_text[cell]

    def _read(self, cell: str) -> NamedEye:
        what = cell
        if cell not in (*preset_names(), *published_names()) and cell[0] != "{":
            beside = self._path.parent / cell
            with suppress(OSError):  # such as a name that is too long
                what = str(beside) if beside.is_file() else cell
        body = profile_body(what)
        profile = parse_profile(body)
        name, content = profile_name(what, body) or "profile", fingerprint(body)
        if self._names.setdefault(name, content) != content:
            name = f"{name}_{content[:8]}"
            self._names[name] = content
        return NamedEye(folder_name(name), profile, body)


def with_rows(
    frames: Sequence[SourceFrame],
    rows: Sequence[EyeRow],
    usual: States,
    *,
    gaze_deg: tuple[float, float],
    path: Path,
    source: Path,
    option: str = "eyes",
) -> list[SourceFrame]:
    """Return frames with the eyes of a table.

    Parameters
    ----------
    frames : sequence of SourceFrame
    rows : sequence of EyeRow
    usual : States
        State of rows without one; the focus is None for the depth at the center.
    gaze_deg : (h, v)
        Gaze of rows without one, in a table with gazes.
    path, source : Path
        The table, for errors, and the data set.

    Raises
    ------
    InvalidFile
        If a row has no image, an image has no row, or one has two.
    """
    by_name = _by_name(frames, source)
    row_of: dict[str, EyeRow] = {}
    for row, names in _matches(rows, by_name, path, option):
        for name in names:
            other = row_of.setdefault(name, row)
            if other is not row:
                found = f"line {row.line}: '{row.image:.60}' matches '{name}', as line "
                allowed = "one row per image"
                raise InvalidFile(path, f"{found}{other.line} does", allowed, option)
    lacking = [frame.name for frame in frames if frame.name not in row_of]
    if lacking:
        found = f"no line for '{lacking[0]}' ({len(lacking)} of {len(frames)} images)"
        raise InvalidFile(path, found, "a row for each image", option)
    usual_gaze_deg = gaze_deg if any(map(_has_gaze, rows)) else None
    return [
        _with_row(frame, row_of[frame.name], usual, usual_gaze_deg) for frame in frames
    ]


def _by_name(frames: Sequence[SourceFrame], source: Path) -> dict[str, str]:
    """Return the names of frames by the texts that may stand for them in a table."""
    found: dict[str, str] = {}
    for frame in frames:
        if frame.name.isdecimal() and len(frame.name) < MAX_DIGITS:
            found[str(int(frame.name))] = frame.name
        if frame.color_index is None and frame.color.is_relative_to(source):
            path = frame.color.relative_to(source).as_posix()
            found[same_text(path)] = frame.name
    return found | {same_text(frame.name): frame.name for frame in frames}


def _matches(
    rows: Sequence[EyeRow], by_name: Mapping[str, str], path: Path, option: str
) -> Iterator[tuple[EyeRow, Sequence[str]]]:
    """Yield each row and the names of its frames."""
    n_globs = 0
    for row in rows:
        text = same_text(row.image.strip())
        if text not in by_name and text.isdecimal() and len(text) < MAX_DIGITS:
            text = str(int(text))
        names = [by_name[text]] if text in by_name else []
        if not names and option == "eyes" and _GLOB.search(text):
            n_globs += 1
            if n_globs > MAX_GLOBS:
                found = f"line {row.line}: more than {MAX_GLOBS} globs"
                raise InvalidFile(path, found, f"at most {MAX_GLOBS}", option)
            is_match = re.compile(translate(text)).match
            names = list(
                dict.fromkeys(name for key, name in by_name.items() if is_match(key))
            )
        if not names:
            column = "image" if option == "eyes" else "frame"
            found = f"line {row.line}: {column} '{row.image:.60}' is none of the images"
            raise InvalidFile(path, found, "a name, or a glob such as cats/*", option)
        yield row, names


def _has_gaze(row: EyeRow) -> bool:
    return "gaze_h_deg" in row.values or "gaze_v_deg" in row.values


def _gaze_deg(row: EyeRow, usual: tuple[float, float]) -> tuple[float, float]:
    h_deg, v_deg = (row.values.get(f"gaze_{k}_deg") for k in "hv")
    return (usual[0] if h_deg is None else h_deg, usual[1] if v_deg is None else v_deg)


def _with_row(
    frame: SourceFrame,
    row: EyeRow,
    usual: States,
    usual_gaze_deg: tuple[float, float] | None,
) -> SourceFrame:
    values = row.values
    if (distance_m := values.get("distance_m")) is not None:
        frame = replace(frame, depth=None, depth_form=Constant(1.0 / distance_m))
    focus_dpt = values.get("focus_dpt", usual.focus_dpt)
    if focus_dpt is None and isinstance(frame.depth_form, Constant):
        focus_dpt = frame.depth_form.distance_dpt
    pupil_mm = values.get("pupil_mm", usual.pupil_mm)
    gaze_deg = None if usual_gaze_deg is None else _gaze_deg(row, usual_gaze_deg)
    states = States(usual.pupil_mm if pupil_mm is None else pupil_mm, focus_dpt)
    eye = row.eye
    frame_eye = FrameEye(eye.name, eye.profile, eye.given, states, gaze_deg)
    return replace(frame, eye=frame_eye)


def settings_of_rows(
    given: Mapping[str, Any],
    rows: Sequence[EyeRow],
    usual: States,
    distance_dpt: float | None,
) -> FilterSettings:
    """Return settings whose ranges are those of a table.

    Parameters
    ----------
    given : mapping
        Fields of `FilterSettings`, which take precedence.
    rows : sequence of EyeRow
        All rows, so that the settings do not depend on the images that are filtered.
    usual : States
        State of rows without one.
    distance_dpt : float, optional
        Distance of rows without one; None for depth files.
    """

    def of(column: str, default: float | None) -> list[float | None]:
        return [row.values.get(column, default) for row in rows]

    pupils_mm = [value for value in of("pupil_mm", usual.pupil_mm) if value is not None]
    distances_m = of(
        "distance_m", None if distance_dpt is None else _inverse(distance_dpt)
    )
    objects_dpt = None if None in distances_m else [1.0 / m for m in distances_m if m]
    foci_dpt = of("focus_dpt", usual.focus_dpt)
    known_dpt = [value for value in foci_dpt if value is not None]
    if None in foci_dpt:
        known_dpt += objects_dpt or CENTER_RANGE_DPT
    gazes_deg = []
    if any(map(_has_gaze, rows)):
        usual_deg = checked_settings(given).gaze_deg
        gazes_deg = [_gaze_deg(row, usual_deg) for row in rows]
    return narrow_settings(given, pupils_mm, known_dpt, objects_dpt, gazes_deg)


def _inverse(value_dpt: float) -> float:
    return 1.0 / value_dpt if value_dpt else math.inf
