"""Frames of a data set: files, camera, depth format, and the state of the eye.

Layouts list frames; workers read their files.  Pupil and focus of a frame are fixed,
come from a list, or follow the frame's depth.
"""

from __future__ import annotations

import csv
import io
import math
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from estimator import EyeProfile
from estimator.bounded_files import InvalidFile, read_text
from filter_service.camera import PixelGrid, Tangents
from filter_service.image_files import (
    ImageFile,
    read_depth_file,
    read_stored_depth,
)
from filter_service.settings import MAX_PUPIL_MM, MAX_VERGENCE_DPT, MIN_PUPIL_MM

CENTER = "center"
CENTER_RANGE_DPT = (0.0, 10.0)
"""Range of a focus that follows depth: few eyes focus closer than 10 cm."""

COLUMNS = ("frame", "pupil_mm", "focus_dpt")


@dataclass(frozen=True)
class FieldOfView:
    """Symmetric camera, given by its vertical field of view."""

    fov_deg: float

    def tangents(self, grid: PixelGrid) -> Tangents:
        """Return the tangents of the image edges."""
        return grid.fov_tangents(self.fov_deg)


@dataclass(frozen=True)
class Pinhole:
    """Calibrated camera; the center of pixel (0, 0) is at (0, 0).

    If the image size is known, images of other sizes are rejected.
    """

    focal_x_px: float
    focal_y_px: float
    center_x_px: float
    center_y_px: float
    size_px: tuple[int, int] | None = None

    def tangents(self, grid: PixelGrid) -> Tangents:
        """Return the tangents of the image edges, half a pixel beyond pixel centers.

        Raises
        ------
        ValueError
            If the camera is for images of another size.
        """
        size_px = grid.full_width_px, grid.full_height_px
        if self.size_px not in (None, size_px):
            raise ValueError(
                f"{size_px[0]}x{size_px[1]} px, but the camera of this layout is for "
                f"{self.size_px[0]}x{self.size_px[1]}; allowed: that size, "
                "--intrinsics or --fov-deg"
            )
        return grid.intrinsics_tangents(
            self.focal_x_px, self.focal_y_px, self.center_x_px, self.center_y_px
        )


Optics = FieldOfView | Pinhole


class DepthForm(Protocol):
    """Interface of depth formats."""

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in a file, m; 0, negative and NaN are missing.

        If the content of the file is given, the file is not read.
        """


@dataclass(frozen=True)
class Scaled:
    """Depth in multiples of a unit; by default, integers are mm and floats are m."""

    depth_scale_m: float | None = None

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in a file, m."""
        scale_m = self.depth_scale_m
        return read_depth_file(path, depth_scale=scale_m, option="", content=content)


