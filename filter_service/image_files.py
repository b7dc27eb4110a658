"""Reading of color and depth files, and writing of filtered images.

Color is uint8 sRGB (8-bit PNG, JPEG, ``.npy``), or linear sRGB in floats (16-bit PNG,
``.npy``, ``.exr``); negative and non-finite values are passed on to the filter.  The
OpenEXR library reads and writes its format, Pillow the others, including 32-bit float
TIFF and PFM.
"""

from __future__ import annotations

import io
import math
import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from estimator.bounded_files import InvalidFile, printable, reason_of
from filter_service.bounded_images import (
    MAX_DECODED_BYTES,
    InvalidImage,
    size_of,
    values_of,
)
from filter_service.camera import PixelGrid
from filter_service.color_encoding import SRGB
from filter_service.exr_files import read_exr_color, read_exr_depth, write_exr
from filter_service.pictures import read_picture_color, read_picture_values, shown

MAX_NPY_HEADER_BYTES = 10_000
NPY_MAGIC = b"\x93NUMPY"
_NPY_FIELD = re.compile(
    r"""\s*['"](descr|fortran_order|shape)['"]\s*:\s*"""
    r"""(?:['"]([<>|=][a-z]\d{1,2})['"]|(True|False)|\(([\d,\sL]*)\))\s*(?:,|(?=\}))"""
)


def read_npy(
    path: Path, *, option: str = "", content: bytes | None = None
) -> NDArray[Any]:
    """Return the array of a ``.npy`` file of bool, integers or floats.

    The shape in the header is compared with the file's size and the limits before any
    memory is allocated.  ``content`` is the content of the file, if it has been read.

    Raises
    ------
    InvalidFile
    """
    try:
        with open(path, "rb") if content is None else io.BytesIO(content) as file:
            return _npy_array(file, size_of(file))
    except InvalidImage as error:
        raise InvalidFile(path, error.found, error.allowed, option) from None
    except (OSError, ValueError, MemoryError) as error:
        found = f"cannot be read ({reason_of(error)})"
        raise InvalidFile(path, found, "an intact .npy file", option) from None


def _npy_array(file: BinaryIO, size_bytes: int) -> NDArray[Any]:
    dtype, shape, is_fortran = _npy_header(file)
    n_values = math.prod(shape)
    n_bytes = n_values * dtype.itemsize
    claimed = f"shape {shape} of {dtype}"
    n_there = size_bytes - file.tell()
    if n_bytes > n_there:
        found = f"cannot be read ({claimed} in {n_there:,} bytes)"
        raise InvalidImage(found, f"a file with all of its {n_bytes:,} bytes")
    if n_bytes > MAX_DECODED_BYTES:
        allowed = f"at most {MAX_DECODED_BYTES:,} bytes"
        raise InvalidImage(f"{claimed}, {n_bytes:,} bytes", allowed)
    array = values_of(file, dtype, n_values)
    return array.reshape(shape, order="F" if is_fortran else "C")


def _npy_header(file: BinaryIO) -> tuple[np.dtype, tuple[int, ...], bool]:
    """Return the dtype, shape and order of a header, without evaluating it."""
    intact = "a .npy file of bool, integers or floats"
    magic = file.read(8)
    if magic[:6] != NPY_MAGIC or magic[6:7] not in (b"\1", b"\2", b"\3"):
        raise InvalidImage("cannot be read (not a .npy file)", intact)
    width = 2 if magic[6] == 1 else 4
    n_header = int.from_bytes(file.read(width), "little")
    if n_header > MAX_NPY_HEADER_BYTES:
        found = f"a header of {n_header:,} bytes"
        raise InvalidImage(found, f"at most {MAX_NPY_HEADER_BYTES:,} bytes")
    header = file.read(n_header)
    text = header.decode("latin-1" if magic[6] < 3 else "utf-8").strip()
    fields: dict[str, tuple[str, ...]] = {}
    at = 1
    while text[:1] == "{" and (match := _NPY_FIELD.match(text, at)):
        fields[match[1]] = match.groups()[1:]
        at = match.end()
    is_whole = len(header) == n_header and text[at:].strip() == "}"
    if not is_whole or set(fields) != {"descr", "fortran_order", "shape"}:
        raise InvalidImage(
            "cannot be read (another header than a plain array's)", intact
        )
    descr, order, shape = (
        fields[name][k] for k, name in enumerate(("descr", "fortran_order", "shape"))
    )
    if descr is None or order is None or shape is None:
        raise InvalidImage(
            "cannot be read (another header than a plain array's)", intact
        )
    try:
        dtype = np.dtype(descr)
        sides = tuple(
            int(side.rstrip("L")) for side in shape.split(",") if side.strip()
        )
    except (TypeError, ValueError):
        raise InvalidImage(
            f"cannot be read ({descr} of shape ({shape:.40}))", intact
        ) from None
    if dtype.kind not in "buif" or len(sides) > 8:
        raise InvalidImage(f"cannot be read ({dtype} of shape {sides})", intact)
    return dtype, sides, order == "True"


COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".npy", ".exr")
DEPTH_SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".exr", ".pfm", ".pgm")
OUTPUT_SUFFIXES = (".png", ".npy", ".exr")
LINEAR_SUFFIXES = (".npy", ".exr")

METERS_PER_INTEGER_STEP = 0.001
"""Default depth scale of integer files: millimeters, as from depth cameras."""

NO_RETURN = 65535
"""Value of 16-bit depth where a camera measured nothing, or as far as it can."""

ROW_VALUES = 1 << 20
"""Values converted at a time, so that no float64 copy of a large image is held."""

SAMPLED_VALUES = 1 << 16
"""Values that are examined for likely mistakes of units."""

FARTHEST_NEAR_M, NEAREST_FAR_M = 50.0, 0.05
"""Depth is doubtful if all of it is farther or nearer: outdoors, the ground is nearer
than 50 m, and no eye focuses at 5 cm."""


@dataclass(frozen=True)
class ImageFile:
    """Content of a color or depth file.

    Attributes
    ----------
    pixels : (height, width, 3) or (height, width)
    grid : PixelGrid
        Place and shape of the pixels.
    notes : tuple of str
        What the pixels do not show, or likely mistakes; each names the file.
    """

    pixels: NDArray[Any]
    grid: PixelGrid
    notes: tuple[str, ...] = ()

    def plain(self) -> NDArray[Any]:
        """Return the pixels; warn of each note, and of pixels that are not plain."""
        notes = list(self.notes)
        if self.grid.is_part or self.grid.pixel_aspect_ratio != 1.0:
            notes.append(f"the pixels need a camera for {self.grid}")
        for note in notes:
            warnings.warn(note, stacklevel=3)
        return self.pixels


def read_color(path: Path, *, option: str = "color") -> NDArray[Any]:
    """Return the pixels of `read_color_file`; each note becomes a `UserWarning`.

    Raises
    ------
    InvalidFile
    """
    return read_color_file(path, option=option).plain()


def read_depth(
    path: Path, *, depth_scale: float | None = None, option: str = "depth"
) -> NDArray[np.float32]:
    """Return the depth of `read_depth_file`; each note becomes a `UserWarning`.

    Raises
    ------
    InvalidFile
    ValueError
        If the scale is not positive.
    """
    return read_depth_file(path, depth_scale=depth_scale, option=option).plain()


def read_color_file(
    path: Path, *, option: str = "color", content: bytes | None = None
) -> ImageFile:
    """Read a color image.

    Parameters
    ----------
    option : str
        Option that requested it, for error messages; empty if there is none.
    content : bytes, optional
        Content of the file, which is read if this is not given.

    Returns
    -------
    ImageFile
        Pixels (height, width, 3): uint8 sRGB, or float32 or float16 linear sRGB.
        Color profiles are applied, and pixels that are not opaque are over black.

    Raises
    ------
    InvalidFile
        If the file is missing, of unknown format, damaged or too large, or its pixels
        have an unsupported type or shape.
    """
    suffix = _known_suffix(option, path, COLOR_SUFFIXES, content)
    notes: list[str] = []
    grid = None
    pixels: NDArray[Any]
    if suffix == ".exr":
        pixels, grid = read_exr_color(path, notes, option=option, content=content)
    elif suffix == ".npy":
        pixels = read_npy(path, option=option, content=content)
    else:
        source = path if content is None else content
        pixels, notes = read_picture_color(source, name=str(path), option=option)
    pixels = _checked_color(pixels, path, option, notes)
    if suffix in LINEAR_SUFFIXES and pixels.dtype != np.uint8:
        _note_bright(pixels, notes)
    return _image_file(path, pixels, grid, notes)


