"""What every build of a service has to keep to, and where it keeps what it made."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


def default_cache_dir() -> str:
    """Return where finished PSFs are kept if nothing else is said."""
    own = os.environ.get("OCUFILTER_CACHE_DIR")
    if own is not None:
        return own
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return str(Path(base) / "ocufilter")


@dataclass(frozen=True)
class BuildLimits:
    """What the service's configuration sets for every build.

    ``store_cache_dir`` is empty where stores are not kept on disk.
    """

    max_blur_radius_px: int = 255
    max_store_mb: int = 2000
    psf_engine: str = "auto"
    store_cache_dir: str = ""
    store_cache_max_mb: int = 2000
