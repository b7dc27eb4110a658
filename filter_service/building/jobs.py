"""What the worker is asked to build, and what comes back; plain data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from estimator.profiles.parse import EyeProfile
from filter_service.building.limits import BuildLimits
from filter_service.building.used_ranges import UsedRanges
from filter_service.camera import Camera
from filter_service.settings import FilterSettings

USUAL_LIMITS = BuildLimits()


@dataclass(frozen=True)
class LookAt:
    """The state of the eye that frames show."""

    pupil_diameter_mm: float
    focus_dpt: float


@dataclass(frozen=True)
class BuildJob:
    """One eye for one camera.

    ``look_at`` is what the preview is for: the state of the last frame, if any.
    ``ranges`` are the part of the settings' that is prepared; all where it is None.
    """

    profile: EyeProfile
    settings: FilterSettings
    camera: Camera
    limits: BuildLimits = USUAL_LIMITS
    look_at: LookAt | None = None
    ranges: UsedRanges | None = None
    with_preview: bool = True


class Store(Protocol):
    """PSFs of an eye for a camera, as an engine's ``load_steps`` takes them."""

    @property
    def psf_count(self) -> int:
        """How many PSFs."""

    @property
    def memory_mb(self) -> float:
        """What they take."""


@dataclass(frozen=True)
class BuiltStore:
    """What came out of a job.

    A store that is not complete is a preview; a complete one follows.  ``ranges`` are
    those that a preview is good for, None where they are the job's.
    """

    store: Store
    build_ms: float
    psf_count: int
    memory_mb: float
    notes: tuple[str, ...] = ()
    is_complete: bool = True
    ranges: UsedRanges | None = None


Build = Callable[..., Iterator[BuiltStore]]
