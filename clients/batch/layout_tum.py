"""TUM RGB-D: colour and depth of a Kinect, each with a time, one list of each.

    rgb.txt, depth.txt        lines "time path"; "#" begins a comment
    associations.txt          instead, lines "time path time path", if it is there

Depth is 16-bit PNG, 5000 units a metre, 0 where there is none.  Colour and depth belong
together where their times are nearest, within 20 ms, each used once, as in the data
set's own `associate.py`.  Depth is registered to colour by the recorder; the data set's
authors recommend the camera of the driver for it: 525 px, centre (319.5, 239.5).

References
----------
Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems.
"""

from __future__ import annotations

from pathlib import Path

from clients.batch.source import Pinhole, Scaled, SourceFrame

DEPTH_SCALE_M = 1.0 / 5000.0
CAMERA = Pinhole(525.0, 525.0, 319.5, 239.5, (640, 480))
MAX_APART_S = 0.02
ASSOCIATIONS = ("associations.txt", "associate.txt", "assoc.txt")


def is_tum(source: Path) -> bool:
    """Return whether a folder has this layout."""
    lists = [(source / name).is_file() for name in ASSOCIATIONS]
    both = (source / "rgb.txt").is_file() and (source / "depth.txt").is_file()
    return both or any(lists)


def tum_frames(source: Path) -> list[SourceFrame]:
    """Return the frames of a sequence, named by the time of their colour.

    Raises
    ------
    ValueError
        A list that cannot be read; names its line.
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
    """Colour and depth of each line, whichever of them comes first."""
    pairs = []
    for number, fields in _lines(path, 4):
        first, second = fields[1], fields[3]
        if first.startswith("depth/") == second.startswith("depth/"):
            raise ValueError(
                f"'{path}', line {number}: '{first}' and '{second}'; allowed: one of "
                "them in depth/"
            )
        is_depth_first = first.startswith("depth/")
        pairs.append((second, first) if is_depth_first else (first, second))
    return pairs


def _associated(source: Path) -> list[tuple[str, str]]:
    colors, depths = (_times(source / name) for name in ("rgb.txt", "depth.txt"))
    candidates = sorted(
        (abs(color_s - depth_s), color_s, depth_s)
        for color_s in colors
        for depth_s in _near(depths, color_s)
    )
    free_colors, free_depths = dict(colors), dict(depths)
    pairs = []
    for _, color_s, depth_s in candidates:
        if color_s in free_colors and depth_s in free_depths:
            pairs.append((color_s, free_colors.pop(color_s), free_depths.pop(depth_s)))
    return [(color, depth) for _, color, depth in sorted(pairs)]


def _near(times: dict[float, str], at_s: float) -> list[float]:
    return [time_s for time_s in times if abs(time_s - at_s) < MAX_APART_S]


def _times(path: Path) -> dict[float, str]:
    found = {}
    for number, (time, name) in _lines(path, 2):
        try:
            found[float(time)] = name
        except ValueError:
            raise ValueError(
                f"'{path}', line {number}: '{time}' is no time in s"
            ) from None
    return found


def _lines(path: Path, count: int) -> list[tuple[int, list[str]]]:
    lines = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        fields = line.replace(",", " ").split()
        if not fields or line.lstrip().startswith("#"):
            continue
        if len(fields) < count:
            raise ValueError(f"'{path}', line {number}: '{line}' has no {count} fields")
        lines.append((number, fields[:count]))
    return lines
