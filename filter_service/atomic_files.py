"""Atomic file writes: a file appears complete or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path


def write_atomically(path: Path, text: str, *, is_new: bool = False) -> None:
    """Write a text file for its owner only, atomically through a temporary file.

    The temporary name is new and unpredictable, so that a link planted there is never
    followed.

    Parameters
    ----------
    is_new : bool
        Whether to refuse to replace an existing file.

    Raises
    ------
    FileExistsError
        The file exists, and `is_new` is set.
    OSError
    """
    descriptor, unfinished = tempfile.mkstemp(
        prefix=f".{path.name}.", dir=path.absolute().parent
    )
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        if is_new:
            os.link(unfinished, path)  # unlike a rename it never replaces a file
        else:
            os.replace(unfinished, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(unfinished)
