"""Limits that apply to every build."""

from __future__ import annotations

from dataclasses import dataclass

from filter_service.psfs.cache_folder import default_cache_dir

__all__ = ["BuildLimits", "default_cache_dir"]


@dataclass(frozen=True)
class BuildLimits:
    """Limits of builds, from the service's settings.

    Attributes
    ----------
    max_blur_radius_px : int
        Largest kernel radius.
    max_store_mb, max_stores_mb : int
        Memory of one loaded store, and of all of them, 10^6 bytes.
    store_cache_dir : str
        Folder of the on-disk cache; empty without one.
    store_cache_max_mb : int
        Maximum size of that folder, 10^6 bytes.
    """

    max_blur_radius_px: int = 255
    max_store_mb: int = 2000
    max_stores_mb: int = 4000
    store_cache_dir: str = ""
    store_cache_max_mb: int = 2000
