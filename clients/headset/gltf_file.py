"""Reader for the header, buffers and arrays of a glTF file, with size limits.

A file may reference other files. These must be in its folder or below, even after
symbolic links are resolved, and count toward the same limit.
"""

from __future__ import annotations

import base64
import binascii
import struct
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import InvalidFile, loads_bounded, read_bytes

MAX_FILE_MB = 256.0
"""Total size of a file and the files that it references, which are all in memory during
reading."""

MAX_HEADER_BYTES = 64_000_000
"""Size of the JSON, which may contain the buffers as text; parsing takes four times as
much memory."""

MAX_HEADER_ITEMS = 1_000_000
"""Number of values in the JSON: enough for 50,000 nodes, meshes and accessors, which
take a second to parse."""

MAX_HEADER_DEPTH = 64
"""Nesting depth of the JSON, whose extras may contain anything."""

MAGIC = b"glTF"
_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")


class Container:
    """A glTF file in memory.

    Attributes
    ----------
    path : Path
        Path of the file.
    header : dict
        JSON object of the file.  Its content is not validated.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._left = int(MAX_FILE_MB * 1e6)
        self.header, self._binary = read_header(path, self._read(path))
        self._buffers: dict[object, memoryview] = {}
        self._lists: dict[str, list[dict[str, Any]]] = {}

    def list_of(self, name: str) -> list[dict[str, Any]]:
        """Return a list of objects in the header; empty if absent."""
        if name not in self._lists:
            found = self.header.get(name, [])
            if not isinstance(found, list):
                self.refuse(f"damaged: '{name}' is not a list", "a list of objects")
            if not all(isinstance(entry, dict) for entry in found):
                self.refuse(
                    f"damaged: '{name}' has entries that are not objects", "objects"
                )
            self._lists[name] = found
        return self._lists[name]

    def entry(self, name: str, index: object) -> dict[str, Any]:
        """Return an entry of a list in the header."""
        entries = self.list_of(name)
        if type(index) is not int or not 0 <= index < len(entries):
            self.refuse(f"'{name}' {index!r:.20}", f"0 to {len(entries) - 1}")
        return entries[index]

    def view(self, index: object) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.entry("bufferViews", index)
        where = f"bufferViews[{index}]"
        start = self.whole(view, "byteOffset", where, default=0)
        length = self.whole(view, "byteLength", where)
        buffer = self._buffer(view.get("buffer"))
        if start + length > len(buffer):
            found = f"damaged: {where} ends at byte {start + length:,}"
            self.refuse(found, f"the {len(buffer):,} bytes of its buffer")
        return buffer[start : start + length]

    def whole(
        self, entry: dict[str, Any], field: str, where: str, *, default: int = -1
    ) -> int:
        """Return a field that must be an integer of at least 0."""
        value = entry.get(field, default)
        if type(value) is not int or not 0 <= value < 1 << 40:
            self.refuse(f"damaged: {where}.{field} is {value!r:.30}", "0 or more")
        return value

    @staticmethod
    def are_numbers(given: object, count: int) -> bool:
        """Return whether a value of the header is a list of ``count`` numbers."""
        return (
            isinstance(given, list)
            and len(given) == count
            and all(type(value) in (int, float) for value in given)
        )

    def uri_bytes(self, uri: object) -> bytes:
        """Return the content of a data URI, or of the referenced file."""
        if not isinstance(uri, str):
            self.refuse(f"damaged: a URI is {uri!r:.30}", "text")
        if uri.startswith("data:"):
            head, comma, data = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                self.refuse(f"the URI '{uri:.30}'", "data:...;base64,...")
            try:
                return base64.b64decode(data)
            except (binascii.Error, ValueError):
                self.refuse("damaged: a URI is not base64", "base64")
        return self._read(self._beside(uri))

    def refuse(self, found: str, allowed: str = "") -> NoReturn:
        """Raise `InvalidFile` for this file."""
        raise InvalidFile(self.path, found, allowed) from None

    def _buffer(self, index: object) -> memoryview:
        buffer = self.entry("buffers", index)
        if index not in self._buffers:
            content = self.uri_bytes(buffer["uri"]) if "uri" in buffer else self._binary
            self._buffers[index] = memoryview(content)
        return self._buffers[index]

    def _beside(self, uri: str) -> Path:
        allowed = "a file in its folder or below"
        name = unquote(uri)
        if not name or name.startswith("/") or ":" in name or "\\" in name:
            self.refuse(f"the URI '{uri:.60}'", allowed)
        folder = self.path.absolute().parent
        try:
            found = (folder / name).resolve()
            is_below = found.is_relative_to(folder.resolve())
        except (OSError, ValueError, RuntimeError):  # a null byte, a symlink loop
            is_below = False
        if not is_below:
            self.refuse(f"the URI '{uri:.60}' leads out of its folder", allowed)
        return found

    def _read(self, path: Path) -> bytes:
        try:
            content = read_bytes(path, max_bytes=self._left)
        except InvalidFile as error:
            if path == self.path:
                if not error.allowed.startswith("at most"):
                    raise
                self.refuse(error.found, f"at most {MAX_FILE_MB:g} MB")
            self.refuse(f"it references '{path.name}': {error.found}")
        self._left -= len(content)
        return content


def read_header(path: Path, content: bytes) -> tuple[dict[str, Any], memoryview]:
    """Return the JSON of a file, and its binary chunk.

    Raises
    ------
    InvalidFile
        If the content is not a glTF 2 file, or exceeds a limit.
    """
    text, binary = _split(path, content)
    return _parsed(path, text), binary


def _split(path: Path, content: bytes) -> tuple[bytes, memoryview]:
    """Return the JSON and the binary chunk of a file."""
    whole = memoryview(content)
    if not content.startswith(MAGIC):
        return content, whole[:0]
    chunks: dict[bytes, memoryview] = {}
    at = _HEADER.size
    while at + _CHUNK.size <= len(content) and len(chunks) < 2:
        length, name = _CHUNK.unpack_from(content, at)
        at += _CHUNK.size
        if at + length > len(content):
            part = "not a glTF file" if not chunks else "damaged"
            found = f"{part}: a chunk ends at byte {at + length:,}"
            raise InvalidFile(path, found, f"{len(content):,} bytes")
        if not chunks and name != _JSON_CHUNK:
            break
        chunks.setdefault(name, whole[at : at + length])
        at += length
    if _JSON_CHUNK not in chunks:
        raise InvalidFile(path, "not a glTF file: it has no header", "glTF 2")
    return bytes(chunks[_JSON_CHUNK]), chunks.get(_BINARY_CHUNK, whole[:0])


def _parsed(path: Path, text: bytes) -> dict[str, Any]:
    try:
        header = loads_bounded(
            text,
            max_bytes=MAX_HEADER_BYTES,
            max_depth=MAX_HEADER_DEPTH,
            max_items=MAX_HEADER_ITEMS,
            finite=True,
        )
    except ValueError as error:
        raise InvalidFile(path, f"not a glTF file ({error})", "glTF 2") from None
    asset = header.get("asset") if isinstance(header, dict) else None
    version = asset.get("version") if isinstance(asset, dict) else None
    if not isinstance(version, str | int | float):
        raise InvalidFile(path, "not a glTF file: it has no version", "glTF 2")
    if not str(version).startswith("2."):
        raise InvalidFile(path, f"glTF {version!s:.20}", "glTF 2")
    return header


# Arrays of accessors

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def accessor_count(file: Container, index: object) -> int:
    """Return the number of elements of an accessor."""
    accessor = file.entry("accessors", index)
    return file.whole(accessor, "count", f"accessors[{index}]")


def accessor_array(file: Container, index: object, *, kinds: str) -> NDArray[Any]:
    """Return the elements (n, columns) of an accessor, as stored.

    Parameters
    ----------
    kinds : str
        Allowed kinds of numbers, any of ``u``, ``i`` and ``f``.
    """
    accessor = file.entry("accessors", index)
    where = f"accessors[{index}]"
    count = accessor_count(file, index)
    dtype, columns = _dtype(file, accessor, where)
    if dtype.kind not in kinds:
        file.refuse(f"damaged: {where} has elements of {dtype}")
    if "bufferView" in accessor:
        start = file.whole(accessor, "byteOffset", where, default=0)
        stride = file.entry("bufferViews", accessor["bufferView"]).get("byteStride")
        data = file.view(accessor["bufferView"])
        array = _strided(file, data, where, start, stride, (count, columns), dtype)
    else:
        array = np.zeros((count, columns), dtype)
    if "sparse" in accessor:
        array = _with_sparse(file, accessor["sparse"], where, array)
    return array


def _dtype(
    file: Container, accessor: dict[str, Any], where: str
) -> tuple[np.dtype, int]:
    kind, shape = accessor.get("componentType"), accessor.get("type")
    if type(kind) is not int or kind not in _TYPES:
        file.refuse(f"damaged: {where}.componentType is {kind!r:.20}")
    if not isinstance(shape, str) or shape not in _COLUMNS:
        file.refuse(f"damaged: {where}.type is {shape!r:.20}")
    return np.dtype(_TYPES[kind]), _COLUMNS[shape]


def _strided(
    file: Container,
    data: memoryview,
    where: str,
    start: int,
    stride: object,
    shape: tuple[int, int],
    dtype: np.dtype,
) -> NDArray[Any]:
    """Return the elements of a buffer view without copying them."""
    count, columns = shape
    element = columns * dtype.itemsize
    step = element if stride is None else stride
    if type(step) is not int or not element <= step <= 1 << 16:
        file.refuse(f"damaged: {where} has elements {step!r:.20} bytes apart")
    n_bytes = (count - 1) * step + element if count else 0
    if start + n_bytes > len(data):
        found = f"damaged: {where} ends at byte {start + n_bytes:,} of its view"
        file.refuse(found, f"{len(data):,}")
    if not count:
        return np.zeros(shape, dtype)
    return np.ndarray(shape, dtype, data, start, (step, dtype.itemsize))


def _with_sparse(
    file: Container, sparse: object, where: str, array: NDArray[Any]
) -> NDArray[Any]:
    """Return the array with some elements replaced."""
    if not isinstance(sparse, dict):
        file.refuse(f"damaged: {where}.sparse")
    where = f"{where}.sparse"
    count = file.whole(sparse, "count", where)
    parts = []
    for name, columns in (("indices", 1), ("values", array.shape[1])):
        part = sparse.get(name)
        if not isinstance(part, dict) or count > len(array):
            file.refuse(f"damaged: {where}.{name}")
        dtype = array.dtype
        if name == "indices":
            dtype, _ = _dtype(file, part | {"type": "SCALAR"}, f"{where}.indices")
        start = file.whole(part, "byteOffset", where, default=0)
        data = file.view(part.get("bufferView"))
        parts.append(_strided(file, data, where, start, None, (count, columns), dtype))
    indices, values = parts
    if indices.dtype.kind != "u" or (count and int(indices.max()) >= len(array)):
        file.refuse(f"damaged: {where} has indices beyond {len(array):,}")
    array = array.copy()
    array[indices[:, 0].astype(np.int64)] = values
    return array
