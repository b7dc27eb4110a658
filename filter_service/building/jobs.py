"""Requests and results of the worker, as plain data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.building.limits import BuildLimits
from filter_service.camera import Camera
from filter_service.settings import FilterSettings

USUAL_LIMITS = BuildLimits()


@dataclass(frozen=True)
class BuildJob:
    """Request to estimate one eye for one camera.

    Attributes
    ----------
    near : (pupil_diameter_mm, focus_dpt), optional
        State around which nodes are planned after the eye is sent; by default none are.
    """

    profile: EyeProfile
    settings: FilterSettings
    camera: Camera
    limits: BuildLimits = USUAL_LIMITS
    near: tuple[float, float] | None = None


@dataclass(frozen=True)
class BuiltStore:
    """An estimated eye with the nodes of its PSFs, for an engine's ``load``."""

    store: Any
    notes: tuple[str, ...] = ()

    def parts_ahead(self, job: BuildJob) -> Iterator[Any]:
        """Yield parts of the store that frames will need, for its ``take``."""
        planned = getattr(self.store, "planned_ahead", None)
        if planned is not None and job.near is not None:
            yield from planned(*job.near)


Build = Callable[..., BuiltStore]
