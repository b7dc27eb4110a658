"""Listing and erasing of the eyes in the on-disk cache."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path

from filter_service.psfs.store_cache import SEPARATOR, SUFFIX


@dataclass(frozen=True)
class CachedEye:
    """Files of one eye in the on-disk cache.

    Attributes
    ----------
    name : str
        Hash of the eye's profile.
    n_files, size_bytes : int
        Number and total size of the files, one for each camera and settings.
    used_s : float
        Time of the last use, in seconds since 1970.
    """

    name: str
    n_files: int
    size_bytes: int
    used_s: float


def cached_eyes(folder: Path) -> list[CachedEye]:
    """Return the eyes cached in a folder, most recently used first.

    Raises
    ------
    FileNotFoundError
    """
    found: dict[str, CachedEye] = {}
    for path in _stores(folder):
        status = path.lstat()
        name = path.name.split(SEPARATOR)[0]
        before = found.get(name, CachedEye(name, 0, 0, 0.0))
        found[name] = CachedEye(
            name,
            before.n_files + 1,
            before.size_bytes + status.st_size,
            max(before.used_s, status.st_mtime),
        )
    return sorted(found.values(), key=lambda eye: -eye.used_s)


def erase_eyes(folder: Path, name: str = "") -> int:
    """Remove cached eyes whose names start with ``name``; return the number of files.

    A service that uses such an eye continues to do so until its client disconnects.
    """
    removed = [path for path in _stores(folder) if path.name.startswith(name)]
    for path in removed:
        path.unlink(missing_ok=True)
    return len(removed)


def _stores(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is not a folder")
    return [path for path in folder.iterdir() if _is_store(path)]


def _is_store(path: Path) -> bool:
    """Return whether a path is a regular file with the suffix of a store."""
    try:
        return path.suffix == SUFFIX and stat.S_ISREG(path.lstat().st_mode)
    except FileNotFoundError:  # a service removed it
        return False
