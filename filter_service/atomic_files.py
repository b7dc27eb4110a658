"""Atomic file writes: a file appears complete or not at all."""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PART_NAME = re.compile(r"\.ocufilter-[0-9a-f]{32}\.part(\.\w+)?")
"""Names of temporary files, which no other program gives to its files.  A process that
is killed leaves one."""

_PRIVATE = stat.S_IRUSR | stat.S_IWUSR
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL
_NEW_FILE |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)  # Unix only


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
    if not is_private:
        with suppress(FileNotFoundError):
            found = path.stat().st_mode
            if stat.S_ISCHR(found) or stat.S_ISFIFO(found):
                write(path)
                return
    mode = _PRIVATE if is_private else _mode_of(path)
    with _written_part(path, write, mode) as part:
        if is_new:
            os.link(part, path)  # unlike a rename, this never replaces a file
        else:
            os.replace(part, path)


def replace_with_header(
    header: Path,
    write_header: Callable[[Path], object],
    data: Path,
    write_data: Callable[[Path], object],
) -> None:
    """Write a file of data and its header under other names, then rename both.

    The header is renamed last, and an earlier one is removed before the data are
    renamed: at no time does a header stand beside data that it does not describe.  If
    writing fails, earlier files remain.

    Parameters
    ----------
    header, data : Path
    write_header, write_data : callable
        As for `replace_atomically`.

    Raises
    ------
    OSError
    """
    with (
        _written_part(data, write_data, _mode_of(data)) as data_part,
        _written_part(header, write_header, _mode_of(header)) as header_part,
    ):
        header.unlink(missing_ok=True)
        os.replace(data_part, data)
        os.replace(header_part, header)


def _mode_of(path: Path) -> int:
    """Return the permissions of an earlier file, or those of a new one."""
    mode = 0o666
    with suppress(FileNotFoundError):
        mode &= stat.S_IMODE(path.stat().st_mode) | _PRIVATE
    return mode


@contextmanager
def _written_part(
    path: Path, write: Callable[[Path], object], mode: int
) -> Iterator[Path]:
    """Write a temporary file in the folder of a path; remove it at the end."""
    part = path.with_name(f".ocufilter-{secrets.token_hex(16)}.part{path.suffix}")
    os.close(os.open(part, _NEW_FILE, mode))
    try:
        write(part)
        with part.open("r+b") as file:  # Windows flushes only writable files
            os.fsync(file.fileno())  # before the rename, even in a power failure
        yield part
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
