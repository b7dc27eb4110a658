"""Header and buffers of a glTF file, within limits.

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

from estimator.bounded_files import InvalidFile, loads_bounded, read_bytes

MAX_FILE_MB = 256.0
"""Total size of a file and the files that it references, which are all in memory during
reading."""

MAX_HEADER_BYTES = 64_000_000
"""Size of the JSON, which may contain the buffers as text; parsing takes four times as
much memory."""

MAX_HEADER_ITEMS = 1_000_000
"""Number of values in the JSON, which take a second to parse: enough for 50,000 nodes,
meshes and accessors."""

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
        JSON of the file, of which nothing is checked but that it is an object.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._left = int(MAX_FILE_MB * 1e6)
        content = self._read(path)
        text, self._binary = _split(path, content)
        self.header = _parsed(path, text)
        self._buffers: dict[object, memoryview] = {}
        self._lists: dict[str, list[dict[str, Any]]] = {}

    def list_of(self, name: str) -> list[dict[str, Any]]:
        """Return a list of objects of the header; empty if absent."""
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
        """Return an entry of a list of the header."""
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
            is_inside = "uri" not in buffer
            content = self._binary if is_inside else self.uri_bytes(buffer["uri"])
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
