"""What every build of a service has to keep to."""

from __future__ import annotations

from dataclasses import dataclass

from filter_service.psfs.cache_folder import default_cache_dir

__all__ = ["BuildLimits", "default_cache_dir"]


@dataclass(frozen=True)
class BuildLimits:
    """What the service's configuration sets for every build.

    ``max_stores_mb`` is for all that are loaded at once, ``max_store_mb`` for each.
    ``store_cache_dir`` is empty where stores are not kept on disk.
    """

    max_blur_radius_px: int = 255
    max_store_mb: int = 2000
    max_stores_mb: int = 4000
    store_cache_dir: str = ""
    store_cache_max_mb: int = 2000
