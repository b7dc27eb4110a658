"""Image decoders with memory limits, which are checked before decoding.

Pillow decodes PNG, JPEG, PPM, PGM, PFM, TIFF and WebP, and the OpenEXR library decodes
its own format; ``.npy`` files are read here, because NumPy's reader evaluates the text
of the header.  The limits keep the peak memory of any file below 1 GB
(`ocufilter bench files`).  Exceptions of decoders become `InvalidFile`.
"""

from __future__ import annotations

import io
import logging
import math
import os
import re
import struct
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import (
    ExitStack,
    contextmanager,
    nullcontext,
    redirect_stdout,
    suppress,
)
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray
from PIL import (
    Image,
    ImageOps,
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
"""Samples of a PPM or PGM in plain text or of unusual depth, which Pillow decodes in
Python: about a microsecond each."""

MAX_NPY_HEADER_BYTES = 10_000
MAX_WEBP_PIXELS = 1 << 25
"""libwebp holds two canvases in addition to the image."""

FORMATS = (
    PngImagePlugin.PngImageFile.format,
    JpegImagePlugin.JpegImageFile.format,  # includes phone images (MPO in Pillow)
    PpmImagePlugin.PpmImageFile.format,
    TiffImagePlugin.TiffImageFile.format,
    WebPImagePlugin.WebPImageFile.format,
)

MAX_EXR_CHUNK_BYTES = 1 << 26
"""Size of the rows decoded at once: DWA holds them four times, besides the image."""

EXR_CHUNK_ROWS = {
    **dict.fromkeys(("NO_COMPRESSION", "RLE_COMPRESSION", "ZIPS_COMPRESSION"), 1),
    **dict.fromkeys(("ZIP_COMPRESSION", "PXR24_COMPRESSION"), 16),
    **dict.fromkeys(("PIZ_COMPRESSION", "B44_COMPRESSION", "B44A_COMPRESSION"), 32),
    **dict.fromkeys(("DWAA_COMPRESSION", "HTJ2K32_COMPRESSION"), 32),
}
"""Rows per chunk by compression; 256 for any other."""

EXR_INCOMPLETE = "Exception raised reading pixel data"
"""Text that the library prints if pixels are damaged, and only then."""

EXR_MAGIC = b"\x76\x2f\x31\x01"
NPY_MAGIC = b"\x93NUMPY"
_NPY_FIELD = re.compile(
    r"""\s*['"](descr|fortran_order|shape)['"]\s*:\s*"""
    r"""(?:['"]([<>|=][a-z]\d{1,2})['"]|(True|False)|\(([\d,\sL]*)\))\s*(?:,|(?=\}))"""
)

_MAX_CAPTURED_BYTES = 100_000
_GLOBALS_LOCK = threading.RLock()
"""Warning filters, stdout and stderr are global to the process: concurrent readers
would restore each other's."""

_PIXEL_LIMIT = f"at most {MAX_PIXELS:,} pixels, as 8192x8192"

# Otherwise Python writes Pillow's log records to stderr.
logging.getLogger("PIL").addHandler(logging.NullHandler())

Source = Path | bytes


def read_picture_rgb(
    source: Source,
    *,
    name: str = "",
    option: str = "",
    upright: bool = True,
    formats: Sequence[str] = FORMATS,
) -> NDArray[np.uint8]:
    """Return an image of 8 bits per channel as sRGB (height, width, 3).

    Parameters
    ----------
    source : Path or bytes
        The file, or its content.
    name : str
        Name of the image in error messages; its path by default.
    option : str
        Option that requested it, for error messages.
    upright : bool
        Whether to apply the EXIF orientation.
    formats : sequence of str
        Pillow's names of the accepted formats, regardless of the file's suffix.

    Raises
    ------
    InvalidFile
    """
    with _open_image(source, name, option, formats) as image:
        if image.mode.startswith(("I", "F")):
            raise _InvalidImage(f"mode {image.mode}", "8 bits per channel")
        image.load()
        picture = ImageOps.exif_transpose(image) if upright else image
        return _to_rgb(picture)


def read_picture_values(
    source: Source, *, name: str = "", option: str = ""
) -> NDArray[Any]:
    """Return the stored values of an image, upright, as needed for depth files.

    Raises
    ------
    InvalidFile
    """
    with _open_image(source, name, option) as image:
        image.load()
        return np.asarray(ImageOps.exif_transpose(image))


def check_picture(source: Source, *, name: str = "", option: str = "") -> int:
    """Check an image's format and size without decoding it; return its pixel count.

    Raises
    ------
    InvalidFile
    """
    with _open_image(source, name, option) as image:
        return image.width * image.height


class _InvalidImage(Exception):
    """An image was rejected: what was found, and what is allowed."""

    def __init__(self, found: str, allowed: str) -> None:
        super().__init__(found, allowed)
        self.found, self.allowed = found, allowed


@contextmanager
def _open_image(
    source: Source, name: str, option: str, formats: Sequence[str] = FORMATS
) -> Iterator[Image.Image]:
    """Open an image within the limits; convert all errors to `InvalidFile`."""
    named = name or str(source if isinstance(source, Path) else "picture")
    with _GLOBALS_LOCK, warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # Pillow warns about sizes, which are checked here
        try:
            file = (
                io.BytesIO(source) if isinstance(source, bytes) else open(source, "rb")  # noqa: SIM115
            )
            with file:
                _check_container(file)
                file.seek(0)
                with Image.open(file, formats=tuple(formats)) as image:
                    _check_picture(image, file)
                    with (
                        _captured_output() if image.format == "TIFF" else nullcontext()
                    ):
                        yield image
        except InvalidFile:
            raise
        except _InvalidImage as error:
            raise InvalidFile(named, error.found, error.allowed, option) from None
        except FileNotFoundError:
            _raise_invalid(named, "no such file", "a file that exists", option)
        except UnidentifiedImageError:
            found = "cannot be read (unknown image format)"
            _raise_invalid(named, found, "PNG, JPEG, PPM, TIFF or WebP", option)
        except Exception as error:  # Pillow's decoders raise nearly anything
            found = f"cannot be read ({_error_text(error)})"
            _raise_invalid(named, found, "an intact picture", option)


@contextmanager
def _captured_output() -> Iterator[list[str]]:
    """Capture a library's output on stdout and stderr; the list holds it afterward.

    The caller must hold `_GLOBALS_LOCK`.
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


def _error_text(error: BaseException) -> str:
    """Return the message of a decoder's exception, without memory addresses."""
    return re.sub(r"<[^>]* at 0x[0-9a-f]+>", "it", reason_of(error))


def _raise_invalid(
    named: str | Path, found: str, allowed: str, option: str
) -> NoReturn:
    raise InvalidFile(named, found, allowed, option) from None


def _to_rgb(image: Image.Image) -> NDArray[np.uint8]:
    """Convert to RGB, some rows at a time to limit memory."""
    width, height = image.size
    rgb = np.empty((height, width, 3), np.uint8)
    step = max(1, (1 << 22) // max(1, width))
    for top in range(0, height, step):
        rows = image.crop((0, top, width, min(top + step, height)))
        rgb[top : top + step] = np.asarray(rows.convert("RGB"))
    return rgb


# --- images: checks before they are passed to Pillow --------------------------


def _check_container(file: BinaryIO) -> None:
    size_bytes = _size_of(file)
    if size_bytes > MAX_FILE_BYTES:
        raise _InvalidImage(
            f"{size_bytes:,} bytes", f"at most {MAX_FILE_BYTES:,} bytes"
        )
    head = file.read(64)
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        _check_png(file, size_bytes)
    elif head.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
        _check_tiff(file, head)
    elif head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        # Checked here, because Pillow allocates the canvases on opening the file.
        width, height = _webp_size(head)
        if width * height > MAX_WEBP_PIXELS:
            allowed = f"at most {MAX_WEBP_PIXELS:,} pixels of a WebP"
            raise _InvalidImage(f"{width}x{height} px", allowed)


def _size_of(file: BinaryIO) -> int:
    size_bytes = file.seek(0, os.SEEK_END)
    file.seek(0)
    return size_bytes


def _check_png(file: BinaryIO, size_bytes: int) -> None:
    """Count the chunks by reading only their headers."""
    at, count = 8, 0
    while at < size_bytes:
        file.seek(at)
        head = file.read(4)
        if len(head) < 4:
            return  # truncated: the decoder reports it
        count += 1
        if count > MAX_PNG_CHUNKS:
            raise _InvalidImage(
                f"more than {count - 1:,} chunks", f"{MAX_PNG_CHUNKS:,}"
            )
        at += 12 + int.from_bytes(head, "big")


_TIFF_NUMERIC = {3, 4, 5, 6, 8, 9, 10, 11, 12, 13, 16, 17, 18}


def _check_tiff(file: BinaryIO, head: bytes) -> None:
    """Limit the number of values in each tag of the first image."""
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
            raise _InvalidImage(f"{n_tags} tags", "at most 4096")
        content = file.read(n_tags * tags.size)
        entries = list(
            tags.iter_unpack(content[: len(content) // tags.size * tags.size])
        )
    except (struct.error, OverflowError):
        return  # truncated: the decoder reports it
    for tag, kind, n_values in entries:
        if kind in _TIFF_NUMERIC and n_values > MAX_TIFF_VALUES:
            found = f"tag {tag} with {n_values:,} values"
            raise _InvalidImage(found, f"at most {MAX_TIFF_VALUES:,}")


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
        raise _InvalidImage(f"{width}x{height} px", _PIXEL_LIMIT)
    if image.format in ("JPEG", "MPO"):
        n_scans = _count(file, b"\xff\xda")
        if n_scans * n_pixels > MAX_SCANNED_PIXELS:
            allowed = f"at most {MAX_SCANNED_PIXELS:,} pixels in all scans"
            raise _InvalidImage(f"{width}x{height} px in {n_scans} scans", allowed)
    elif image.format == "TIFF":
        _check_tiles(image)
    elif image.format == "PPM" and (tiles := getattr(image, "tile", None)):
        is_slow = tiles[0][0] in ("ppm", "ppm_plain")
        n_samples = n_pixels * len(image.getbands())
        if is_slow and n_samples > MAX_SLOW_SAMPLES:
            allowed = (
                f"at most {MAX_SLOW_SAMPLES:,} samples in plain text or of another "
                "maximum than 255 or 65535"
            )
            raise _InvalidImage(f"{n_samples:,} samples", allowed)


def _check_tiles(image: Image.Image) -> None:
    """Reject tiles that are much larger than the image: they are decoded whole."""
    tags = image.tag_v2  # type: ignore[attr-defined]
    tile_width, tile_height = (int(tags.get(tag, 0)) for tag in (322, 323))
    if tile_width * tile_height > MAX_PIXELS:
        raise _InvalidImage(f"tiles of {tile_width}x{tile_height} px", _PIXEL_LIMIT)


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


# --- .npy ---------------------------------------------------------------------


def read_npy(
    path: Path, *, option: str = "", content: bytes | None = None
) -> NDArray[Any]:
    """Return the array of a ``.npy`` file of bool, integers or floats.

    The shape in the header is compared with the file's size and the limits before any
    memory is allocated.  ``content`` is that of the file, if it has been read.

    Raises
    ------
    InvalidFile
    """
    try:
        with open(path, "rb") if content is None else io.BytesIO(content) as file:
            return _npy_array(file, _size_of(file))
    except _InvalidImage as error:
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
        raise _InvalidImage(found, f"a file with all of its {n_bytes:,} bytes")
    if n_bytes > MAX_DECODED_BYTES:
        allowed = f"at most {MAX_DECODED_BYTES:,} bytes"
        raise _InvalidImage(f"{claimed}, {n_bytes:,} bytes", allowed)
    if isinstance(file, io.BytesIO):
        array = np.frombuffer(file.getbuffer(), dtype, n_values, file.tell()).copy()
    else:
        array = np.fromfile(file, dtype, n_values)
    return array.reshape(shape, order="F" if is_fortran else "C")


def _npy_header(file: BinaryIO) -> tuple[np.dtype, tuple[int, ...], bool]:
    """Return the dtype, shape and order of a header, without evaluating it."""
    intact = "a .npy file of bool, integers or floats"
    magic = file.read(8)
    if magic[:6] != NPY_MAGIC or magic[6:7] not in (b"\1", b"\2", b"\3"):
        raise _InvalidImage("cannot be read (not a .npy file)", intact)
    width = 2 if magic[6] == 1 else 4
    n_header = int.from_bytes(file.read(width), "little")
    if n_header > MAX_NPY_HEADER_BYTES:
        found = f"a header of {n_header:,} bytes"
        raise _InvalidImage(found, f"at most {MAX_NPY_HEADER_BYTES:,} bytes")
    header = file.read(n_header)
    text = header.decode("latin-1" if magic[6] < 3 else "utf-8").strip()
    fields: dict[str, tuple[str, ...]] = {}
    at = 1
    while text[:1] == "{" and (match := _NPY_FIELD.match(text, at)):
        fields[match[1]] = match.groups()[1:]
        at = match.end()
    is_whole = len(header) == n_header and text[at:].strip() == "}"
    if not is_whole or set(fields) != {"descr", "fortran_order", "shape"}:
        raise _InvalidImage(
            "cannot be read (another header than a plain array's)", intact
        )
    descr, order, shape = (
        fields[name][k] for k, name in enumerate(("descr", "fortran_order", "shape"))
    )
    if descr is None or order is None or shape is None:
        raise _InvalidImage(
            "cannot be read (another header than a plain array's)", intact
        )
    try:
        dtype = np.dtype(descr)
        sides = tuple(
            int(side.rstrip("L")) for side in shape.split(",") if side.strip()
        )
    except (TypeError, ValueError):
        raise _InvalidImage(
            f"cannot be read ({descr} of shape ({shape:.40}))", intact
        ) from None
    if dtype.kind not in "buif" or len(sides) > 8:
        raise _InvalidImage(f"cannot be read ({dtype} of shape {sides})", intact)
    return dtype, sides, order == "True"


# --- OpenEXR ------------------------------------------------------------------


def read_exr_channels(
    path: Path,
    choose: Callable[[set[str]], tuple[str, ...]],
    *,
    option: str = "",
    content: bytes | None = None,
) -> dict[str, NDArray[Any]]:
    """Return channels of the first part of an OpenEXR file, as float32.

    Parameters
    ----------
    choose : callable
        Returns the channels to read, of those in the file, or raises.
    content : bytes, optional
        Content of the file, which is read if this is not given.

    Raises
    ------
    InvalidFile
    """
    import OpenEXR

    try:
        with _openable(path, content) as name:
            with open(name, "rb") as stream:
                size_bytes = _size_of(stream)
                if stream.read(4) != EXR_MAGIC:  # the library would write to stderr
                    _raise_invalid(path, "not an OpenEXR file", "OpenEXR", option)
            if size_bytes > MAX_FILE_BYTES:
                allowed = f"at most {MAX_FILE_BYTES:,} bytes"
                _raise_invalid(path, f"{size_bytes:,} bytes", allowed, option)
            with _GLOBALS_LOCK, _captured_output() as captured:
                how = {"separate_channels": True}
                with OpenEXR.File(name, header_only=True, **how) as file:
                    _check_exr(file.parts)
                with OpenEXR.File(name, **how) as file:
                    channels = file.channels()
                    wanted = choose(set(channels))
                    found = {
                        k: np.asarray(channels[k].pixels, np.float32) for k in wanted
                    }
        text = "".join(captured)
        if EXR_INCOMPLETE in text:  # the library continues with the intact part
            reason = text[text.index(EXR_INCOMPLETE) :].split("\n")[0].split(" - ")[-1]
            raise _InvalidImage(
                f"cannot be read ({reason:.100})", "an intact OpenEXR file"
            )
        return found
    except InvalidFile:
        raise
    except _InvalidImage as error:
        raise InvalidFile(path, error.found, error.allowed, option) from None
    except Exception as error:  # bindings raise nearly anything on damaged files
        problem = f"cannot be read ({_error_text(error)})"
        raise InvalidFile(path, problem, "an intact OpenEXR file", option) from None


@contextmanager
def _openable(path: Path, content: bytes | None) -> Iterator[str]:
    """Yield a name under which a library can open a file, or content in memory."""
    if content is None:
        yield str(path)
        return
    with os.fdopen(os.memfd_create("content", os.MFD_CLOEXEC), "wb") as file:
        file.write(content)
        file.flush()
        yield f"/proc/self/fd/{file.fileno()}"


def _exr_chunk_rows(header: dict[str, Any]) -> int:
    """Return the largest number of rows decoded at once; for tiles, their height."""
    tiles = header.get("tiles")
    if tiles is not None:
        return max(1, int(tiles.ySize))
    name = str(header.get("compression", "")).rpartition(".")[2]
    return EXR_CHUNK_ROWS.get(name.partition(":")[0].strip("> "), 256)


def _check_exr(parts: list[Any]) -> None:
    """Reject files that would need too much memory, by the headers of all parts."""
    n_bytes = 0
    if not parts:
        raise _InvalidImage("no parts", "a part with pixels")
    for part in parts:
        low, high = part.header["dataWindow"]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        if width < 1 or height < 1:
            raise _InvalidImage(f"{width}x{height} px", "1x1 px or more")
        if width * height > MAX_PIXELS:
            raise _InvalidImage(f"{width}x{height} px", _PIXEL_LIMIT)
        if "deep" in str(part.header.get("type", "")):
            raise _InvalidImage("deep pixels", "one value of each channel for a pixel")
        # 4 bytes per value: half floats become float32
        row_bytes = 4 * width * len(part.header["channels"])
        n_bytes += row_bytes * height
        chunk_bytes = row_bytes * min(height, _exr_chunk_rows(part.header))
        if chunk_bytes > MAX_EXR_CHUNK_BYTES:
            found = f"{chunk_bytes:,} bytes in a chunk"
            raise _InvalidImage(found, f"at most {MAX_EXR_CHUNK_BYTES:,} bytes")
    if n_bytes > MAX_DECODED_BYTES:
        allowed = f"at most {MAX_DECODED_BYTES:,} bytes as float32"
        raise _InvalidImage(f"{n_bytes:,} bytes in all channels", allowed)
