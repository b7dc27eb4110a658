"""Opening of pictures within memory limits, which are checked before decoding.

Pillow decodes PNG, JPEG, TIFF, WebP, PFM and PBM; `filter_service.pictures` makes
colors and depth of that.  The limits keep the peak memory of any file below 1 GB
(`ocufilter bench files`).  Exceptions of decoders become `InvalidFile`.
"""

from __future__ import annotations

import io
import logging
import os
import re
import struct
import tempfile
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import (
    ExitStack,
    contextmanager,
    nullcontext,
    redirect_stdout,
    suppress,
)
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray
from PIL import (
    Image,
    JpegImagePlugin,
    PngImagePlugin,
    PpmImagePlugin,
    TiffImagePlugin,
    UnidentifiedImageError,
    WebPImagePlugin,
)

from estimator.bounded_files import InvalidFile, reason_of

MAX_PIXELS = 1 << 26
"""8192 x 8192, four times the service's default limit of a view.  Pillow holds four
bytes per pixel, and the array beside it takes three: 0.47 GB."""

MAX_DECODED_BYTES = 4096 * 4096 * 3 * 8
"""403 MB: the service's largest default view in float64, or 100 megapixels of float32.
The float32 array made of it exists at the same time."""

MAX_FILE_BYTES = 1 << 29
"""More than any format needs for the decoded bytes, which leaves space for metadata."""

MAX_SCANNED_PIXELS = 1 << 30
"""Pixels of a JPEG times its scans, each of which visits all of them.  A progressive
camera image has 10 scans."""

MAX_PNG_CHUNKS = 200_000
"""Pillow takes a few microseconds for each; encoders write one per 8 kB."""

MAX_TIFF_VALUES = 1_000_000
"""Values of one numeric tag: they become Python numbers, 36 bytes each."""

MAX_SLOW_SAMPLES = 1 << 21
"""Samples of a picture in plain text."""

MAX_WEBP_PIXELS = 1 << 25
"""libwebp holds two canvases in addition to the image."""

FORMATS = (
    PngImagePlugin.PngImageFile.format,
    JpegImagePlugin.JpegImageFile.format,  # includes phone images (MPO in Pillow)
    PpmImagePlugin.PpmImageFile.format,
    TiffImagePlugin.TiffImageFile.format,
    WebPImagePlugin.WebPImageFile.format,
)

_MAX_CAPTURED_BYTES = 100_000
GLOBALS_LOCK = threading.RLock()
"""Warning filters, stdout and stderr are global to the process: concurrent readers
would restore each other's."""

PIXEL_LIMIT = f"at most {MAX_PIXELS:,} pixels, as 8192x8192"

# Otherwise Python writes Pillow's log records to stderr.
logging.getLogger("PIL").addHandler(logging.NullHandler())

Source = Path | bytes


@dataclass(frozen=True)
class Container:
    """Properties of a file that Pillow does not report.

    Attributes
    ----------
    color_codes : (int, int) or None
        Primaries and transfer characteristics of the chunk cICP of a PNG.
    has_more_pages : bool
        Whether a TIFF has more than one page.
    """

    color_codes: tuple[int, int] | None = None
    has_more_pages: bool = False


class InvalidImage(Exception):
    """An image was rejected: what was found, and what is allowed."""

    def __init__(self, found: str, allowed: str) -> None:
        super().__init__(found, allowed)
        self.found, self.allowed = found, allowed


@contextmanager
def open_picture(source: Source, name: str, option: str) -> Iterator[BinaryIO]:
    """Open a file or content; convert all errors to `InvalidFile`.

    Decoders run one at a time, because some of their state is global to the process.
    """
    named = name or str(source if isinstance(source, Path) else "picture")
    with GLOBALS_LOCK, warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # Pillow warns about sizes, which are checked here
        try:
            with (
                io.BytesIO(source) if isinstance(source, bytes) else open(source, "rb")
            ) as file:
                yield file
        except InvalidFile:
            raise
        except InvalidImage as error:
            raise InvalidFile(named, error.found, error.allowed, option) from None
        except FileNotFoundError:
            raise_invalid(named, "no such file", "a file that exists", option)
        except UnidentifiedImageError:
            found = "cannot be read (unknown image format)"
            raise_invalid(named, found, "PNG, JPEG, PPM, TIFF or WebP", option)
        except Exception as error:  # Pillow's decoders raise nearly anything
            found = f"cannot be read ({error_text(error)})"
            raise_invalid(named, found, "an intact picture", option)


