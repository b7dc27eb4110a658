"""On-disk cache of estimated eyes and their nodes.

The cache is a folder of files, each named by hashes of the profile, and of the grid and
the code.  Several services may share it without a lock: files appear complete (see
`store_file`), and a file being read stays intact if another process removes it.  Beyond
a size limit, the least recently used files are removed.
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
from estimator.profiles.parse import EyeProfile
from filter_service.gl.shader_source import SHADER_ROOT
from filter_service.planning.grid import GridSpec
from filter_service.psfs.cache_folder import check_is_private
from filter_service.psfs.store_codec import NotStorable, pack
from filter_service.psfs.store_file import (
    UNFINISHED,
    DamagedFile,
    read_file,
    write_file,
)

SUFFIX = ".psfs"
BETWEEN = "-"
KEY_BYTES = 16
ABANDONED_S = 3600.0
"""Age from which an unfinished file is taken for abandoned by its writer."""

MB = 1e6

_WRITING = threading.Lock()

log = logging.getLogger("ocufilter.cache")


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

    They are both packages and the PSF shaders: omitting a file that matters would serve
    wrong images; including one that does not costs a build.
    """
    ours = Path(filter_service.__file__).parent
    eyes = Path(estimator.__file__).parent
    files = [
        *(path for path in eyes.rglob("*") if path.suffix in (".py", ".json", ".onnx")),
        *ours.rglob("*.py"),
        *SHADER_ROOT.rglob("psf*"),
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
    how = hashlib.blake2b(text.encode(), digest_size=KEY_BYTES).hexdigest()
    return f"{eye_name(profile)}{BETWEEN}{how}"


def eye_name(profile: EyeProfile) -> str:
    """Return the common prefix of the names of all stores of an eye."""
    tree, arrays = pack(profile)
    digest = hashlib.blake2b(digest_size=KEY_BYTES)
    digest.update(json.dumps(tree, sort_keys=True).encode())
    for array in arrays.values():
        digest.update(array.tobytes())
    return digest.hexdigest()


_logged: set[tuple[Path, str]] = set()


def _log_once(path: Path, text: str) -> None:
    """Log a problem with an entry, the first time only."""
    if (path, text) not in _logged:
        _logged.add((path, text))
        log.warning("%s %s", path, text)


def _remove(path: Path, reason: Exception) -> None:
    """Remove a damaged entry; a folder with its name stays."""
    try:
        path.unlink(missing_ok=True)
    except OSError:  # a folder, or no permission
        _log_once(path, f"is passed over: {reason}")
    else:
        log.warning("removed %s: %s", path, reason)


class StoreCache:
    """On-disk cache of stores.

    Parameters
    ----------
    folder : str
        Folder, created on first use for its owner only; ``""`` disables the cache.
    max_mb : int
        Size limit of the folder.
    """

    def __init__(self, folder: str, *, max_mb: int) -> None:
        self._folder = Path(folder).expanduser() if folder else None
        self._max_bytes = max_mb * MB

    def load(self, key: str, *, go_on: Callable[[], None]) -> Stored | None:
        """Return the entry of a key, or None; remove a damaged file.

        A file that cannot be read or removed is ignored, and logged once.

        Parameters
        ----------
        go_on : callable
            Called repeatedly; raises to cancel.
        """
        if self._folder is None:
            return None
        path = self._path(key)
        try:
            stored = read_file(path, go_on=go_on)
            if not isinstance(stored, Stored):
                raise DamagedFile(f"it holds a {type(stored).__name__}")
        except FileNotFoundError:
            return None
        except DamagedFile as error:
            _remove(path, error)
            return None
        except OSError as error:
            _log_once(path, f"cannot be read: {error}")
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
            _log_once(self._path(key), f"cannot be kept: {reason}")
            return
        log.info(
            "cached a store of %.0f MB, written in %.1f s",
            n_bytes / MB,
            time.monotonic() - started_s,
        )

    def save_aside(self, key: str, stored: Stored) -> None:
        """Write a store in a background thread, for which an exit does not wait.

        The store is dropped while an older one is still being written; otherwise memory
        would fill up with stores that wait for a slow disk.
        """
        if not _WRITING.acquire(blocking=False):
            log.info("a store was not cached: the previous one is still being written")
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
        """Remove the least recently used files until the rest is within the limit."""
        found = []
        assert self._folder is not None  # otherwise nothing is stored
        for path in self._folder.iterdir():
            try:
                status = path.lstat()
            except FileNotFoundError:
                continue  # another service has removed it
            if not stat.S_ISREG(status.st_mode):
                continue  # a folder or a link, not one of our files
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
            log.info("removed %s: the cache is full", path.name)
