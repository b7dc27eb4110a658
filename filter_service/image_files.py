"""Reading of color and depth files, and writing of filtered images.

Color is uint8 sRGB (8-bit PNG, JPEG, ``.npy``) or float linear (``.npy``, ``.exr``);
negative and non-finite values are passed on to the filter.  The OpenEXR
library reads and writes its format, Pillow the others, including 32-bit float TIFF and
PFM.
"""

import math
import os
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from estimator.bounded_files import InvalidFile
from filter_service.bounded_images import (
    read_exr_channels,
    read_npy,
    read_picture_rgb,
    read_picture_values,
)

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".npy", ".exr")
DEPTH_SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".exr", ".pfm", ".pgm")
OUTPUT_SUFFIXES = (".png", ".npy", ".exr")
LINEAR_SUFFIXES = (".npy", ".exr")

METERS_PER_INTEGER_STEP = 0.001
"""Default depth scale of integer files: millimeters, as from depth cameras."""

ROW_VALUES = 1 << 20
"""Values converted at a time, so that no float64 copy of a large image is held."""


def read_color(
    path: Path, *, option: str = "color", content: bytes | None = None
) -> NDArray[Any]:
    """Read a color image.

    Parameters
    ----------
    option : str
        Option that requested it, for error messages; empty if there is none.
    content : bytes, optional
        Content of the file, which is read if this is not given.

    Returns
    -------
    (height, width, 3)
        uint8 sRGB, or float32 or float16 linear.  An alpha channel is dropped.

    Raises
    ------
    InvalidFile
        If the file is missing, of unknown format, damaged or too large, or its pixels
        have an unsupported type or shape.
    """
    suffix = _known_suffix(option, path, COLOR_SUFFIXES, content)
    pixels: NDArray[Any]
    if suffix == ".exr":
        pixels = _exr_color(path, option, content)
    elif suffix == ".npy":
        pixels = read_npy(path, option=option, content=content)
    else:
        source = path if content is None else content
        pixels = read_picture_rgb(source, name=str(path), option=option)
    return _checked_color(pixels, path, option)


def read_depth(
    path: Path,
    *,
    depth_scale: float | None = None,
    option: str = "depth",
    content: bytes | None = None,
) -> NDArray[np.float32]:
    """Read a depth image in meters.

    Parameters
    ----------
    depth_scale : float, optional
        Meters per stored unit; by default 0.001 for integers and 1 for floats.
        Required for 8-bit files, which are seldom in millimeters.
    option : str
        Option that requested it, for error messages; empty if there is none.
    content : bytes, optional
        Content of the file, which is read if this is not given.

    Returns
    -------
    depth_m : (height, width), m
        As stored: +inf is infinity; 0, negative and NaN are missing.

    Raises
    ------
    InvalidFile
        If the file is missing, of unknown format, damaged or too large, has several
        channels, or has 8 bits and no scale is given.
    ValueError
        If the scale is not positive.
    """
    suffix = _known_suffix(option, path, DEPTH_SUFFIXES, content)
    if suffix == ".exr":
        stored = _exr_depth(path, option, content)
    elif suffix == ".npy":
        stored = read_npy(path, option=option, content=content)
    else:
        source = path if content is None else content
        stored = read_picture_values(source, name=str(path), option=option)
    if stored.ndim == 3 and stored.shape[2] == 1:
        stored = stored[:, :, 0]
    if stored.ndim != 2 or stored.size == 0 or stored.dtype.kind not in "uif":
        found = f"{stored.dtype} of shape {stored.shape}"
        _raise_invalid(option, path, found, "one channel, integer or float")
    if depth_scale is None:
        if stored.dtype == np.uint8:  # in mm it would end at 25 cm
            allowed = "16 bits in mm, 32-bit float in m; with --depth-scale also 8 bits"
            _raise_invalid(option, path, "8 bits deep", allowed)
        depth_scale = 1.0 if stored.dtype.kind == "f" else METERS_PER_INTEGER_STEP
    if not (math.isfinite(depth_scale) and depth_scale > 0.0):
        raise ValueError(f"--depth-scale is {depth_scale}; allowed: a positive number")
    return _scaled(stored, depth_scale)


