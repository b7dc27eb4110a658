"""File format for an object and its arrays, written atomically and verified on reading.

A file consists of a preamble with sizes and checksums, a JSON header, and the arrays
from a page boundary on.  No part of a file can execute code.

It supports the content of a PSF store: classes of this project whose state consists of
numbers, strings, arrays, lists, dicts and other such classes.  Cached properties are
omitted.  A damaged file can at worst contain wrong numbers, whereas a pickle can
execute code.
"""

from __future__ import annotations

import importlib
import json
import math
import mmap
import os
import stat
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.note import Note, note_of

PACKAGES = ("estimator.", "filter_service.")
"""Packages whose classes may be written and instantiated."""

_PLAIN = (bool, int, float, str, type(None))


class NotStorable(TypeError):
    """An object contains a value that cannot be written."""


def pack(value: object) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Return the JSON tree of an object and its arrays by name.

    Raises
    ------
    NotStorable
        If a value cannot be written; the message contains its path in the object.
    """
    arrays: dict[str, NDArray[Any]] = {}
    return _packed(value, "", arrays, {}), arrays


def unpack(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Return the object of a tree, with the given arrays and not copies of them.

    Raises
    ------
    ValueError, KeyError, TypeError, AttributeError, ImportError
        If the tree was not written by this version of `pack`.
    """
    if isinstance(tree, _PLAIN):
        return tree
    if isinstance(tree, list):
        return [unpack(item, arrays) for item in tree]
    ((kind, content),) = tree.items()
    if kind == "array":
        return arrays[content]
    if kind == "tuple":
        return tuple(unpack(item, arrays) for item in content)
    if kind == "map":
        return {key: unpack(item, arrays) for key, item in content}
    if kind == "note":
        return note_of(*content)
    name, state = content
    if kind != "object":
        raise ValueError(
            f"unknown kind {kind!r}; expected array, tuple, map, note or object"
        )
    made: Any = object.__new__(_class_of(name))
    for field, item in state.items():
        object.__setattr__(made, field, unpack(item, arrays))
    return made


def _packed(
    value: object, path: str, arrays: dict[str, NDArray[Any]], known: dict[int, str]
) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": _array_name(value, path, arrays, known)}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Note):
        return {"note": [value.code, str(value), value.values]}
    if isinstance(value, _PLAIN):
        return value
    # Named tuples would come back as plain ones.
    if isinstance(value, list | tuple) and type(value) in (list, tuple):
        items = [
            _packed(item, f"{path}.{i}", arrays, known) for i, item in enumerate(value)
        ]
        return items if type(value) is list else {"tuple": items}
    if type(value) is dict:
        return {
            "map": [
                [key, _packed(item, f"{path}.{key}", arrays, known)]
                for key, item in value.items()
                if _is_key(key, path)
            ]
        }
    name = f"{type(value).__module__}:{type(value).__qualname__}"
    if not name.startswith(PACKAGES) or not hasattr(value, "__dict__"):
        raise NotStorable(
            f"{path or 'the value'} is a {type(value).__name__}, which is not supported"
        )
    state = {
        field: _packed(item, f"{path}.{field}", arrays, known)
        for field, item in vars(value).items()
        if not isinstance(getattr(type(value), field, None), cached_property)
    }
    return {"object": [name, state]}


def _is_key(key: object, path: str) -> bool:
    if not isinstance(key, str | int):
        raise NotStorable(
            f"{path} has the key {key!r}; expected a string or an integer"
        )
    return True


def _array_name(
    array: NDArray[Any],
    path: str,
    arrays: dict[str, NDArray[Any]],
    known: dict[int, str],
) -> str:
    """Return the name of an array; repeated arrays are stored once."""
    if array.dtype.hasobject:
        raise NotStorable(f"{path} is an array of objects, which is not supported")
    if id(array) not in known:
        known[id(array)] = path.removeprefix(".") or "value"
        arrays[known[id(array)]] = array
    return known[id(array)]


def _class_of(name: str) -> type:
    if not name.startswith(PACKAGES):
        raise ValueError(f"{name!r} is not a class of this project")
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not isinstance(found, type) or found.__module__ != module:
        raise ValueError(f"{name!r} is not a class of this project")
    return found


MAGIC = b"OCUPSFS1"
PREAMBLE = struct.Struct("<8sQQQII")
"""Magic, size of the header, start and size of the arrays, and checksums of both."""

UNFINISHED = ".unfinished"
PAGE_BYTES = 4096
ALIGNMENT_BYTES = 64
BLOCK_BYTES = 2**24
"""Bytes read or written between checks for cancellation: 5 to 20 ms."""

_MALFORMED = (
    *(ValueError, LookupError, TypeError, AttributeError, ImportError),
    *(OverflowError, RecursionError, MemoryError),
)
"""Errors that a header of another version may cause."""

CheckCancelled = Callable[[], None]
"""Function that is called repeatedly and raises to cancel."""


class DamagedFile(ValueError):
    """The content of a file differs from the written content."""