@contextmanager
def decoded(
    file: BinaryIO, formats: Sequence[str] = FORMATS
) -> Iterator[tuple[Image.Image, Container]]:
    """Yield an image within the limits, whose pixels are not decoded yet."""
    container = _checked_container(file)
    file.seek(0)
    with Image.open(file, formats=tuple(formats)) as image:
        _check_picture(image, file)
        with captured_output() if image.format == "TIFF" else nullcontext():
            yield image, container


def values_of(file: BinaryIO, dtype: np.dtype, count: int) -> NDArray[Any]:
    """Return values from the position of a file on, which the caller has bounded."""
    if isinstance(file, io.BytesIO):
        return np.frombuffer(file.getbuffer(), dtype, count, file.tell()).copy()
    return np.fromfile(file, dtype, count)


@contextmanager
def captured_output() -> Iterator[list[str]]:
    """Capture a library's output on stdout and stderr; the list holds it afterward.

    The caller must hold `GLOBALS_LOCK`.
    """
    captured: list[str] = []
    printed = io.StringIO()
    with tempfile.TemporaryFile() as stderr_file, redirect_stdout(printed):
        with ExitStack() as stack:
            with suppress(OSError):  # stderr may not exist
                own = os.dup(2)
                stack.callback(os.close, own)
                stack.callback(os.dup2, own, 2)
                os.dup2(stderr_file.fileno(), 2)
            yield captured
        stderr_file.seek(0)
        captured.append(
            stderr_file.read(_MAX_CAPTURED_BYTES).decode("utf-8", "replace")
        )
        captured.append(printed.getvalue())


def error_text(error: BaseException) -> str:
    """Return the message of a decoder's exception, without memory addresses."""
    return re.sub(r"<[^>]* at 0x[0-9a-f]+>", "it", reason_of(error))


def raise_invalid(named: str | Path, found: str, allowed: str, option: str) -> NoReturn:
    """Raise `InvalidFile`, instead of the exception that is handled."""
    raise InvalidFile(named, found, allowed, option) from None


# --- images: checks before they are passed to Pillow --------------------------


def _checked_container(file: BinaryIO) -> Container:
    size_bytes = size_of(file)
    if size_bytes > MAX_FILE_BYTES:
        raise InvalidImage(f"{size_bytes:,} bytes", f"at most {MAX_FILE_BYTES:,} bytes")
    head = file.read(64)
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return Container(color_codes=_checked_png(file, size_bytes))
    if head.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
        return Container(has_more_pages=_checked_tiff(file, head))
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        # Checked here, because Pillow allocates the canvases on opening the file.
        width, height = _webp_size(head)
        if width * height > MAX_WEBP_PIXELS:
            allowed = f"at most {MAX_WEBP_PIXELS:,} pixels of a WebP"
            raise InvalidImage(f"{width}x{height} px", allowed)
    return Container()


def size_of(file: BinaryIO) -> int:
    """Return the size of a file, and seek to its beginning."""
    size_bytes = file.seek(0, os.SEEK_END)
    file.seek(0)
    return size_bytes


def _checked_png(file: BinaryIO, size_bytes: int) -> tuple[int, int] | None:
    """Count the chunks by reading only their headers; return the codes of cICP."""
    at, count = 8, 0
    codes = None
    while at < size_bytes:
        file.seek(at)
        head = file.read(10)
        if len(head) < 4:
            break  # truncated: the decoder reports it
        if head[4:8] == b"cICP" and len(head) == 10:
            codes = head[8], head[9]
        count += 1
        if count > MAX_PNG_CHUNKS:
            raise InvalidImage(f"more than {count - 1:,} chunks", f"{MAX_PNG_CHUNKS:,}")
        at += 12 + int.from_bytes(head[:4], "big")
    return codes


_TIFF_NUMERIC = {3, 4, 5, 6, 8, 9, 10, 11, 12, 13, 16, 17, 18}


