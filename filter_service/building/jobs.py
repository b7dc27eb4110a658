"""What the worker is asked to estimate, and what comes back; plain data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.building.limits import BuildLimits
from filter_service.camera import Camera
from filter_service.settings import FilterSettings

USUAL_LIMITS = BuildLimits()


@dataclass(frozen=True)
class BuildJob:
    """One eye for one camera."""

    profile: EyeProfile
    settings: FilterSettings
    camera: Camera
    limits: BuildLimits = USUAL_LIMITS


@dataclass(frozen=True)
class BuiltStore:
    """An estimated eye with the nodes of its PSFs, as an engine's ``load`` takes it."""

    store: Any
    notes: tuple[str, ...] = ()


Build = Callable[..., BuiltStore]
