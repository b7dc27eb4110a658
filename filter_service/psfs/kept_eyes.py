"""Whose PSFs are kept on disk, to be listed and erased."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path

from filter_service.psfs.store_cache import BETWEEN, SUFFIX


@dataclass(frozen=True)
class KeptEye:
    """What is kept of one eye.

    Attributes
    ----------
    name : str
        A hash of its profile.
    n_files, size_bytes : int
        One file for each camera and setting that it was prepared for.
    used_s : float
        When the last of them was used, in seconds since 1970.
    """

    name: str
    n_files: int
    size_bytes: int
    used_s: float


def kept_eyes(folder: Path) -> list[KeptEye]:
    """Return the eyes that are kept in a folder, the one used last first.

    Raises
    ------
    FileNotFoundError
    """
    found: dict[str, KeptEye] = {}
    for path in _stores(folder):
        status = path.lstat()
        name = path.name.split(BETWEEN)[0]
        before = found.get(name, KeptEye(name, 0, 0, 0.0))
        found[name] = KeptEye(
            name,
            before.n_files + 1,
            before.size_bytes + status.st_size,
            max(before.used_s, status.st_mtime),
        )
    return sorted(found.values(), key=lambda eye: -eye.used_s)


def erase_eyes(folder: Path, name: str = "") -> int:
    """Remove what is kept of the eyes whose names begin so; return how many files.

    A service that has such an eye in use goes on with it until its client leaves.
    """
    removed = [path for path in _stores(folder) if path.name.startswith(name)]
    for path in removed:
        path.unlink(missing_ok=True)
    return len(removed)


def _stores(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder")
    return [path for path in folder.iterdir() if _is_store(path)]


def _is_store(path: Path) -> bool:
    """Tell our files from folders and links under such names."""
    try:
        return path.suffix == SUFFIX and stat.S_ISREG(path.lstat().st_mode)
    except FileNotFoundError:  # a service has removed it
        return False
