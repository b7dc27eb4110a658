"""Reading and writing of images of many wavelengths.

Formats: ENVI (a text header ``.hdr`` beside raw values), ``.npy``, and ``.mat`` of
MATLAB, versions 5 to 7.  Sizes are compared with the limits before values are read.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import InvalidFile, read_bytes, read_text, reason_of
from filter_service.atomic_files import replace_atomically, replace_with_header
from filter_service.bounded_images import MAX_DECODED_BYTES
from filter_service.image_files import read_npy

BAND_SUFFIXES = (".hdr", ".npy", ".mat")
BAND_OUTPUT_SUFFIXES = (".npy", ".hdr")

MAX_HEADER_BYTES = 1_000_000
"""Headers with the names of several hundred bands take 10 kB."""

ENVI_TYPES = {
    "1": "u1",
    "2": "i2",
    "3": "i4",
    "4": "f4",
    "5": "f8",
    "12": "u2",
    "13": "u4",
}
"""NumPy's types for the numbers of the field ``data type``."""

ENVI_AXES = {
    # interleave: axes of the file; the image is (lines, samples, bands)
    "bsq": ("bands", "lines", "samples"),
    "bil": ("lines", "bands", "samples"),
    "bip": ("lines", "samples", "bands"),
}
DATA_SUFFIXES = ("", ".dat", ".img", ".raw", ".bsq", ".bil", ".bip")

WAVELENGTH_NAMES = ("wavelength", "lambda", "bands", "wl", "nm")
"""Beginnings of names of MATLAB variables that contain wavelengths."""

MAT_HEADER_BYTES, MAT_COMPRESSED = 128, 15
CHUNK_BYTES = 1 << 20

UM_LIMIT = 100.0
"""Smaller wavelengths are in micrometers."""

_FIELD = re.compile(r"^\s*([^={}\n]+?)\s*=\s*(\{[^}]*\}|[^\n]*)", re.MULTILINE)


class BandImage(NamedTuple):
    """An image of many wavelengths.

    ``bands`` is (height, width, n), float32; ``wavelengths_nm`` is (n,), or None if the
    file does not state them.
    """

    bands: NDArray[np.float32]
    wavelengths_nm: NDArray[np.float64] | None


def read_bands(path: Path, *, option: str = "") -> BandImage:
    """Return the image of a file.

    Parameters
    ----------
    path : Path
        A ``.hdr`` file of ENVI, whose values are in a file of the same name without
        that suffix or with one of `DATA_SUFFIXES`; a ``.npy`` file of shape (height,
        width, n); or a ``.mat`` file with one array of that shape, and its wavelengths
        in a variable with one of `WAVELENGTH_NAMES`.
    option : str
        Name of the command-line option, for errors.

    Returns
    -------
    BandImage

    Raises
    ------
    InvalidFile
        If the file is damaged, larger than the limits, or has another content.
    """
    suffix = path.suffix.lower()
    if suffix == ".hdr":
        found = _read_envi(path, option)
    elif suffix == ".npy":
        found = BandImage(_as_bands(path, read_npy(path, option=option), option), None)
    elif suffix == ".mat":
        found = _read_mat(path, option)
    else:
        allowed = "a name that ends in " + ", ".join(BAND_SUFFIXES)
        raise InvalidFile(
            path, f"'{suffix}' is not a kind of band image", allowed, option
        )
    return found


def write_bands(
    path: Path,
    bands: NDArray[np.float32],
    *,
    wavelengths_nm: NDArray[np.float64] | None = None,
) -> None:
    """Write an image (height, width, n) as ``.npy``, or as ENVI with a ``.dat`` file.

    Files appear complete or not at all; see `replace_with_header`.

    Raises
    ------
    OSError
    """
    if path.suffix.lower() == ".npy":
        replace_atomically(path, partial(_save_npy, bands))
        return
    lines, samples, count = bands.shape
    header = [
        "ENVI",
        f"samples = {samples}",
        f"lines = {lines}",
        f"bands = {count}",
        "header offset = 0",
        "data type = 4",
        "interleave = bip",
        "byte order = 0",
    ]
    if wavelengths_nm is not None:
        listed = ", ".join(f"{nm:.9g}" for nm in wavelengths_nm.tolist())
        header += ["wavelength units = Nanometers", f"wavelength = {{{listed}}}"]
    text = "\n".join(header) + "\n"
    replace_with_header(
        path,
        lambda part: part.write_text(text, encoding="utf-8"),
        path.with_suffix(".dat"),
        lambda part: np.ascontiguousarray(bands, "<f4").tofile(part),
    )


def _save_npy(bands: NDArray[np.float32], path: Path) -> None:
    with path.open("wb") as file:  # given a path, NumPy may add a suffix
        np.save(file, bands, allow_pickle=False)


