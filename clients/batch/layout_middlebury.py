"""Middlebury stereo (2014 and later): im0.png, disp0.pfm and calib.txt of each scene.

    calib.txt    cam0=[f 0 cx; 0 f cy; 0 0 1], doffs (px), baseline (mm)
    disp0.pfm    disparity of the left view, px; infinity where it is unknown

depth = f baseline / (disparity + doffs).  The folder is that of a scene, or one with
those of many.

References
----------
Scharstein et al. 2014, High-resolution stereo datasets with subpixel-accurate ground
truth.
"""

from __future__ import annotations

import re
from pathlib import Path

from clients.batch.source import Disparity, Pinhole, SourceFrame

M_PER_MM = 1e-3
FILES = ("im0.png", "disp0.pfm", "calib.txt")
_NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"


def is_middlebury(source: Path) -> bool:
    """Return whether a folder is a scene, or holds scenes."""
    return bool(_scenes(source))


def middlebury_frames(source: Path) -> list[SourceFrame]:
    """Return one frame for each scene, named by its folder.

    Raises
    ------
    ValueError
        A calibration that cannot be read; names the file and what it lacks.
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
    return sorted(path for path in source.iterdir() if path.is_dir() and is_scene(path))


def read_calibration(path: Path) -> tuple[Pinhole, Disparity]:
    """Return the left camera of a scene, and what its disparities mean.

    Raises
    ------
    ValueError
    """
    text = path.read_text(encoding="utf-8")
    fields = dict(re.findall(r"^\s*(\w+)\s*=\s*(.*?)\s*$", text, re.MULTILINE))
    for name in ("cam0", "doffs", "baseline"):
        if name not in fields:
            raise ValueError(f"'{path}': '{name}' is missing")
    matrix = [float(number) for number in re.findall(_NUMBER, fields["cam0"])]
    if len(matrix) != 9 or matrix[0] <= 0.0 or matrix[4] <= 0.0:
        raise ValueError(
            f"'{path}': cam0 is {fields['cam0']}; allowed: [f 0 cx; 0 f cy; 0 0 1]"
        )
    try:
        offset_px, baseline_mm = float(fields["doffs"]), float(fields["baseline"])
    except ValueError:
        raise ValueError(f"'{path}': doffs or baseline is no number") from None
    return (
        Pinhole(matrix[0], matrix[4], matrix[2], matrix[5], _size_px(fields)),
        Disparity(matrix[0], M_PER_MM * baseline_mm, offset_px),
    )


def _size_px(fields: dict[str, str]) -> tuple[int, int] | None:
    sides = fields.get("width", ""), fields.get("height", "")
    if not all(side.isdecimal() for side in sides):
        return None
    return int(sides[0]), int(sides[1])
