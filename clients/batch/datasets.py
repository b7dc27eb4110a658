"""Frames of known data sets: pairs of images, TUM RGB-D, NYU depth v2, Middlebury.

Pairs are folders of color and depth images, paired by their names.

    color/0001.png      depth/0001.exr     two folders with known names
    0001_color.png      0001_depth.npy     one folder, names with a known word
    0001.jpg            0001.npy           one folder, distinguished by file type

Names of folders may have any case.  Names of files meet if they are the same text,
however it is encoded: macOS stores letters with accents as two characters.

TUM RGB-D is color and depth of a Kinect, each with a list of times.

    rgb.txt, depth.txt        lines "time path"; "#" begins a comment
    associations.txt          used instead if present; lines "time path time path"

Depth is 16-bit PNG with 5000 units per meter, 0 if missing. As in the data set's
`associate.py`, color and depth are paired by the closest time, within 20 ms, and each
is used once. The depth is registered to color. The authors recommend the camera of the
driver: a focal length of 525 px and the center (319.5, 239.5).

NYU depth v2 is extracted pairs, or raw dumps of the Kinect.

    00001_colors.png, 00001_depth.png      16-bit depth in mm, registered to color
    rgb_00001.jpg, sync_depth_00001.png    other names of such pairs
    r-TIME-ID.ppm, d-TIME-ID.pgm           raw color and depth, with separate times

Raw depth is a count n of the Kinect with swapped bytes, which means 351.3 / (1092.5 -
n) m, and is unknown beyond 10 m. It is registered to the color camera with the
calibration from the toolbox of the data set; pixels without a registered value are
missing. Lens distortion, some pixels in the corners, is not corrected. Each color image
is paired with the depth image that is closest in time. The .mat file of labeled frames
is not supported; extract it first.

Middlebury stereo (2014 and later) has im0.png, disp0.pfm and calib.txt of each scene.

    calib.txt    cam0=[f 0 cx; 0 f cy; 0 0 1], doffs (px), baseline (mm)
    disp0.pfm    disparity of the left view, px; infinity if unknown

depth = f baseline / (disparity + doffs). The folder is a scene, or contains the folders
of several scenes.

References
----------
Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems.
Silberman et al. 2012, Indoor segmentation and support inference from RGBD images, and
its toolbox.
Scharstein et al. 2014, High-resolution stereo datasets with subpixel-accurate ground
truth.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from clients.batch.source import (
    Constant,
    Disparity,
    Optics,
    Pinhole,
    Scaled,
    SourceFrame,
    number_or_nan,
    same_text,
)
from estimator.bounded_files import InvalidFile, numbered_lines, read_text
from filter_service.image_files import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    ImageFile,
    read_stored_depth,
)

COLOR_FOLDERS = ("color", "colour", "rgb", "image", "images", "left", "frames")
DEPTH_FOLDERS = ("depth", "depths", "depth_m", "depthmap", "depthmaps")
COLOR_WORDS = ("colors", "color", "colour", "rgb", "image", "img")
DEPTH_WORDS = ("sync_depth", "depth", "z")
_DIGITS = re.compile(r"(\d+)", re.ASCII)
_DECIMAL = re.compile(r"(\d+)(\.\d+)", re.ASCII)

_PICTURES = (".png", ".jpg", ".jpeg", ".ppm")

# TUM RGB-D
TUM_DEPTH_SCALE_M = 1.0 / 5000.0
TUM_CAMERA = Pinhole(525.0, 525.0, 319.5, 239.5, (640, 480))
MAX_APART_S = 0.02
MAX_LINES = 100_000
"""Length of a list: an hour at 30 Hz. Each line takes 20 us."""

MAX_NEAR = 50
"""Depth images compared on each side in time; a camera of 30 Hz has one."""

ASSOCIATIONS = ("associations.txt", "associate.txt", "assoc.txt")

# NYU depth v2
COLOR_CAMERA = Pinhole(
    518.85790117450188,
    519.46961112127485,
    325.58244941119034,
    253.73616633400465,
    (640, 480),
)
DEPTH_CAMERA = Pinhole(
    582.62448167737955, 582.69103270988637, 313.04475870804731, 238.43889626620386
)
TO_COLOR = np.linalg.inv(
    -np.array(
        [
            [9.9997798940829263e-01, 5.0518419386157446e-03, 4.3011152014118693e-03],
            [-5.0359919480810989e-03, 9.9998051861143999e-01, -3.6879781309514218e-03],
            [-4.3196624923060242e-03, 3.6662365748484798e-03, 9.9998394948385538e-01],
        ]
    )
)
"""Matrix from the frame of the depth camera to the frame of the color camera. It also
reverses directions, which the projection cancels."""

SHIFT_M = np.array(
    [2.5031875059141302e-02, -2.9342312935846411e-04, 6.6238747008330102e-04]
)
COUNT_SCALE_M, COUNT_AT_INFINITY = 351.3, 1092.5
MAX_DEPTH_M = 10.0
MAX_COUNT = 65535
_RAW = re.compile(r"^([rd])-(\d+\.\d+)-\d+\.(?i:ppm|pgm)$")
_EXTRACTED = re.compile(r"^(\d+_colors|sync_depth_\d+)\.(?i:png|jpg)$")

# Middlebury
M_PER_MM = 1e-3
CALIBRATION_FIELDS = ("cam0", "doffs", "baseline")
SCENE_FILES = ("im0.png", "disp0.pfm", "calib.txt")
MAX_CALIBRATION_BYTES = 65_536
LARGEST_NUMBER = 1e9
_NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"


def in_order(names: Iterable[str]) -> list[str]:
    """Return names sorted as people count: 2 before 10, and times as decimals."""
    return sorted(names, key=_counted)


def _counted(name: str) -> tuple[list[str | float], str]:
    """Return a key: text and numbers in turn, so that like is compared with like."""
    text = same_text(name)
    if match := _DECIMAL.fullmatch(text):
        return ["", int(match[1]), ".", float(match[2])], name
    parts = _DIGITS.split(text)
    numbered = [int(part) if k % 2 else part for k, part in enumerate(parts)]
    return [*numbered], name


def _at_an_end(words: tuple[str, ...]) -> re.Pattern[str]:
    any_of = "|".join(words)
    # Not on lowercase text: the lowercase form of some letters has another length.
    return re.compile(rf"^({any_of})[-_.]|[-_.]({any_of})\Z", re.ASCII | re.IGNORECASE)


_COLOR_WORD, _DEPTH_WORD = _at_an_end(COLOR_WORDS), _at_an_end(DEPTH_WORDS)


def pair_frames(
    source: Path, depth: Path | None, optics: Optics, scaled: Scaled
) -> list[SourceFrame]:
    """Return the pairs in a folder, or in a folder of color and one of depth.

    A file without a counterpart becomes a frame with a fault.

    Raises
    ------
    ValueError
        If depth files cannot be identified, or two files have the same name.
    """
    colors, depths = _colors_and_depths(source, depth)
    frames = []
    for name in in_order(colors.keys() | depths.keys()):
        color, depth_file = colors.get(name), depths.get(name)
        fault = None
        if color is None or depth_file is None:
            lacking = "color" if color is None else "depth"
            fault = f"'{color or depth_file}': no {lacking} with the name '{name}'"
        frames.append(
            SourceFrame(
                name,
                cast(Path, color or depth_file),
                cast(Path, depth_file or color),
                optics,
                scaled,
                fault=fault,
            )
        )
    return frames


def color_frames(
    source: Path, optics: Optics, depth_form: Constant
) -> list[SourceFrame]:
    """Return the color images in a folder, whose depth is constant.

    If it contains none, they are those of its subfolders at any level, and their names
    are paths relative to it.

    Raises
    ------
    ValueError
        If two files have the same name.
    """
    folder = _sub_folder(source, COLOR_FOLDERS) or source
    folders = [folder]
    if not images_in(folder, COLOR_SUFFIXES):
        folders = [
            path
            for path in sorted(folder.rglob("*"))
            if path.is_dir()
            and not path.name.startswith(".")
            and path.name.lower() not in DEPTH_FOLDERS
        ]
    found = []
    for place in folders:
        files = images_in(place, COLOR_SUFFIXES)
        colors = [path for path in files if not _DEPTH_WORD.search(path.stem)]
        for name, path in _named(colors, _COLOR_WORD).items():
            inside = same_text((place.relative_to(folder) / name).as_posix())
            found.append(SourceFrame(inside, path, None, optics, depth_form))
    return found


def _colors_and_depths(
    source: Path, depth: Path | None
) -> tuple[dict[str, Path], dict[str, Path]]:
    color_folder = _sub_folder(source, COLOR_FOLDERS)
    depth_folder = depth or _sub_folder(source, DEPTH_FOLDERS)
    if depth_folder is not None:
        if not depth_folder.is_dir():
            raise ValueError(f"--depth '{depth_folder}': allowed: a folder of images")
        return (
            _named(images_in(color_folder or source, COLOR_SUFFIXES), _COLOR_WORD),
            _named(images_in(depth_folder, DEPTH_SUFFIXES), _DEPTH_WORD),
        )
    files = images_in(source, (*COLOR_SUFFIXES, *DEPTH_SUFFIXES))
    depths = [path for path in files if _DEPTH_WORD.search(path.stem)]
    colors = [path for path in files if path not in set(depths)]
    if not depths:  # distinguished by file type
        depths = [path for path in files if path.suffix.lower() not in _PICTURES]
        colors = [path for path in files if path.suffix.lower() in _PICTURES]
        if len(depths) != len(colors):
            raise ValueError(
                f"'{source}': cannot identify the depth files; allowed: folders such "
                f"as color/ and depth/, names that end in _depth, --depth DIR, or "
                "--distance-m"
            )
    return _named(colors, _COLOR_WORD), _named(depths, _DEPTH_WORD)


def images_in(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder with these suffixes, in the order of their names."""
    found = {
        path.name: path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".")
    }
    return [found[name] for name in in_order(found)]


