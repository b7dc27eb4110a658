"""Limits of every build of a service."""

from __future__ import annotations

from dataclasses import dataclass

from filter_service.psfs.cache_folder import default_cache_dir

__all__ = ["BuildLimits", "default_cache_dir"]


@dataclass(frozen=True)
class BuildLimits:
    """Limits from the service's configuration that apply to every build.

    ``max_stores_mb`` limits all loaded stores together, ``max_store_mb`` each of them.
    ``store_cache_dir`` is empty if there is no on-disk cache.
    """

    max_blur_radius_px: int = 255
    max_store_mb: int = 2000
    max_stores_mb: int = 4000
    store_cache_dir: str = ""
    store_cache_max_mb: int = 2000
