"""What the worker is asked to build, and what comes back; plain data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from filter_service.messages import ProfileSettings


@dataclass(frozen=True)
class BuildJob:
    """One eye for one camera."""

    body: dict[str, Any]
    settings: ProfileSettings
    pixel_pitch_mrad: tuple[float, float]
    max_blur_radius_px: int


@dataclass(frozen=True)
class BuiltStore:
    """What came out of a job; ``store`` is what the renderer's ``load`` takes."""

    store: Any
    build_ms: float
    psf_count: int
    memory_mb: float
    notes: tuple[str, ...] = ()


Build = Callable[..., BuiltStore]
