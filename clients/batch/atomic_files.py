"""Atomic writes of files below a folder, and file hashes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from filter_service.atomic_files import PART_NAME, replace_atomically

_BLOCK_BYTES = 1 << 20


def write_whole(path: Path, write: Callable[[Path], object]) -> dict[str, Any]:
    """Write a file atomically, and its folder if that is missing.

    A killed process leaves at most one temporary file, which `remove_parts` removes.

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
    content: dict[str, Any] = {}

    def write_and_hash(part: Path) -> None:
        write(part)
        content.update(content_of(part))

    replace_atomically(path, write_and_hash)
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
    parts = [
        path
        for path in folder.rglob(".ocufilter-*")
        if PART_NAME.fullmatch(path.name) and path.is_file() and not path.is_symlink()
    ]
    for path in parts:
        path.unlink(missing_ok=True)
    return len(parts)


def below(folder: Path, name: object) -> Path | None:
    """Return the path of a file below a folder; None if the name leads outside.

    Links in the folder are followed: a folder that is a link leads outside.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        return None
    inner = Path(name)
    if inner.is_absolute() or ".." in inner.parts:
        return None
    path = folder / inner
    is_inside = path.parent.resolve().is_relative_to(folder.resolve())
    return path if is_inside else None
