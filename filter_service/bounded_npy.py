"""Reader of ``.npy`` files within limits.

NumPy's own reader evaluates the text of the header.
"""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import InvalidFile, reason_of
from filter_service.bounded_images import (
    MAX_DECODED_BYTES,
    InvalidImage,
    size_of,
    values_of,
)

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
    memory is allocated.  ``content`` is that of the file, if it has been read.

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
