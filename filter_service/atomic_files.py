"""Atomic file writes: a file appears complete or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path


def write_atomically(path: Path, text: str, *, is_new: bool = False) -> None:
    """Write a text file atomically, readable by its owner only.

    The temporary file has an unpredictable name, so that no planted link is followed.

    Parameters
    ----------
    path : Path
    text : str
    is_new : bool
        Whether to refuse to replace an existing file.

    Raises
    ------
    FileExistsError
        If the file exists, and `is_new` is set.
    OSError
    """
    descriptor, unfinished = tempfile.mkstemp(
        prefix=f".{path.name}.", dir=path.absolute().parent
    )
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        if is_new:
            os.link(unfinished, path)  # unlike a rename, this never replaces a file
        else:
            os.replace(unfinished, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(unfinished)
