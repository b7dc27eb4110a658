"""Where finished PSFs are kept on disk, if anywhere."""

from __future__ import annotations

import os
from pathlib import Path

CACHE_VARIABLE = "OCUFILTER_CACHE_DIR"


def default_cache_dir() -> str:
    """Return where finished PSFs are kept if nothing else is said: nowhere.

    They tell of a person's eyes, so that it is for somebody to decide.
    """
    return os.environ.get(CACHE_VARIABLE, "")


def check_is_private(folder: Path) -> None:
    """Refuse a folder that others may look into.

    Raises
    ------
    PermissionError
    """
    if folder.stat().st_mode & 0o077:
        raise PermissionError(
            f"others may look into {folder}, and eyes are nobody's business: "
            f"chmod 700 {folder}"
        )
