"""Folders of color and depth images, paired by their names.

color/0001.png      depth/0001.exr       two folders with known names
0001_color.png      0001_depth.npy       one folder, names with a known word
0001.jpg            0001.npy             one folder, distinguished by file type

Names of folders may have any case.  Names of files meet if they are the same text,
however it is encoded: macOS stores letters with accents as two characters.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path
from typing import cast

from clients.batch.source import Optics, Scaled, SourceFrame
from filter_service.image_files import COLOR_SUFFIXES, DEPTH_SUFFIXES

COLOR_FOLDERS = ("color", "colour", "rgb", "image", "images", "left", "frames")
DEPTH_FOLDERS = ("depth", "depths", "depth_m", "depthmap", "depthmaps")
COLOR_WORDS = ("colors", "color", "colour", "rgb", "image", "img")
DEPTH_WORDS = ("sync_depth", "depth", "z")


_NUMBER = re.compile(r"(\d+)", re.ASCII)
_DECIMAL = re.compile(r"(\d+)(\.\d+)", re.ASCII)


def same_text(name: str) -> str:
    """Return a name whose letters with accents are one character each (NFC)."""
    return unicodedata.normalize("NFC", name)


def in_order(names: Iterable[str]) -> list[str]:
    """Return names sorted as people count: 2 before 10, and times as decimals."""
    return sorted(names, key=_counted)


def _counted(name: str) -> tuple[list[str | float], str]:
    """Return a key: text and numbers in turn, so that like is compared with like."""
    text = same_text(name)
    if match := _DECIMAL.fullmatch(text):
        return ["", int(match[1]), ".", float(match[2])], name
    parts = _NUMBER.split(text)
    numbered = [int(part) if k % 2 else part for k, part in enumerate(parts)]
    return [*numbered], name


def _at_an_end(words: tuple[str, ...]) -> re.Pattern[str]:
    any_of = "|".join(words)
    # Not on the text in lower case: that of some letters has another length.
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
                f"as color/ and depth/, names that end in _depth, or --depth DIR"
            )
    return _named(colors, _COLOR_WORD), _named(depths, _DEPTH_WORD)


_PICTURES = (".png", ".jpg", ".jpeg", ".ppm")


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