def read_depth_file(
    path: Path,
    *,
    depth_scale: float | None = None,
    option: str = "depth",
    content: bytes | None = None,
) -> ImageFile:
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
    ImageFile
        float32 pixels (height, width), m, as stored: +inf is infinity; 0, negative and
        NaN are missing.  65535 of 16 bits becomes 0.

    Raises
    ------
    InvalidFile
        If the file is missing, of unknown format, damaged or too large, has several
        channels, or has 8 bits and no scale is given.
    ValueError
        If the scale is not positive.
    """
    stored = read_stored_depth(path, option=option, content=content)
    values, notes = stored.pixels, [*stored.notes]
    if depth_scale is None:
        if values.dtype == np.uint8:  # in mm it would end at 25 cm
            allowed = "16 bits in mm, 32-bit float in m; with --depth-scale also 8 bits"
            _raise_invalid(option, path, "8 bits deep", allowed)
        if values.dtype.kind != "f" and path.suffix.lower() == ".npy":
            notes.append(
                named_note(
                    path, "integers are millimeters unless --depth-scale is given"
                )
            )
    depth_m, new = depth_of(values, depth_scale)
    return replace(
        stored,
        pixels=depth_m,
        notes=(*notes, *(named_note(path, note) for note in new)),
    )


def read_stored_depth(
    path: Path, *, option: str = "depth", content: bytes | None = None
) -> ImageFile:
    """Read the numbers of a depth file, of one channel, as stored.

    The parameters and errors are the same as for `read_depth_file`.
    """
    suffix = _known_suffix(option, path, DEPTH_SUFFIXES, content)
    notes: list[str] = []
    grid = None
    if suffix == ".exr":
        stored, grid = read_exr_depth(path, notes, option=option, content=content)
    elif suffix == ".npy":
        stored = read_npy(path, option=option, content=content)
    else:
        source = path if content is None else content
        stored, notes = read_picture_values(source, name=str(path), option=option)
    if stored.ndim == 3 and stored.shape[2] == 1:
        stored = stored[:, :, 0]
    if stored.ndim != 2 or stored.size == 0 or stored.dtype.kind not in "uif":
        found = f"{stored.dtype} of shape {stored.shape}"
        _raise_invalid(option, path, found, "one channel, integer or float")
    return _image_file(path, stored, grid, notes)


def depth_of(
    stored: NDArray[Any], depth_scale: float | None = None
) -> tuple[NDArray[np.float32], list[str]]:
    """Return stored numbers as depth in meters, and notes on doubtful values.

    Parameters
    ----------
    depth_scale : float, optional
        Meters per stored unit; by default 0.001 for integers and 1 for floats.

    Raises
    ------
    ValueError
        If the scale is not positive.
    """
    is_float = stored.dtype.kind == "f"
    if depth_scale is None:
        depth_scale = 1.0 if is_float else METERS_PER_INTEGER_STEP
    if not (math.isfinite(depth_scale) and depth_scale > 0.0):
        raise ValueError(f"--depth-scale is {depth_scale}; allowed: a positive number")
    depth_m = _scaled(stored, depth_scale)
    notes: list[str] = []
    if stored.dtype == np.uint16:
        none = stored == NO_RETURN
        if none.any():
            depth_m[none] = 0.0
            share = 100.0 * float(none.mean())
            notes.append(f"{share:.3g} % of the depth is {NO_RETURN}: missing")
    _note_doubtful_depth(depth_m, notes)
    return depth_m, notes


def _note_doubtful_depth(depth_m: NDArray[np.float32], notes: list[str]) -> None:
    """Note depth whose unit or sign is probably wrong."""
    some_m = _sampled(depth_m)
    known_m = some_m[(some_m > 0.0) & np.isfinite(some_m)]
    if not known_m.size:
        if (some_m < 0.0).any():
            notes.append(
                "all depth is negative and therefore missing; view-space z of OpenGL "
                "must be negated"
            )
        return
    near_m, far_m = (float(value) for value in np.percentile(known_m, (1, 99)))
    if near_m > FARTHEST_NEAR_M or far_m < NEAREST_FAR_M:
        notes.append(
            f"depth of {near_m:.3g} to {far_m:.3g} m is unusual; is it in meters? "
            "Otherwise pass --depth-scale, in meters per unit"
        )


def _note_bright(linear: NDArray[Any], notes: list[str]) -> None:
    """Note light of which most is brighter than white."""
    some = _sampled(linear)
    with np.errstate(invalid="ignore"):
        share = float((some > 1.0).mean())
    if share > 0.5:
        top = float(np.nanmax(some))
        notes.append(
            f"{100.0 * share:.0f} % of the light is above 1, which is white, up to "
            f"{top:.4g}; is it 0 to {255 if top <= 255.5 else 65535}?"
        )


def _sampled(values: NDArray[Any]) -> NDArray[Any]:
    """Return values at regular places, at most about `SAMPLED_VALUES`."""
    rows = max(1, math.ceil(values.size / SAMPLED_VALUES))
    return values[:: math.isqrt(rows - 1) + 1, :: math.isqrt(rows - 1) + 1]


def named_note(path: Path, note: str) -> str:
    """Return a note on a file with the file's name, as one line."""
    return printable(f"'{path.name}': {note}", most=500)