def _checked_tiff(file: BinaryIO, head: bytes) -> bool:
    """Limit the values of each tag of the first page; return whether others follow."""
    order = "<" if head[:1] == b"I" else ">"
    is_big = b"+" in head[2:4]
    offset_at, offset, count, entry = (
        (8, "Q", "Q", "HHQ8x") if is_big else (4, "L", "H", "HHL4x")
    )
    try:
        (start,) = struct.unpack_from(order + offset, head, offset_at)
        file.seek(start)
        counted = struct.Struct(order + count)
        (n_tags,) = counted.unpack(file.read(counted.size))
        tags = struct.Struct(order + entry)
        if n_tags > 4096:
            raise InvalidImage(f"{n_tags} tags", "at most 4096")
        content = file.read(n_tags * tags.size)
        entries = list(
            tags.iter_unpack(content[: len(content) // tags.size * tags.size])
        )
        has_more = any(file.read(struct.calcsize(order + offset)))
    except (struct.error, OverflowError):
        return False  # truncated: the decoder reports it
    for tag, kind, n_values in entries:
        if kind in _TIFF_NUMERIC and n_values > MAX_TIFF_VALUES:
            found = f"tag {tag} with {n_values:,} values"
            raise InvalidImage(found, f"at most {MAX_TIFF_VALUES:,}")
    return has_more


def _webp_size(head: bytes) -> tuple[int, int]:
    """Return the canvas of a WebP, or (0, 0) if the decoder will reject it."""
    kind, data = head[12:16], head[20:30]
    if len(data) < 10:
        return 0, 0
    if kind == b"VP8X":
        sides = data[4:7], data[7:10]
        width, height = (int.from_bytes(side, "little") + 1 for side in sides)
    elif kind == b"VP8L":
        bits = int.from_bytes(data[1:5], "little")
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        sides = data[6:8], data[8:10]
        width, height = (int.from_bytes(side, "little") & 0x3FFF for side in sides)
    return width, height


def _check_picture(image: Image.Image, file: BinaryIO) -> None:
    """Reject an image that is too large according to its header."""
    width, height = image.size
    n_pixels = width * height
    if n_pixels > MAX_PIXELS:
        raise InvalidImage(f"{width}x{height} px", PIXEL_LIMIT)
    if image.format in ("JPEG", "MPO"):
        n_scans = _count(file, b"\xff\xda")
        if n_scans * n_pixels > MAX_SCANNED_PIXELS:
            allowed = f"at most {MAX_SCANNED_PIXELS:,} pixels in all scans"
            raise InvalidImage(f"{width}x{height} px in {n_scans} scans", allowed)
    elif image.format == "TIFF":
        _check_tiles(image)
    elif image.format == "PPM" and (tiles := getattr(image, "tile", None)):
        if tiles[0][0] == "ppm_plain":
            check_plain_samples(n_pixels)


def check_deep_pixels(width: int, height: int) -> None:
    """Limit the pixels of a color picture of 16 bits: three float32 values each."""
    most = MAX_DECODED_BYTES // 12
    if width * height > most:
        found = f"{width}x{height} px of 16 bits"
        raise InvalidImage(found, f"at most {most:,} pixels")


def check_plain_samples(count: int) -> None:
    """Limit the samples of a picture in plain text, about a microsecond each."""
    if count > MAX_SLOW_SAMPLES:
        allowed = f"at most {MAX_SLOW_SAMPLES:,} samples in plain text"
        raise InvalidImage(f"{count:,} samples", allowed)


def _check_tiles(image: Image.Image) -> None:
    """Reject tiles that are much larger than the image: they are decoded whole."""
    tags = image.tag_v2  # type: ignore[attr-defined]
    tile_width, tile_height = (int(tags.get(tag, 0)) for tag in (322, 323))
    if tile_width * tile_height > MAX_PIXELS:
        raise InvalidImage(f"tiles of {tile_width}x{tile_height} px", PIXEL_LIMIT)


def _count(file: BinaryIO, marker: bytes) -> int:
    """Count a two-byte marker in a file, and restore the file's position."""
    before = file.tell()
    file.seek(0)
    count, last = 0, b""
    while block := file.read(1 << 20):
        count += (last + block).count(marker)
        last = block[-1:]
    file.seek(before)
    return count