def _scaled(stored: NDArray[Any], depth_scale: float) -> NDArray[np.float32]:
    """Return stored values times the scale, multiplied in float64, some rows at a time.

    Values beyond float32 become infinity.
    """
    depth_m = np.empty(stored.shape, np.float32)
    step = max(1, ROW_VALUES // stored.shape[1])
    with np.errstate(over="ignore", invalid="ignore"):
        for top in range(0, len(stored), step):
            rows = slice(top, top + step)
            depth_m[rows] = stored[rows] * np.float64(depth_scale)
    return depth_m


def check_output(path: Path, suffixes: tuple[str, ...] = OUTPUT_SUFFIXES) -> None:
    """Reject an output path that cannot be written, before any work is done.

    Raises
    ------
    ValueError
        If the format is unknown, the folder does not exist or is not writable, or the
        path is a folder.
    """
    if path.suffix.lower() not in suffixes:
        found = f"'{path.suffix}' is not a kind of output"
        _raise_invalid("out", path, found, "a name that ends in " + ", ".join(suffixes))
    if not path.absolute().parent.is_dir():
        _raise_invalid("out", path, "its folder does not exist", "an existing folder")
    if not os.access(path.absolute().parent, os.W_OK):
        _raise_invalid("out", path, "its folder is read-only", "a writable folder")
    if path.is_dir():
        _raise_invalid("out", path, "it is a folder", "the name of a file")


def write_image(path: Path, image: NDArray[Any], *, png_level: int = 6) -> None:
    """Write uint8 sRGB to ``.png``, or linear floats to ``.npy`` or ``.exr``.

    Parameters
    ----------
    png_level : int, 0 to 9
        Compression level of a PNG: 1 takes a quarter of the time of 6, and the file is
        a fifth larger.

    Raises
    ------
    ValueError
        If the dtype does not match the format.
    """
    suffix = path.suffix.lower()
    is_linear = suffix in LINEAR_SUFFIXES
    wanted = (np.float32, np.float16) if is_linear else (np.uint8,)
    if image.dtype not in wanted:
        names = " or ".join(np.dtype(kind).name for kind in wanted)
        raise ValueError(f"{path}: got {image.dtype}, expected {names}")
    if suffix == ".npy":
        np.save(path, image)
    elif suffix == ".exr":
        _write_exr(path, image)
    else:
        Image.fromarray(image).save(path, compress_level=png_level)


# --- file formats ------------------------------------------------------------


def _raise_invalid(field: str, path: Path, found: str, allowed: str) -> NoReturn:
    raise InvalidFile(path, found, allowed, field)


def _known_suffix(
    field: str, path: Path, suffixes: tuple[str, ...], content: bytes | None
) -> str:
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        found = f"'{path.suffix}' is not a kind it reads"
        _raise_invalid(field, path, found, ", ".join(suffixes))
    if content is not None:
        return suffix
    try:
        is_file = path.is_file()
    except (OSError, ValueError):  # a null byte, or a name that is too long
        is_file = False
    if not is_file:
        _raise_invalid(field, path, "no such file", "a file that exists")
    return suffix


def _exr_color(path: Path, option: str, content: bytes | None) -> NDArray[np.float32]:
    def choose(names: set[str]) -> tuple[str, ...]:
        if not set("RGB") <= names:
            found = f"channels {', '.join(sorted(names))}"
            _raise_invalid(option, path, found[:200], "channels R, G and B")
        return tuple("RGB")

    channels = read_exr_channels(path, choose, option=option, content=content)
    shapes = {channel.shape for channel in channels.values()}
    if len(shapes) > 1:
        _raise_invalid(
            option, path, "channels of different sizes", "R, G and B of one size"
        )
    rgb = np.empty((*shapes.pop(), 3), np.float32)
    for k, name in enumerate("RGB"):
        rgb[:, :, k] = channels.pop(name)
    return rgb


def _exr_depth(path: Path, option: str, content: bytes | None) -> NDArray[np.float32]:
    def choose(names: set[str]) -> tuple[str, ...]:
        for name in ("Z", "Y", "R"):
            if name in names:
                return (name,)
        found = f"channels {', '.join(sorted(names))}"
        _raise_invalid(option, path, found[:200], "a channel Z, Y or R")

    channels = read_exr_channels(path, choose, option=option, content=content)
    return channels.popitem()[1]


def _write_exr(path: Path, linear_rgb: NDArray[Any]) -> None:
    import OpenEXR

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    channels = {"RGB": np.ascontiguousarray(linear_rgb)}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def _checked_color(pixels: NDArray[Any], path: Path, option: str) -> NDArray[Any]:
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.size == 0:
        _raise_invalid(option, path, f"shape {pixels.shape}", "(height, width, 3 or 4)")
    pixels = np.ascontiguousarray(pixels[:, :, :3])
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype.kind != "f":
        _raise_invalid(
            option, path, f"type {pixels.dtype}", "uint8 sRGB or float linear"
        )
    if pixels.dtype == np.float16:
        return pixels
    with np.errstate(over="ignore"):  # infinity is handled by the filter
        return pixels.astype(np.float32, copy=False)
