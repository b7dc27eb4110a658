"""Atomic writes of files, and file hashes."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

PART = ".part"
MAX_STEM = 180
"""Length limit of a stem, so that the temporary name is valid in a file system."""

_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_BLOCK_BYTES = 1 << 20


def write_whole(path: Path, write: Callable[[Path], None]) -> dict[str, Any]:
    """Write a file under a temporary name in the same folder, then rename it.

    A killed process leaves at most a file ``.NAME.RANDOM.part.SUFFIX``, which
    `remove_parts` removes.

    Parameters
    ----------
    path : Path
        File to write.
    write : callable
        Function that writes the content to a path.

    Returns
    -------
    dict
        Size in ``bytes`` and ``sha256`` of the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    random = secrets.token_hex(8)
    part = path.with_name(f".{path.stem[:MAX_STEM]}.{random}{PART}{path.suffix}")
    os.close(os.open(part, _NEW_FILE, 0o666))  # does not follow a link
    try:
        write(part)
        with part.open("rb") as file:
            os.fsync(
                file.fileno()
            )  # the content precedes the rename, even in a power failure
        content = content_of(part)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return content


def content_of(path: Path) -> dict[str, Any]:
    """Return the size of a file in bytes and its SHA-256."""
    digest, size_bytes = hashlib.sha256(), 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
            size_bytes += len(block)
    return {"bytes": size_bytes, "sha256": digest.hexdigest()}


def remove_parts(folder: Path) -> int:
    """Remove temporary files of killed processes; return their number."""
    parts = [path for path in folder.rglob(".*") if PART in path.suffixes]
    for path in parts:
        path.unlink(missing_ok=True)
    return len(parts)


def input_of(path: Path) -> dict[str, Any]:
    """Return the name, size, time and hash of an input file."""
    status = path.stat()
    return {
        "name": path.name,
        "mtime_ns": status.st_mtime_ns,
        **content_of(path),
    }


def is_unchanged(path: Path, recorded: dict[str, Any]) -> bool:
    """Return whether a file matches its record; read it only if its time differs."""
    try:
        status = path.stat()
    except OSError:
        return False
    if status.st_size != recorded["bytes"]:
        return False
    if status.st_mtime_ns == recorded["mtime_ns"]:
        return True
    return content_of(path)["sha256"] == recorded["sha256"]
