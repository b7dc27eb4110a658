"""Middlebury stereo (2014 and later): im0.png, disp0.pfm and calib.txt of each scene.

    calib.txt    cam0=[f 0 cx; 0 f cy; 0 0 1], doffs (px), baseline (mm)
    disp0.pfm    disparity of the left view, px; infinity if unknown

depth = f baseline / (disparity + doffs). The folder is a scene, or contains the folders
of several scenes.

References
----------
Scharstein et al. 2014, High-resolution stereo datasets with subpixel-accurate ground
truth.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from clients.batch.layout_pairs import in_order
from clients.batch.source import Disparity, Pinhole, SourceFrame
from estimator.bounded_files import InvalidFile, read_text

M_PER_MM = 1e-3
FIELDS = ("cam0", "doffs", "baseline")
FILES = ("im0.png", "disp0.pfm", "calib.txt")
MAX_CALIBRATION_BYTES = 65_536
LARGEST_NUMBER = 1e9
_NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"


def is_middlebury(source: Path) -> bool:
    """Return whether a folder is a scene or contains scenes."""
    return bool(_scenes(source))


def middlebury_frames(source: Path) -> list[SourceFrame]:
    """Return one frame per scene, named after its folder.

    Raises
    ------
    InvalidFile
        If a calibration cannot be read.  The message names the file and the field.
    """
    frames = []
    for folder in _scenes(source):
        optics, disparity = read_calibration(folder / "calib.txt")
        color, depth = folder / "im0.png", folder / "disp0.pfm"
        name = folder.resolve().name
        frames.append(SourceFrame(name, color, depth, optics, disparity))
    return frames


def _scenes(source: Path) -> list[Path]:
    def is_scene(folder: Path) -> bool:
        return all((folder / name).is_file() for name in FILES)

    if is_scene(source):
        return [source]
    names = [path.name for path in source.iterdir() if path.is_dir() and is_scene(path)]
    return [source / name for name in in_order(names)]


def read_calibration(path: Path) -> tuple[Pinhole, Disparity]:
    """Return the left camera of a scene, and the conversion of its disparities.

    Raises
    ------
    InvalidFile
        If the calibration is incomplete or invalid.
    """
    text = read_text(path, max_bytes=MAX_CALIBRATION_BYTES)
    fields = dict(re.findall(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*)$", text, re.MULTILINE))
    for name in FIELDS:
        if name not in fields:
            raise InvalidFile(path, f"'{name}' is missing", ", ".join(FIELDS))
    numbers = re.findall(_NUMBER, fields["cam0"])
    matrix = [_number(number) for number in numbers]
    usable = len(matrix) == 9 and all(map(math.isfinite, matrix))
    if not usable or matrix[0] <= 0.0 or matrix[4] <= 0.0:
        found = f"cam0 is {fields['cam0'].strip():.60}"
        raise InvalidFile(path, found, "[f 0 cx; 0 f cy; 0 0 1]")
    offset_px, baseline_mm = _number(fields["doffs"]), _number(fields["baseline"])
    if not (math.isfinite(offset_px) and math.isfinite(baseline_mm)):
        found = "doffs or baseline is not a number"
        raise InvalidFile(path, found, f"up to {LARGEST_NUMBER:g} px or mm")
    return (
        Pinhole(matrix[0], matrix[4], matrix[2], matrix[5], _size_px(fields)),
        Disparity(matrix[0], M_PER_MM * baseline_mm, offset_px),
    )


def _number(text: str) -> float:
    """Return a number, or NaN for other text and numbers that are too large."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if abs(value) <= LARGEST_NUMBER else math.nan


def _size_px(fields: dict[str, str]) -> tuple[int, int] | None:
    sides = fields.get("width", ""), fields.get("height", "")
    if not all(side.strip().isdecimal() and len(side) < 10 for side in sides):
        return None
    return int(sides[0]), int(sides[1])
