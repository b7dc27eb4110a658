"""Atomic file writes: a file appears complete or not at all."""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

PART_NAME = re.compile(r"\.ocufilter-[0-9a-f]{32}\.part(\.\w+)?")
"""Names of temporary files, which no other program gives to its files.  A process that
is killed leaves one."""

_PRIVATE = stat.S_IRUSR | stat.S_IWUSR
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def replace_atomically(
    path: Path,
    write: Callable[[Path], object],
    *,
    is_private: bool = False,
    is_new: bool = False,
) -> None:
    """Write a file under another name in its folder, then rename it.

    The temporary file has an unpredictable name, so that no planted link is followed,
    whose length does not depend on the name of the file, and the suffix of the file.
    If writing fails, an earlier file remains.

    Parameters
    ----------
    path : Path
    write : callable
        Writes the content to an existing, empty file.
    is_private : bool
        Whether only the owner may read the file.  Otherwise an earlier file keeps its
        permissions, and a device or pipe is written directly.
    is_new : bool
        Whether to refuse to replace an existing file.

    Raises
    ------
    FileExistsError
        If the file exists, and `is_new` is set.
    OSError
    """
    mode = _PRIVATE if is_private else 0o666
    if not is_private:
        with suppress(FileNotFoundError):
            found = path.stat().st_mode
            if stat.S_ISCHR(found) or stat.S_ISFIFO(found):
                write(path)
                return
            mode &= stat.S_IMODE(found) | _PRIVATE
    part = path.with_name(f".ocufilter-{secrets.token_hex(16)}.part{path.suffix}")
    os.close(os.open(part, _NEW_FILE, mode))
    try:
        write(part)
        with part.open("rb") as file:
            os.fsync(file.fileno())  # before the rename, even in a power failure
        if is_new:
            os.link(part, path)  # unlike a rename, this never replaces a file
        else:
            os.replace(part, path)
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


def write_atomically(path: Path, content: str | bytes, *, is_new: bool = False) -> None:
    """Write a text or binary file atomically, readable by its owner only.

    Parameters
    ----------
    path : Path
    content : str or bytes
        Text is encoded as UTF-8.
    is_new : bool
        Whether to refuse to replace an existing file.

    Raises
    ------
    FileExistsError
        If the file exists, and `is_new` is set.
    OSError
    """
    data = content.encode() if isinstance(content, str) else content
    replace_atomically(
        path, lambda part: part.write_bytes(data), is_private=True, is_new=is_new
    )
