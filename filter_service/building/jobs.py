"""Requests, limits and results of the build worker."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from filter_service.errors import BuildFailed, FilterError, UnknownProfile

if TYPE_CHECKING:
    from estimator.eye.checked_fields import ProfileError
    from estimator.profiles.parse import EyeProfile
    from filter_service.camera import Camera
    from filter_service.settings import FilterSettings
    from filter_service.view_state import State

CACHE_VARIABLE = "OCUFILTER_CACHE_DIR"

log = logging.getLogger("ocufilter.worker")


def default_cache_dir() -> str:
    """Return the folder in `CACHE_VARIABLE`, or "" for no cache if it is not set.

    The files contain medical data, so the cache must be enabled explicitly.
    """
    return os.environ.get(CACHE_VARIABLE, "")


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
        State for which nodes are planned, and then others near it; by default none.
    """

    profile: EyeProfile
    settings: FilterSettings
    camera: Camera
    limits: BuildLimits = DEFAULT_LIMITS
    near: State | None = None


@dataclass(frozen=True)
class BuiltStore:
    """Result of a build.

    Attributes
    ----------
    store : object
        Store for an engine's ``load``.
    notes : tuple of str
        Notes for the user.
    parts : tuple
        Parts that a first frame needs, for ``take`` of the loaded store.
    """

    store: Any
    notes: tuple[str, ...] = ()
    parts: tuple[Any, ...] = ()

    def parts_ahead(self, job: BuildJob) -> Iterator[Any]:
        """Yield more parts, those that frames near the job's state need first."""
        from filter_service.psfs.frame_layers import state_nodes

        planned = getattr(self.store, "planned_ahead", None)
        if planned is not None and job.near is not None:
            near = job.near.clamped(job.settings)
            yield from planned(state_nodes(self.store, near))


Build = Callable[..., BuiltStore]


@dataclass(frozen=True)
class BuildProgress:
    """Progress of a build."""

    ticket: int
    fraction: float
    stage: str


@dataclass(frozen=True)
class BuildDone:
    """Result of a build."""

    ticket: int
    built: BuiltStore


@dataclass(frozen=True)
class BuildPart:
    """Part of a built store that frames will need."""

    ticket: int
    part: Any


@dataclass(frozen=True)
class BuildError:
    """Failure of a build."""

    ticket: int
    error: FilterError


BuildEvent = BuildProgress | BuildDone | BuildPart | BuildError


def to_build_error(error: Exception) -> FilterError:
    """Return the error of a build for clients; log an unexpected one."""
    if isinstance(error, FilterError):
        return error
    log.error("a build failed unexpectedly", exc_info=error)
    return BuildFailed(f"{type(error).__name__}: {error}")


def unknown_profile(error: ProfileError) -> UnknownProfile:
    """Convert an exception of the parser."""
    return UnknownProfile(error.problem, field=error.field, allowed=error.allowed)