def write_file(
    path: Path, value: object, *, check_cancelled: CheckCancelled = lambda: None
) -> int:
    """Write an object to a file atomically, and return the size of the file.

    Parameters
    ----------
    check_cancelled : callable, optional

    Raises
    ------
    NotStorable, OSError
    """
    tree, arrays = pack(value)
    layout, n_bytes = _layout(arrays)
    header = json.dumps({"arrays": layout, "tree": tree}).encode()
    start = _round_up(PREAMBLE.size + len(header), PAGE_BYTES)
    descriptor, name = tempfile.mkstemp(
        prefix=path.stem[:16] + ".", suffix=UNFINISHED, dir=path.parent
    )
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.seek(start)
            checksum = 0
            for block in _blocks(arrays):
                file.write(block)
                checksum = zlib.crc32(block, checksum)
                check_cancelled()
            file.seek(0)
            file.write(
                PREAMBLE.pack(
                    MAGIC, len(header), start, n_bytes, zlib.crc32(header), checksum
                )
            )
            file.write(header)
            file.truncate(start + n_bytes)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)
    return start + n_bytes


def read_file(path: Path, *, check_cancelled: CheckCancelled = lambda: None) -> Any:
    """Return the object of a file.

    Raises
    ------
    DamagedFile
        If the file is truncated, modified or of another format.
    OSError
        If the file cannot be read or does not exist.
    """
    with open(path, "rb", buffering=0, opener=_open_plain_file) as file:
        header, start, n_bytes, data_sum = _header(file)
        file.seek(start)
        data, checksum = np.empty(n_bytes, np.uint8), 0
        for first in range(0, n_bytes, BLOCK_BYTES):
            block = data[first : first + BLOCK_BYTES].data
            if file.readinto(block) != len(block):
                raise DamagedFile("the file was truncated during reading")
            checksum = zlib.crc32(block, checksum)
            check_cancelled()
    if checksum != data_sum:
        raise DamagedFile("the checksum of the arrays is wrong")
    return _object(header, data)


def map_file(path: Path, *, verify: bool = True) -> Any:
    """Return the object of a file, with read-only arrays that are mapped, not read.

    Processes that map the same file share its memory.  A file that is replaced does not
    affect the maps of the old one.

    Parameters
    ----------
    verify : bool
        Whether to compare the checksum of the arrays, which reads all of them.

    Raises
    ------
    DamagedFile, OSError
        As `read_file`.
    """
    with open(path, "rb", buffering=0, opener=_open_plain_file) as file:
        header, start, n_bytes, data_sum = _header(file)
        data: NDArray[np.uint8] = np.zeros(0, np.uint8)
        if n_bytes:
            mapped = mmap.mmap(file.fileno(), start + n_bytes, access=mmap.ACCESS_READ)
            data = np.frombuffer(mapped, np.uint8, n_bytes, start)
    if verify and zlib.crc32(data.data) != data_sum:
        raise DamagedFile("the checksum of the arrays is wrong")
    return _object(header, data)


def _header(file: FileIO) -> tuple[bytes, int, int, int]:
    """Return the header, the start and size of the arrays, and their checksum."""
    preamble = file.read(PREAMBLE.size)
    if len(preamble) < PREAMBLE.size:
        raise DamagedFile("the preamble is truncated")
    magic, n_header, start, n_bytes, header_sum, data_sum = PREAMBLE.unpack(preamble)
    n_there = os.fstat(file.fileno()).st_size
    if magic != MAGIC or not PREAMBLE.size + n_header <= start <= n_there:
        raise DamagedFile("the preamble is invalid")
    if n_there != start + n_bytes:
        raise DamagedFile(f"the file has {n_there} bytes, expected {start + n_bytes}")
    header = file.read(n_header)
    if zlib.crc32(header) != header_sum:
        raise DamagedFile("the checksum of the header is wrong")
    return header, start, n_bytes, data_sum


def _object(header: bytes, data: NDArray[np.uint8]) -> Any:
    """Return the object of a header and its arrays."""
    try:
        content = json.loads(header)
        arrays = {key: _array(data, p) for key, p in content["arrays"].items()}
        return unpack(content["tree"], arrays)
    except _MALFORMED as error:
        raise DamagedFile(
            f"the header is of another version: {error!r:.200}"
        ) from error


def _open_plain_file(path: str, flags: int) -> int:
    """Open a regular file; refuse others, such as a FIFO, which would block."""
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_NOFOLLOW)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise DamagedFile("not a regular file")
    return descriptor


def _round_up(size: int, step: int) -> int:
    return -(-size // step) * step


def _layout(arrays: dict[str, NDArray[Any]]) -> tuple[dict[str, list[Any]], int]:
    """Return [dtype, shape, start] of each array, and their total size."""
    layout, end = {}, 0
    for key, array in arrays.items():
        layout[key] = [array.dtype.str, array.shape, end]
        end += _round_up(array.nbytes, ALIGNMENT_BYTES)
    return layout, end


def _blocks(arrays: dict[str, NDArray[Any]]) -> Iterator[bytes | memoryview]:
    for array in arrays.values():
        if array.nbytes:
            plain = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
            for first in range(0, len(plain), BLOCK_BYTES):
                yield plain[first : first + BLOCK_BYTES]
        yield bytes(_round_up(array.nbytes, ALIGNMENT_BYTES) - array.nbytes)


def _array(data: NDArray[np.uint8], place: list[Any]) -> NDArray[Any]:
    name, shape, start = place
    dtype = np.dtype(name)
    n_bytes = math.prod(shape) * dtype.itemsize
    return data[start : start + n_bytes].view(dtype).reshape(shape)


def _sync_folder(folder: Path) -> None:
    """Flush the folder, so that the new name survives a crash of the machine."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
