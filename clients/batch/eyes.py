"""Eyes of single frames: from a table, or drawn from persons or a bank.

A table has one row per image, or per glob that several images match.

    image,profile,pupil_mm,focus_dpt,distance_m,gaze_h_deg,gaze_v_deg
    cats/*,myopia,3.5,0.5,2,0,0

A drawn eye depends on the seed and the name of the frame alone, so it is the same for
any number of workers, any subset of the images, and after any interruption.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import translate
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

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
from clients.provenance import fingerprint, folder_name, profile_name
from estimator import (
    EyeProfile,
    InvalidFile,
    drawn_profiles,
    parse_profile,
    preset_names,
    profile_body,
    published_names,
)
from estimator.bounded_files import read_text
from filter_service import EyeBank, FilterSettings
from filter_service.settings import (
    MAX_GAZE_DEG,
    MAX_PLANES,
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

MAX_DRAWN = 100_000
SYNTEYES = {"synteyes": {"kind": "synteyes"}}
"""Profile of persons that are drawn without one."""

_GLOB = re.compile(r"[*?\[]")


@dataclass(frozen=True)
class NamedEye:
    """A profile, its name, and its fields as they were given."""

    name: str
    profile: EyeProfile
    given: Mapping[str, Any]


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


@dataclass(frozen=True)
class Drawn:
    """Eyes to draw from, and ranges of pupil and focus.

    Attributes
    ----------
    count : int
        Number of eyes.
    eye : callable
        Returns the eye of a number below ``count``.
    seed : int
    pupil_range_mm, focus_range_dpt : (low, high)
        The focus is None for the depth at the center.
    described : mapping
        What the draws depend on, for JSON.
    """

    count: int
    eye: Callable[[int], NamedEye]
    seed: int
    pupil_range_mm: tuple[float, float]
    focus_range_dpt: tuple[float, float] | None
    described: Mapping[str, Any]
    bank: EyeBank | None = None

    @classmethod
    def of(
        cls,
        bank: Path | None,
        profiles: Mapping[str, Mapping[str, Any]],
        count: int,
        first: int,
        *,
        seed: int,
        pupil_range_mm: tuple[float, float],
        focus_range_dpt: tuple[float, float] | None,
    ) -> Drawn:
        """Return the eyes of a bank, or persons, ``count`` for each profile.

        Parameters
        ----------
        bank : Path, optional
        profiles : mapping
            Profiles by name, which a bank replaces.
        count, first : int
            Number of persons, and the number of the first one.
        seed, pupil_range_mm, focus_range_dpt
            See `Drawn`.

        Raises
        ------
        ValueError
            If persons with a profile do not differ, or the folder is no bank.
        """
        described: dict[str, Any] = {
            "seed": seed,
            "pupil_range_mm": pupil_range_mm,
            "focus_range_dpt": focus_range_dpt or CENTER,
        }
        ranges = seed, pupil_range_mm, focus_range_dpt
        if bank is None:
            number, eye = eyes_of_people(profiles, count, first)
            described |= {"profiles": profiles, "count": count, "first_person": first}
            return cls(number, eye, *ranges, described)
        try:
            found = EyeBank(bank)
        except FileNotFoundError:
            raise ValueError(
                f"--bank '{bank}': no bank; allowed: a folder of `ocufilter bank`"
            ) from None
        number, eye = eyes_of_bank(found)
        described |= {"bank": found.folder.resolve().name, "count": number}
        return cls(number, eye, *ranges, described, found)

    def settings(
        self, given: Mapping[str, Any], distance_dpt: float | None
    ) -> FilterSettings:
        """Return the settings of the bank, or those whose ranges are drawn from.

        Raises
        ------
        ValueError
            If a range exceeds that of the bank, or a setting is invalid.
        """
        foci_dpt = self.focus_range_dpt or CENTER_RANGE_DPT
        if self.bank is None:
            objects_dpt = None if distance_dpt is None else [distance_dpt]
            return narrow_settings(given, self.pupil_range_mm, foci_dpt, objects_dpt)
        settings = self.bank.settings
        for name, (low, high) in {
            "pupil_range_mm": self.pupil_range_mm,
            "focus_range_dpt": foci_dpt,
        }.items():
            bank_low, bank_high = getattr(settings, name)
            if low < bank_low or high > bank_high:
                raise ValueError(
                    f"{name} is {low:g} to {high:g}; allowed: {bank_low:g} to "
                    f"{bank_high:g}, as in the bank '{self.bank.folder}'"
                )
        return settings

    def of_frames(self, frames: Sequence[SourceFrame]) -> list[SourceFrame]:
        """Return frames with drawn eyes."""
        return [replace(frame, eye=self._of(frame.name)) for frame in frames]

    def _of(self, name: str) -> FrameEye:
        which, pupil, focus = uniform_numbers(self.seed, name)
        found = self.eye(int(which * self.count))
        low_mm, high_mm = self.pupil_range_mm
        focus_dpt = None
        if self.focus_range_dpt is not None:
            low_dpt, high_dpt = self.focus_range_dpt
            focus_dpt = low_dpt + focus * (high_dpt - low_dpt)
        states = States(low_mm + pupil * (high_mm - low_mm), focus_dpt)
        return FrameEye(found.name, found.profile, found.given, states)


def uniform_numbers(seed: int, name: str) -> tuple[float, float, float]:
    """Return three numbers in [0, 1) from a seed and the name of a frame.

    They are 53 bits each of a SHA-256, so that no version of a library changes them.
    """
    text = f"{seed}\n{same_text(name)}".encode("utf-8", "surrogateescape")
    digest = hashlib.sha256(text).digest()
    first, second, third = (
        (int.from_bytes(digest[k : k + 8], "big") >> 11) * 2.0**-53 for k in (0, 8, 16)
    )
    return first, second, third


def eyes_of_people(
    profiles: Mapping[str, Mapping[str, Any]], count: int, first: int
) -> tuple[int, Callable[[int], NamedEye]]:
    """Return the number of drawn persons, ``count`` for each profile, and their eyes.

    Raises
    ------
    ValueError
        If persons with a profile do not differ.
    """
    bodies = list(profiles.values())
    for body in bodies:
        drawn_profiles(parse_profile(body), 2)  # raises if they do not differ

    @cache
    def eye(number: int) -> NamedEye:
        which, person = divmod(number, count)
        body = {**bodies[which], "sample": first + person}
        return NamedEye(_numbered(number), parse_profile(body), body)

    return count * len(bodies), eye


def eyes_of_bank(bank: EyeBank) -> tuple[int, Callable[[int], NamedEye]]:
    """Return the number of eyes of a bank, and its eyes."""

    @cache
    def eye(number: int) -> NamedEye:
        given = {"bank": bank.folder.resolve().name, "number": number}
        return NamedEye(_numbered(number), bank[number], given)

    return len(bank), eye


def _numbered(number: int) -> str:
    return f"eye_{number:06d}"  # as the file of a bank


def is_table_of_eyes(path: Path) -> bool:
    """Return whether a table of states has a column of profiles."""
    header = read_text(path, option="states").split("\n", 1)[0]
    return "profile" in [cell.strip() for cell in header.split(",")]


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
    place_of: dict[str, EyeRow] = {}
    for row, names in _matches(rows, by_name, path, option):
        for name in names:
            other = place_of.setdefault(name, row)
            if other is not row:
                found = f"line {row.line}: '{row.image:.60}' matches '{name}', as line "
                allowed = "one row per image"
                raise InvalidFile(path, f"{found}{other.line} does", allowed, option)
    lacking = [frame.name for frame in frames if frame.name not in place_of]
    if lacking:
        found = f"no line for '{lacking[0]}' ({len(lacking)} of {len(frames)} images)"
        raise InvalidFile(path, found, "a row for each image", option)
    usual_gaze_deg = gaze_deg if any(map(_has_gaze, rows)) else None
    return [
        _with_row(frame, place_of[frame.name], usual, usual_gaze_deg)
        for frame in frames
    ]


def _by_name(frames: Sequence[SourceFrame], source: Path) -> dict[str, str]:
    """Return the names of frames by the texts that may stand for them in a table."""
    found: dict[str, str] = {}
    for frame in frames:
        if frame.name.isdecimal():
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
        usual_deg = given.get("gaze_deg", (0.0, 0.0))
        gazes_deg = [_gaze_deg(row, usual_deg) for row in rows]
    return narrow_settings(given, pupils_mm, known_dpt, objects_dpt, gazes_deg)


def narrow_settings(
    given: Mapping[str, Any],
    pupils_mm: Sequence[float],
    foci_dpt: Sequence[float],
    objects_dpt: Sequence[float] | None,
    gazes_deg: Sequence[tuple[float, float]] = (),
) -> FilterSettings:
    """Return settings with exactly the ranges of the states, which are quick to build.

    Parameters
    ----------
    given : mapping
        Fields of `FilterSettings`, which take precedence.
    pupils_mm, foci_dpt : sequence of float
        Values, or limits, of all frames.
    objects_dpt : sequence of float, optional
        Distances of all objects; None for depth files.
    gazes_deg : sequence of (h, v)
        Gaze of each frame, if they differ; it takes precedence over ``given``.

    Raises
    ------
    ValueError
        If a setting is unknown or out of range.
    """
    ranges: dict[str, Any] = {
        "pupil_range_mm": (min(pupils_mm), max(pupils_mm)),
        "focus_range_dpt": (min(foci_dpt), max(foci_dpt)),
    }
    distinct = sorted(set(objects_dpt or ()))
    if distinct and "object_range_dpt" not in given:
        if len(distinct) <= MAX_PLANES:
            ranges["object_planes_dpt"] = tuple(distinct)
        else:
            ranges["object_range_dpt"] = (distinct[0], distinct[-1])
    gazes: dict[str, Any] = {}
    if gazes_deg:
        low, high = np.min(gazes_deg, axis=0), np.max(gazes_deg, axis=0)
        gazes["gaze_deg"] = (0.5 * (low + high)).tolist()
        gazes["gaze_range_deg"] = (0.5 * (high - low)).tolist()
    try:
        return FilterSettings(**{**ranges, **given, **gazes})
    except TypeError as error:
        raise ValueError(f"--settings: {error}") from None


def _inverse(value_dpt: float) -> float:
    return 1.0 / value_dpt if value_dpt else math.inf