def _sub_folder(source: Path, names: tuple[str, ...]) -> Path | None:
    folders = [path for path in sorted(source.iterdir()) if path.is_dir()]
    for name in names:
        for path in (source / name, *folders):
            if path.name.lower() == name and path.is_dir():
                return path
    return None


def _named(paths: list[Path], word: re.Pattern[str]) -> dict[str, Path]:
    """Return files by their names without the word for color or depth."""
    found: dict[str, Path] = {}
    for path in paths:
        match = word.search(path.stem)
        name = path.stem
        if match is not None:
            name = (name[: match.start()] + name[match.end() :]) or path.stem
        name = same_text(name)
        if name in found:
            raise ValueError(
                f"'{path}' and '{found[name]}' have the same name '{name}'"
            )
        found[name] = path
    return found


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
            TUM_CAMERA,
            Scaled(TUM_DEPTH_SCALE_M),
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
        time_s = number_or_nan(time)
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


@dataclass(frozen=True)
class KinectCounts:
    """Depth format of the raw counts of the Kinect's depth camera."""

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in the view of the color camera, m; 0 if unknown."""
        file = read_stored_depth(path, option="", content=content)
        stored = file.pixels
        width_px, height_px = COLOR_CAMERA.size_px or (0, 0)
        if stored.shape != (height_px, width_px):
            found = f"{stored.shape[1]}x{stored.shape[0]} px"
            raise InvalidFile(
                path, found, f"{width_px}x{height_px}, as from the Kinect"
            )
        if not ((stored >= 0.0) & (stored <= MAX_COUNT)).all():
            raise InvalidFile(path, "numbers that are not counts", f"0 to {MAX_COUNT}")
        counts = stored.astype(np.uint16).byteswap()
        return replace(file, pixels=registered_m(counted_depth_m(counts)))


def counted_depth_m(counts: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return the depth for counts of the depth camera, m; 0 if unknown."""
    left = COUNT_AT_INFINITY - counts.astype(np.float64)
    depth_m = COUNT_SCALE_M / left  # never 0: the constant is not an integer
    return np.where((left > 0.0) & (depth_m <= MAX_DEPTH_M), depth_m, 0.0)