def _read_envi(path: Path, option: str) -> BandImage:
    text = read_text(path, max_bytes=MAX_HEADER_BYTES, option=option)
    if not text.startswith("ENVI"):
        raise InvalidFile(path, "not an ENVI header", "a file of ENVI", option)
    fields = {name.lower(): value.strip() for name, value in _FIELD.findall(text)}

    def count(name: str, default: str | None = None) -> int:
        value = fields.get(name, default)
        if value is None or not re.fullmatch(r"\d{1,9}", value):
            found = f"'{name}' is {value!r:.40}"
            raise InvalidFile(path, found, "a number of up to 9 digits", option)
        return int(value)

    sizes = {name: count(name) for name in ("lines", "samples", "bands")}
    offset = count("header offset", "0")
    interleave = fields.get("interleave", "bsq").lower()
    for name, value, allowed in (
        ("interleave", interleave, ENVI_AXES),
        ("data type", fields.get("data type", ""), ENVI_TYPES),
        ("byte order", fields.get("byte order", "0"), ("0", "1")),
    ):
        if value not in allowed:
            found = f"'{name}' is {value!r:.40}"
            raise InvalidFile(path, found, ", ".join(allowed), option)
    order = "<" if fields.get("byte order", "0") == "0" else ">"
    dtype = np.dtype(order + ENVI_TYPES[fields["data type"]])
    axes = ENVI_AXES[interleave]
    shape = tuple(sizes[axis] for axis in axes)
    n_bytes = math.prod(shape) * dtype.itemsize
    _check_size(path, math.prod(shape), dtype, option)
    data_path = _data_path(path, option)
    content = read_bytes(data_path, max_bytes=MAX_DECODED_BYTES + offset, option=option)
    if len(content) < offset + n_bytes:
        found = f"{len(content):,} bytes"
        raise InvalidFile(data_path, found, f"{offset + n_bytes:,} bytes", option)
    values = np.frombuffer(content, dtype, math.prod(shape), offset).reshape(shape)
    order_of_axes = [axes.index(axis) for axis in ("lines", "samples", "bands")]
    bands = _as_bands(path, values.transpose(order_of_axes), option)
    wavelengths_nm = None
    if "wavelength" in fields:
        wavelengths_nm = _numbers(path, fields["wavelength"], option)
        if wavelengths_nm.size != sizes["bands"]:
            found = f"{wavelengths_nm.size} wavelengths"
            raise InvalidFile(path, found, f"{sizes['bands']}, as bands", option)
    return BandImage(bands, _as_nm(wavelengths_nm))


def _data_path(path: Path, option: str) -> Path:
    """Return the file of values of an ENVI header."""
    for suffix in DATA_SUFFIXES:
        if (found := path.with_suffix(suffix)).is_file():
            return found
    allowed = f"{path.with_suffix('.dat').name} beside it"
    raise InvalidFile(path, "its file of values is missing", allowed, option)


def _numbers(path: Path, text: str, option: str) -> NDArray[np.float64]:
    try:
        return np.array([float(part) for part in text.strip("{} \n").split(",")])
    except ValueError:
        raise InvalidFile(
            path, f"'wavelength' is {text!r:.40}", "numbers", option
        ) from None


def _as_nm(wavelengths: NDArray[Any] | None) -> NDArray[np.float64] | None:
    """Return wavelengths in nm, of which some files state micrometers."""
    if wavelengths is None or not wavelengths.size:
        return None
    found = np.asarray(wavelengths, dtype=np.float64).ravel()
    return found * 1e3 if found.max() < UM_LIMIT else found


def _read_mat(path: Path, option: str) -> BandImage:
    from scipy import io  # loads slowly

    allowed = "a .mat file of version 5 to 7 with one array (height, width, n)"
    content_bytes = read_bytes(path, max_bytes=MAX_DECODED_BYTES, option=option)
    try:
        n_bytes = _expanded_bytes(content_bytes)
        del content_bytes
        if n_bytes > MAX_DECODED_BYTES:
            limit = f"at most {MAX_DECODED_BYTES:,}"
            raise InvalidFile(path, f"more than {n_bytes:,} bytes", limit, option)
        listed = io.whosmat(path)
        images = [
            (name, shape)
            for name, shape, _ in listed
            if len(shape) == 3 and not name.startswith("__")
        ]
        if len(images) != 1:
            found = f"{len(images)} arrays of three axes"
            raise InvalidFile(path, found, allowed, option)
        ((name, shape),) = images
        _check_size(path, math.prod(shape), np.dtype(np.float64), option)
        others = [
            other
            for other, size, _ in listed
            if other.lower().startswith(WAVELENGTH_NAMES)
            and math.prod(size) == shape[2]
        ]
        content = io.loadmat(path, variable_names=[name, *others[:1]])
    except InvalidFile:
        raise
    except Exception as error:  # of a damaged file, the reader raises many types
        found = f"cannot be read ({reason_of(error)})"
        raise InvalidFile(path, found, allowed, option) from None
    wavelengths = content[others[0]] if others else None
    return BandImage(_as_bands(path, content[name], option), _as_nm(wavelengths))


def _expanded_bytes(content: bytes) -> int:
    """Return the size of the elements of a .mat file once they are decompressed.

    Counting stops beyond the limit.
    """
    order = "<" if content[126:128] == b"IM" else ">"
    total, at = 0, MAT_HEADER_BYTES
    while at + 8 <= len(content) and total <= MAX_DECODED_BYTES:
        kind, size = struct.unpack_from(order + "II", content, at)
        at += 8
        part = content[at : at + size]
        at += size
        if kind != MAT_COMPRESSED:
            total += size
            continue
        expander = zlib.decompressobj()
        while part and total <= MAX_DECODED_BYTES:
            total += len(expander.decompress(part, CHUNK_BYTES))
            part = expander.unconsumed_tail
    return total


def _check_size(path: Path, n_values: int, dtype: np.dtype[Any], option: str) -> None:
    n_bytes = n_values * max(dtype.itemsize, 4)
    if n_bytes > MAX_DECODED_BYTES:
        allowed = f"at most {MAX_DECODED_BYTES:,}"
        raise InvalidFile(path, f"{n_bytes:,} bytes of values", allowed, option)


def _as_bands(path: Path, values: Any, option: str) -> NDArray[np.float32]:
    """Return values (height, width, n) as float32."""
    array = np.asarray(values)
    if array.ndim != 3 or array.dtype.kind not in "uif" or 0 in array.shape:
        raise InvalidFile(
            path,
            f"{array.dtype} of shape {array.shape}",
            "numbers of shape (height, width, n)",
            option,
        )
    _check_size(path, array.size, array.dtype, option)
    return np.ascontiguousarray(array, np.float32)