@dataclass(frozen=True)
class Disparity:
    """Depth as disparity of a stereo pair, in px; infinity is unknown.

    depth = focal length x baseline / (disparity + offset), as in Middlebury.
    """

    focal_px: float
    baseline_m: float
    offset_px: float

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in a file, m; 0 if the disparity is unknown."""
        stored = read_stored_depth(path, option="", content=content)
        apart_px = stored.pixels.astype(np.float64) + self.offset_px
        known = np.isfinite(apart_px) & (apart_px > 0.0)
        depth_m = np.zeros(apart_px.shape)
        with np.errstate(over="ignore"):  # values beyond float32 become infinity
            depth_m[known] = self.focal_px * self.baseline_m / apart_px[known]
            return replace(stored, pixels=depth_m.astype(np.float32))


@dataclass(frozen=True)
class Constant:
    """Depth that is the same in all pixels: 1 / distance, 0 at infinity."""

    distance_dpt: float

    def like(self, color: ImageFile) -> ImageFile:
        """Return the depth of a color image, m."""
        distance_m = 1.0 / self.distance_dpt if self.distance_dpt > 0.0 else math.inf
        pixels = np.full(color.pixels.shape[:2], distance_m, np.float32)
        return ImageFile(pixels, color.grid)


@dataclass(frozen=True)
class SourceFrame:
    """A frame of a data set.

    Attributes
    ----------
    name : str
        Unique name of the results, a relative path without a suffix.
    color : Path
        File of the image, or video.
    depth : Path or None
        File or video of depth; None if the depth is constant.
    optics : Optics
        Camera.
    depth_form : DepthForm or Constant
        Depth format.
    color_index, depth_index : int, optional
        Frame numbers in videos.
    time_s : Fraction, optional
        Time in a video of color whose frame rate varies.
    fault : str, optional
        Reason why the frame cannot be used, if known before it is read.
    facts : mapping
        What the image shows, as JSON-compatible values, for the record and the metadata
        of its results.
    eye : FrameEye, optional
        Eye of this frame alone, if frames do not share the eyes of the batch.
    """

    name: str
    color: Path
    depth: Path | None
    optics: Optics
    depth_form: DepthForm | Constant
    color_index: int | None = None
    depth_index: int | None = None
    time_s: Fraction | None = None
    fault: str | None = None
    facts: Mapping[str, Any] = field(default_factory=dict, hash=False)
    eye: FrameEye | None = field(default=None, hash=False)

    @property
    def files(self) -> tuple[Path, ...]:
        """Return the image files of the frame, without videos."""
        parts = ((self.color, self.color_index), (self.depth, self.depth_index))
        return tuple(path for path, index in parts if path and index is None)

    @property
    def videos(self) -> tuple[Path, ...]:
        """Return the videos of the frame."""
        parts = ((self.color, self.color_index), (self.depth, self.depth_index))
        return tuple(path for path, index in parts if path and index is not None)

    def described(self) -> dict[str, Any]:
        """Return the camera, the depth format, facts and the eye, for JSON."""
        own = {} if self.eye is None else {"eye": self.eye.described()}
        return {
            part: {"kind": type(value).__name__, **asdict(cast(Any, value))}
            for part, value in (("camera", self.optics), ("depth", self.depth_form))
        } | {**self.facts, **own}


class BadFrame(ValueError):
    """The frame cannot be used; the message names its file."""


def center_depth_m(depth_m: NDArray[np.float32]) -> float:
    """Return the median depth at the center of an image.

    The center is a tenth of the image's width and height.  It is enlarged until it
    contains known depth.  If the image has none, return infinity.
    """
    height_px, width_px = depth_m.shape
    for part in (0.1, 0.2, 0.4, 0.8, 1.0):
        half_y, half_x = (
            max(1, math.ceil(part * side / 2.0)) for side in (height_px, width_px)
        )
        y, x = height_px // 2, width_px // 2
        middle_m = depth_m[
            max(0, y - half_y) : y + half_y, max(0, x - half_x) : x + half_x
        ]
        known_m = middle_m[middle_m > 0.0]
        if known_m.size:
            # The lower of two middle values, because the mean of a wall and the sky is
            # neither.
            return float(np.sort(known_m, axis=None)[(known_m.size - 1) // 2])
    return math.inf


def same_text(name: str) -> str:
    """Return a name whose letters with accents are one character each (NFC)."""
    return unicodedata.normalize("NFC", name)


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
        (pupil_mm, focus_dpt) by frame name; None is the value for all frames.
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
        if len(known) < len(values) or not known:
            known += usual
        return min(known), max(known)

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


@dataclass(frozen=True)
class FrameEye:
    """Eye of one frame, and its state.

    Attributes
    ----------
    name : str
        Name of the eye; frames with the same name have the same eye.
    profile : EyeProfile
        Parsed profile, or an eye of a bank.
    given : mapping
        The profile as it was given, as JSON-compatible values.
    states : States
        Pupil and focus of the frame.
    gaze_deg : (h, v), optional
        Gaze; by default that of the settings.
    """

    name: str
    profile: EyeProfile
    given: Mapping[str, Any]
    states: States
    gaze_deg: tuple[float, float] | None = None

    def described(self) -> dict[str, Any]:
        """Return the eye and its state, for JSON."""
        state = self.states.described()
        return {
            "name": self.name,
            "profile": dict(self.given),
            "sha256": self.profile.digest,
            "person": self.profile.sample,
            "pupil_mm": state["pupil_mm"],
            "focus_dpt": state["focus_dpt"],
            "gaze_deg": self.gaze_deg,
        }


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
    known = {same_text(name): name for name in names}
    by_number = {int(name): name for name in names if _is_number(name)}
    rows = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    try:
        columns, lines = rows.fieldnames or [], [(rows.line_num, row) for row in rows]
    except csv.Error as error:
        raise InvalidFile(path, f"not CSV ({error})", "CSV", "states") from None
    if "frame" not in columns or not set(columns) <= set(COLUMNS):
        found_text = f"columns {', '.join(columns) or 'none':.100}"
        raise InvalidFile(path, found_text, ", ".join(COLUMNS), "states")
    found = {}
    for number, row in lines:
        where, name = f"line {number}", row["frame"]
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
            value = number_or_nan(row.get(column)) if column in row else None
            if value is not None and not low <= value <= high:
                found_text = f"{where}: {column} '{row[column]!s:.40}'"
                allowed = f"{low:g} to {high:g}"
                raise InvalidFile(path, found_text, allowed, "states")
            state.append(value)
        found[name] = (state[0], state[1])
    return found


def _is_number(name: str) -> bool:
    return name.isdecimal() and len(name) < 20


def number_or_nan(text: str | None) -> float:
    """Return a number, or NaN for other text."""
    try:
        return float(text or "")
    except ValueError:
        return float("nan")