def registered_m(depth_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return depth in the view of the color camera, of the nearest point per pixel."""
    y, x = np.nonzero(depth_m > 0.0)
    known_m = depth_m[y, x]
    camera = DEPTH_CAMERA
    points_m = known_m * np.stack(
        [
            (x - camera.center_x_px) / camera.focal_x_px,
            (y - camera.center_y_px) / camera.focal_y_px,
            np.ones_like(known_m),
        ]
    )
    across_m, down_m, away_m = TO_COLOR @ points_m + SHIFT_M[:, None]
    camera = COLOR_CAMERA
    column = np.rint(across_m / away_m * camera.focal_x_px + camera.center_x_px)
    row = np.rint(down_m / away_m * camera.focal_y_px + camera.center_y_px)
    height_px, width_px = depth_m.shape
    inside = (column >= 0) & (column < width_px) & (row >= 0) & (row < height_px)
    seen_m = np.full(depth_m.shape, np.inf)
    at = row[inside].astype(int), column[inside].astype(int)
    np.minimum.at(seen_m, at, np.abs(away_m[inside]))
    return np.where(np.isfinite(seen_m), seen_m, 0.0).astype(np.float32)


def is_nyu(source: Path) -> bool:
    """Return whether a folder has one of these layouts."""
    names = [path.name for path in source.iterdir()]
    raw = {match[1] for name in names if (match := _RAW.match(name))}
    return raw == {"r", "d"} or any(_EXTRACTED.match(name) for name in names)


def nyu_frames(source: Path) -> list[SourceFrame]:
    """Return the frames of a folder; frames of raw dumps are named by their times."""
    times: dict[str, dict[float, Path]] = {"r": {}, "d": {}}
    for path in source.iterdir():
        if match := _RAW.match(path.name):
            times[match[1]][float(match[2])] = path
    if not times["r"]:
        return pair_frames(source, None, COLOR_CAMERA, Scaled())
    depths_s = sorted(times["d"])
    return [
        SourceFrame(
            path.stem,
            path,
            times["d"][_nearest(depths_s, color_s)],
            COLOR_CAMERA,
            KinectCounts(),
        )
        for color_s, path in sorted(times["r"].items())
    ]


def _nearest(times_s: list[float], at_s: float) -> float:
    index = bisect_left(times_s, at_s)
    around = times_s[max(0, index - 1) : index + 1]
    return min(around, key=lambda time_s: abs(time_s - at_s))


def middlebury_frames(source: Path) -> list[SourceFrame]:
    """Return one frame per scene, named after its folder.

    Raises
    ------
    InvalidFile
        If a calibration cannot be read.  The message names the file and the field.
    """
    frames = []
    for folder in middlebury_scenes(source):
        optics, disparity = read_calibration(folder / "calib.txt")
        color, depth = folder / "im0.png", folder / "disp0.pfm"
        name = folder.resolve().name
        frames.append(SourceFrame(name, color, depth, optics, disparity))
    return frames


def middlebury_scenes(source: Path) -> list[Path]:
    """Return a folder if it is a scene, otherwise the scenes in it."""

    def is_scene(folder: Path) -> bool:
        return all((folder / name).is_file() for name in SCENE_FILES)

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
    for name in CALIBRATION_FIELDS:
        if name not in fields:
            raise InvalidFile(
                path, f"'{name}' is missing", ", ".join(CALIBRATION_FIELDS)
            )
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
    value = number_or_nan(text)
    return value if abs(value) <= LARGEST_NUMBER else math.nan


def _size_px(fields: dict[str, str]) -> tuple[int, int] | None:
    sides = fields.get("width", ""), fields.get("height", "")
    if not all(side.strip().isdecimal() and len(side) < 10 for side in sides):
        return None
    return int(sides[0]), int(sides[1])
