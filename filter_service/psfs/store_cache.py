"""On-disk cache of estimated eyes and their nodes: its folder, contents and limits.

The cache is a folder of files.  A file's name consists of a hash of the profile and one
of the grid and the code.  Several services may share the folder without a lock: files
are written atomically (see `store_file`), and a process can finish reading a file that
another one removes.  Beyond a size limit, the service removes the least recently used
files.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import stat
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import estimator
import filter_service
from estimator import native as core
from estimator.native import in_use
from estimator.profiles.parse import EyeProfile
from filter_service import native as loops
from filter_service.gl.passes import SHADER_ROOT
from filter_service.planning.grid import GridSpec
from filter_service.psfs.store_file import (
    UNFINISHED,
    DamagedFile,
    NotStorable,
    pack,
    read_file,
    write_file,
)


def check_is_private(folder: Path) -> None:
    """Raise if other users have access to a folder.

    Raises
    ------
    PermissionError
    """
    if folder.stat().st_mode & 0o077:
        raise PermissionError(
            f"other users can access {folder}, which contains medical data; run "
            f"chmod 700 {folder}"
        )


SUFFIX = ".psfs"
SEPARATOR = "-"
KEY_BYTES = 16
ABANDONED_S = 3600.0
"""Age from which an unfinished file is considered abandoned by its writer."""

MB = 1e6

_WRITING = threading.Lock()

log = logging.getLogger("ocufilter.cache")

LIBRARIES = (core.PATH, loops.PATH)


@dataclass(frozen=True)
class Stored:
    """Cached data of an eye.

    Attributes
    ----------
    parts : dict
        See `PsfStore.parts`.
    notes : tuple of str
    """

    parts: dict[str, Any]
    notes: tuple[str, ...]


@cache
def code_version() -> str:
    """Return a hash of the files that determine the content of a store.

    They are both packages, the PSF shaders and the compiled libraries in use.  Omitting
    a relevant file would produce wrong images, whereas including an irrelevant one only
    costs a build.
    """
    service_folder = Path(filter_service.__file__).parent
    estimator_folder = Path(estimator.__file__).parent
    files = [
        *(
            path
            for path in estimator_folder.rglob("*")
            if path.suffix in (".py", ".json", ".onnx")
        ),
        *service_folder.rglob("*.py"),
        *SHADER_ROOT.rglob("psf*"),
        *(path for path in map(in_use, LIBRARIES) if path.exists()),
    ]
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(files):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def store_key(profile: EyeProfile, spec: GridSpec) -> str:
    """Return the cache key for an eye and a grid."""
    spec_tree, _ = pack(spec)
    if not spec.follows_field:
        spec_tree["object"][1]["camera"] = list(spec.pixel_pitch_mrad)
    text = json.dumps([code_version(), spec_tree], sort_keys=True)
    grid_hash = hashlib.blake2b(text.encode(), digest_size=KEY_BYTES).hexdigest()
    return f"{eye_name(profile)}{SEPARATOR}{grid_hash}"


def eye_name(profile: EyeProfile) -> str:
    """Return the hash of a profile, with which the names of all its stores start."""
    tree, arrays = pack(profile)
    digest = hashlib.blake2b(digest_size=KEY_BYTES)
    digest.update(json.dumps(tree, sort_keys=True).encode())
    for array in arrays.values():
        digest.update(array.tobytes())
    return digest.hexdigest()


_logged: set[tuple[Path, str]] = set()


def _log_once(path: Path, text: str) -> None:
    """Log a problem with a file the first time only.

    The log never contains the name of a file: it is a hash of an eye, which anyone can
    compare with hashes of likely prescriptions.
    """
    if (path, text) not in _logged:
        _logged.add((path, text))
        log.warning("a file in %s %s", path.parent, text)


def _remove(path: Path, reason: Exception) -> None:
    """Remove a damaged file; a folder with its name stays."""
    try:
        path.unlink(missing_ok=True)
    except OSError:  # a folder, or no permission
        _log_once(path, f"is ignored: {reason}")
    else:
        log.warning("removed a damaged file from %s: %s", path.parent, reason)


class StoreCache:
    """On-disk cache of stores.

    Parameters
    ----------
    folder : str
        Folder, created on first use with access for its owner only; ``""`` disables the
        cache.
    max_mb : int
        Size limit of the folder.
    """

    def __init__(self, folder: str, *, max_mb: int) -> None:
        self._folder = Path(folder).expanduser() if folder else None
        self._max_bytes = max_mb * MB

    def load(self, key: str, *, check_cancelled: Callable[[], None]) -> Stored | None:
        """Return the store of a key, or None; remove a damaged file.

        A file that cannot be read or removed is ignored, and logged once.

        Parameters
        ----------
        check_cancelled : callable
            Called repeatedly; raises to cancel.
        """
        if self._folder is None:
            return None
        path = self._path(key)
        try:
            stored = read_file(path, check_cancelled=check_cancelled)
            if not isinstance(stored, Stored):
                raise DamagedFile(f"expected a Stored, found a {type(stored).__name__}")
        except FileNotFoundError:
            return None
        except DamagedFile as error:
            _remove(path, error)
            return None
        except OSError as error:
            _log_once(path, f"cannot be read: {error.strerror or type(error).__name__}")
            return None
        with suppress(OSError):  # another service has removed it meanwhile
            os.utime(path)
        return stored

    def save(self, key: str, stored: Stored) -> None:
        """Write a store to the cache; a failure is only logged."""
        if self._folder is None:
            return
        started_s = time.monotonic()
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            check_is_private(self._folder)
            n_bytes = write_file(self._path(key), stored)
            self._evict()
        except (OSError, NotStorable) as error:
            reason = getattr(error, "strerror", None) or error
            _log_once(self._path(key), f"cannot be written: {reason}")
            return
        log.info(
            "cached a store of %.0f MB, written in %.1f s",
            n_bytes / MB,
            time.monotonic() - started_s,
        )

    def save_aside(self, key: str, stored: Stored) -> None:
        """Write a store in a background thread that does not delay the exit.

        If the previous store is still being written, this one is dropped.  Otherwise,
        memory would fill up with stores that wait for a slow disk.
        """
        if not _WRITING.acquire(blocking=False):
            log.info("did not cache a store: the previous one is still being written")
            return

        def save() -> None:
            try:
                self.save(key, stored)
            finally:
                _WRITING.release()

        threading.Thread(target=save, daemon=True).start()

    def _path(self, key: str) -> Path:
        assert self._folder is not None  # otherwise nothing is stored
        return self._folder / f"{key}{SUFFIX}"

    def _evict(self) -> None:
        """Remove the least recently used files until the total is within the limit."""
        found = []
        assert self._folder is not None  # otherwise nothing is stored
        for path in self._folder.iterdir():
            try:
                status = path.lstat()
            except FileNotFoundError:
                continue  # another service removed it
            if not stat.S_ISREG(status.st_mode):
                continue  # a folder or link, which the cache did not create
            if path.suffix == SUFFIX:
                found.append((status.st_mtime, status.st_size, path))
            elif path.suffix == UNFINISHED:
                if time.time() - status.st_mtime > ABANDONED_S:
                    path.unlink(missing_ok=True)
        n_bytes = sum(size for _, size, _ in found)
        for _, size, path in sorted(found):
            if n_bytes <= self._max_bytes:
                return
            path.unlink(missing_ok=True)
            n_bytes -= size
            log.info("removed a file from %s: the cache is full", path.parent)


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
