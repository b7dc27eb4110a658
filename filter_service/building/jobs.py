"""Requests and results of the build worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.building.limits import BuildLimits
from filter_service.camera import Camera
from filter_service.settings import FilterSettings
from filter_service.view_state import State

DEFAULT_LIMITS = BuildLimits()


@dataclass(frozen=True)
class BuildJob:
    """Request to build one eye for one camera.

    Attributes
    ----------
    profile : EyeProfile
    settings : FilterSettings
    camera : Camera
    limits : BuildLimits
    near : State, optional
        State around which nodes are planned once the store is sent; by default none.
    """

    profile: EyeProfile
    settings: FilterSettings
    camera: Camera
    limits: BuildLimits = DEFAULT_LIMITS
    near: State | None = None


@dataclass(frozen=True)
class BuiltStore:
    """Result of a build: a store for an engine's ``load``, and notes for the user."""

    store: Any
    notes: tuple[str, ...] = ()

    def parts_ahead(self, job: BuildJob) -> Iterator[Any]:
        """Yield parts that frames will need, for ``take`` of the loaded store."""
        planned = getattr(self.store, "planned_ahead", None)
        if planned is not None and job.near is not None:
            yield from planned(job.near)


Build = Callable[..., BuiltStore]
