"""What the worker is asked to build, and what comes back; plain data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from filter_service.messages import Camera, ProfileSettings


@dataclass(frozen=True)
class LookAt:
    """The state of the eye that frames show."""

    pupil_diameter_mm: float
    focus_dpt: float


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


@dataclass(frozen=True)
class BuildJob:
    """One eye for one camera.

    ``look_at`` is what the preview is for: the state of the last frame, if any.
    """

    body: dict[str, Any]
    settings: ProfileSettings
    camera: Camera
    limits: BuildLimits = BuildLimits()
    look_at: LookAt | None = None


@dataclass(frozen=True)
class BuiltStore:
    """What came out of a job; ``store`` is what the renderer's ``load`` takes.

    A store that is not complete is a preview; a complete one follows.
    """

    store: Any
    build_ms: float
    psf_count: int
    memory_mb: float
    notes: tuple[str, ...] = ()
    is_complete: bool = True


Build = Callable[..., Iterator[BuiltStore]]
