"""Reader of PGM and PPM files with any maximum, as stored.

Pillow scales the values of maxima other than 255 to 65535, which changes depth, and
reads colors of 16 bits as 8.
"""

from __future__ import annotations

import re
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from filter_service.bounded_images import (
    MAX_PIXELS,
    PIXEL_LIMIT,
    InvalidImage,
    check_deep_pixels,
    check_plain_samples,
    size_of,
    values_of,
)
from filter_service.color_encoding import Codes

_GAP = rb"(?:\s|#[^\r\n]*[\r\n])+"
_PNM_HEADER = re.compile(
    rb"P([2356])" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})\s"
)
_MAX_PNM_HEADER_BYTES = 4096


def is_pnm(file: BinaryIO) -> bool:
    """Return whether a file is a PGM or PPM."""
    file.seek(0)
    head = file.read(2)
    file.seek(0)
    return head in (b"P2", b"P3", b"P5", b"P6")


def pnm_values(file: BinaryIO) -> tuple[NDArray[Any], int]:
    """Return the values of a PGM (height, width) or PPM as stored, and the maximum.

    Raises
    ------
    InvalidImage
    """
    size_bytes = size_of(file)
    match = _PNM_HEADER.match(file.read(_MAX_PNM_HEADER_BYTES))
    intact = "an intact picture"
    if match is None:
        raise InvalidImage("cannot be read (its header)", intact)
    kind, width, height, top = (int(number) for number in match.groups())
    if width * height > MAX_PIXELS:
        raise InvalidImage(f"{width}x{height} px", PIXEL_LIMIT)
    if not (width and height and 0 < top < 65536):
        found = f"{width}x{height} px with the maximum {top}"
        raise InvalidImage(f"cannot be read ({found})", intact)
    channels = 3 if kind in (3, 6) else 1
    count = width * height * channels
    dtype = np.dtype(np.uint8 if top < 256 else ">u2")
    file.seek(match.end())
    if kind in (2, 3):
        check_plain_samples(count)
        text = re.sub(rb"#[^\r\n]*", b"", file.read(8 * count + (1 << 16)))
        words = text.split(maxsplit=count)[:count]
        values = np.array([int(word) for word in words])
    else:
        n_there = (size_bytes - match.end()) // dtype.itemsize
        values = values_of(file, dtype, min(count, n_there))
    if len(values) < count:
        raise InvalidImage(
            f"cannot be read ({len(values):,} of {count:,} values)", intact
        )
    if int(values.max()) > top or int(values.min()) < 0:
        raise InvalidImage(f"cannot be read (values above {top})", intact)
    shape = (height, width, channels)[: 2 if channels == 1 else 3]
    return values.astype(dtype.newbyteorder("=")).reshape(shape), top


def pnm_color(file: BinaryIO) -> Codes:
    """Return the colors (height, width, 3) with 255 or 65535 as the maximum.

    Raises
    ------
    InvalidImage
    """
    values, top = pnm_values(file)
    if top > 255:
        check_deep_pixels(values.shape[1], values.shape[0])
    if values.ndim == 2:
        values = np.repeat(values[..., None], 3, axis=2)
    if top in (255, 65535):
        return values
    kind = np.uint8 if top < 256 else np.uint16
    codes = np.arange(top + 1) * np.iinfo(kind).max / top
    return np.asarray(np.floor(codes + 0.5).astype(kind)[values])
