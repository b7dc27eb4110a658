"""TUM RGB-D: color and depth of a Kinect, each with a list of times.

    rgb.txt, depth.txt        lines "time path"; "#" begins a comment
    associations.txt          used instead if present; lines "time path time path"

Depth is 16-bit PNG with 5000 units per meter, 0 if missing. As in the data set's
`associate.py`, color and depth are paired by the closest time, within 20 ms, and each
is used once. The depth is registered to color. The authors recommend the camera of the
driver: a focal length of 525 px and the center (319.5, 239.5).

References
----------
Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from pathlib import Path

from clients.batch.source import Pinhole, Scaled, SourceFrame
from estimator.bounded_files import InvalidFile, numbered_lines, read_text

DEPTH_SCALE_M = 1.0 / 5000.0
CAMERA = Pinhole(525.0, 525.0, 319.5, 239.5, (640, 480))
MAX_APART_S = 0.02
MAX_LINES = 100_000
"""Length of a list: an hour at 30 Hz. Each line takes 20 us."""

MAX_NEAR = 50
"""Depth images compared on each side in time; a camera of 30 Hz has one."""

ASSOCIATIONS = ("associations.txt", "associate.txt", "assoc.txt")


def is_tum(source: Path) -> bool:
    """Return whether a folder has this layout."""
    lists = [(source / name).is_file() for name in ASSOCIATIONS]
    both = (source / "rgb.txt").is_file() and (source / "depth.txt").is_file()
    return both or any(lists)


def tum_frames(source: Path) -> list[SourceFrame]:
    """Return the frames of a sequence, named by the time of their color image.

    Raises
    ------
    InvalidFile
        If a list cannot be read.  The message names the line.
    """
    lists = next((source / n for n in ASSOCIATIONS if (source / n).is_file()), None)
    pairs = _associated(source) if lists is None else _listed(lists)
    return [
        SourceFrame(
            Path(color).stem,
            source / color,
            source / depth,
            CAMERA,
            Scaled(DEPTH_SCALE_M),
        )
        for color, depth in pairs
    ]


def _listed(path: Path) -> list[tuple[str, str]]:
    """Return color and depth of each line, which may have either order."""
    pairs: list[tuple[str, str]] = []
    seen: set[str] = set()
    for number, fields in _lines(path, 4):
        first, second = fields[1], fields[3]
        if first.startswith("depth/") == second.startswith("depth/"):
            found = f"line {number}: '{first:.60}' and '{second:.60}'"
            raise InvalidFile(path, found, "exactly one of them in depth/")
        color, depth = (second, first) if first.startswith("depth/") else fields[1::2]
        if color in seen:
            found = f"line {number}: '{color:.60}' occurs again"
            raise InvalidFile(path, found, "each color image once")
        seen.add(color)
        pairs.append((color, depth))
    return pairs


def _associated(source: Path) -> list[tuple[str, str]]:
    colors, depths = (_times(source / name) for name in ("rgb.txt", "depth.txt"))
    depths_s = sorted(depths)
    candidates = sorted(
        (abs(color_s - depth_s), color_s, depth_s)
        for color_s in colors
        for depth_s in _near(depths_s, color_s)
    )
    free_colors, free_depths = dict(colors), dict(depths)
    pairs = []
    for _, color_s, depth_s in candidates:
        if color_s in free_colors and depth_s in free_depths:
            pairs.append((color_s, free_colors.pop(color_s), free_depths.pop(depth_s)))
    return [(color, depth) for _, color, depth in sorted(pairs)]


def _near(times_s: list[float], at_s: float) -> list[float]:
    """Return the times within `MAX_APART_S`, up to `MAX_NEAR` on each side."""
    first = bisect_left(times_s, at_s - MAX_APART_S)
    end = bisect_right(times_s, at_s + MAX_APART_S)
    middle = bisect_left(times_s, at_s)
    some = times_s[max(first, middle - MAX_NEAR) : min(end, middle + MAX_NEAR)]
    return [time_s for time_s in some if abs(time_s - at_s) < MAX_APART_S]


def _times(path: Path) -> dict[float, str]:
    found = {}
    for number, (time, name) in _lines(path, 2):
        try:
            time_s = float(time)
        except ValueError:
            time_s = math.nan
        if not math.isfinite(time_s):
            found_text = f"line {number}: '{time:.60}' is not a time"
            raise InvalidFile(path, found_text, "seconds")
        found[time_s] = name
    return found


def _lines(path: Path, count: int) -> list[tuple[int, list[str]]]:
    lines = []
    for number, line in numbered_lines(read_text(path, max_lines=MAX_LINES)):
        fields = line.replace(",", " ").split()
        if not fields or line.lstrip().startswith("#"):
            continue
        if len(fields) < count:
            found = f"line {number}: '{line:.60}' has {len(fields)} fields"
            raise InvalidFile(path, found, f"{count} or more")
        for name in fields[1:count:2]:
            if name.startswith("/") or ".." in name.split("/"):
                found = f"line {number}: '{name:.60}' is outside the data set"
                raise InvalidFile(path, found, "a path below its folder")
        lines.append((number, fields[:count]))
    return lines
