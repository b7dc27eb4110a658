"""Folder of the on-disk cache, if there is one."""

from __future__ import annotations

import os
from pathlib import Path

CACHE_VARIABLE = "OCUFILTER_CACHE_DIR"


def default_cache_dir() -> str:
    """Return the default folder of the on-disk cache: none, unless the variable is set.

    The files reveal a person's eyes, so keeping them requires a decision.
    """
    return os.environ.get(CACHE_VARIABLE, "")


def check_is_private(folder: Path) -> None:
    """Raise if other users have access to a folder.

    Raises
    ------
    PermissionError
    """
    if folder.stat().st_mode & 0o077:
        raise PermissionError(
            f"other users can read {folder}, which holds medical data: chmod 700 "
            f"{folder}"
        )