def _image_file(
    path: Path, pixels: NDArray[Any], grid: PixelGrid | None, notes: list[str]
) -> ImageFile:
    height_px, width_px = pixels.shape[:2]
    named = tuple(named_note(path, note) for note in notes)
    return ImageFile(pixels, grid or PixelGrid(width_px, height_px), named)


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


def check_output(
    path: Path, suffixes: tuple[str, ...] = OUTPUT_SUFFIXES, *, option: str = "out"
) -> None:
    """Reject an output path that cannot be written, before any work is done.

    Raises
    ------
    ValueError
        If the format is unknown, the folder does not exist or is not writable, or the
        path is a folder.
    """
    if path.suffix.lower() not in suffixes:
        found = f"'{path.suffix}' is not a kind of output"
        _raise_invalid(
            option, path, found, "a name that ends in " + ", ".join(suffixes)
        )
    if not path.absolute().parent.is_dir():
        _raise_invalid(option, path, "its folder does not exist", "an existing folder")
    if not os.access(path.absolute().parent, os.W_OK):
        _raise_invalid(option, path, "its folder is read-only", "a writable folder")
    if path.is_dir():
        _raise_invalid(option, path, "it is a folder", "the name of a file")


def write_image(
    path: Path,
    image: NDArray[Any],
    *,
    png_level: int = 6,
    grid: PixelGrid | None = None,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write uint8 sRGB to ``.png``, or linear floats to ``.npy`` or ``.exr``.

    Parameters
    ----------
    png_level : int, 0 to 9
        Compression level of a PNG: 1 takes a quarter of the time of 6, and the file is
        a fifth larger.
    grid : PixelGrid, optional
        Place and shape of the pixels, which only OpenEXR stores.
    metadata : mapping, optional
        ASCII text by key, which PNG (tEXt) and OpenEXR (string attributes) store.

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
        write_exr(path, image, grid, metadata or {})
    else:
        chunks = PngInfo()
        for key, text in (metadata or {}).items():
            chunks.add_text(key, text)
        Image.fromarray(image).save(path, compress_level=png_level, pnginfo=chunks)


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


def _checked_color(
    pixels: NDArray[Any], path: Path, option: str, notes: list[str]
) -> NDArray[Any]:
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.size == 0:
        _raise_invalid(option, path, f"shape {pixels.shape}", "(height, width, 3 or 4)")
    alpha = pixels[:, :, 3] if pixels.shape[2] == 4 else None
    pixels = np.ascontiguousarray(pixels[:, :, :3])
    if pixels.dtype == np.uint8:
        return pixels if alpha is None else shown(pixels, alpha, SRGB, notes)
    if pixels.dtype.kind != "f":
        _raise_invalid(
            option, path, f"type {pixels.dtype}", "uint8 sRGB or float linear"
        )
    if alpha is not None and not (alpha == 1.0).all():
        found = "a fourth channel that is not 1"
        _raise_invalid(option, path, found, "three channels: light over a background")
    if pixels.dtype == np.float16:
        return pixels
    with np.errstate(over="ignore"):  # infinity is handled by the filter
        return pixels.astype(np.float32, copy=False)
