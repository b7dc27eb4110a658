"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path


def write_atomically(path: Path, text: str, *, is_new: bool = False) -> None:
    """Write a text file of its owner alone, under another name first.

    That name is new and nobody can guess it, so a link that somebody has laid there is
    never followed.

    Parameters
    ----------
    is_new : bool
        Refuse to replace a file.

    Raises
    ------
    FileExistsError
        There is a file of that name, and `is_new`.
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
