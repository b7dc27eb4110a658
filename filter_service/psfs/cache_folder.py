"""Folder of the on-disk cache, if there is one."""

from __future__ import annotations

import os
from pathlib import Path

CACHE_VARIABLE = "OCUFILTER_CACHE_DIR"


def default_cache_dir() -> str:
    """Return the folder in `CACHE_VARIABLE`, or "" for no cache if it is not set.

    The files contain medical data, so the cache must be enabled explicitly.
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
            f"other users can access {folder}, which contains medical data; run "
            f"chmod 700 {folder}"
        )
