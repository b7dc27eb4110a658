"""One accepted profile with the stores that exist of it."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from estimator.profiles.parse import EyeProfile
from filter_service.building.used_ranges import UsedRanges
from filter_service.camera import Camera, distinct_cameras, is_same_camera
from filter_service.errors import FilterError
from filter_service.rendering.engine import LoadedStore
from filter_service.settings import FilterSettings


@dataclass(eq=False)
class PreparedStore:
    """A loaded store and the camera it was built for.

    ``is_complete`` is false for a preview, which a complete store will replace.
    ``ranges`` are those of a stream that it was built for, of a preview its one state,
    None for all that the settings allow; ``failed`` are such that could not be built,
    with the reason.
    ``behind`` is the complete store that a preview of more stands before.
    ``used_s`` is when a frame last went through it, or when it was put in place.
    """

    camera: Camera
    store: LoadedStore
    is_complete: bool = True
    ranges: UsedRanges | None = None
    build_s: float = 0.0
    failed: dict[UsedRanges, str] = field(default_factory=dict)
    behind: PreparedStore | None = None
    memory_mb: float = 0.0
    used_s: float = field(default_factory=time.monotonic)

    @property
    def has_complete(self) -> bool:
        """Return whether there is more than a preview."""
        return self.is_complete or self.behind is not None

    @property
    def whole_mb(self) -> float:
        """Return what it takes, with what is behind it."""
        return self.memory_mb + (self.behind.whole_mb if self.behind else 0.0)

    @property
    def loaded(self) -> list[LoadedStore]:
        """Return what is to be freed with it."""
        return [self.store, *(self.behind.loaded if self.behind else ())]


@dataclass(eq=False)
class AcceptedProfile:
    """One accepted profile with the stores that exist of it.

    ``generation`` counts the accepted profiles of a session; every result names it.
    Stores are in order of last use, at most one for each camera.
    """

    generation: int
    profile_id: int
    profile: EyeProfile
    settings: FilterSettings
    wanted: tuple[Camera, ...] = ()
    stores: list[PreparedStore] = field(default_factory=list)
    was_complete: bool = False  # for some camera, whatever has become of it
    failures: list[tuple[Camera, FilterError]] = field(default_factory=list)

    def is_same(self, first: Camera, second: Camera) -> bool:
        """Return whether one store of this eye serves both cameras."""
        return is_same_camera(first, second, follows_field=self.settings.follows_field)

    def store_for(self, camera: Camera) -> PreparedStore | None:
        """Return the store that serves a camera."""
        return next((s for s in self.stores if self.is_same(s.camera, camera)), None)

    def note_use(self, camera: Camera) -> None:
        """Move a camera's store to the end."""
        found = self.store_for(camera)
        if found is not None:
            found.used_s = time.monotonic()
        self.stores.sort(key=lambda prepared: self.is_same(prepared.camera, camera))

    def failure_for(self, camera: Camera) -> FilterError | None:
        """Return why the build for a camera failed."""
        return next((e for c, e in self.failures if self.is_same(c, camera)), None)

    def want(self, cameras: Iterable[Camera]) -> None:
        """Ask for stores for cameras that have none; one that failed stays failed."""
        new = [
            camera
            for camera in cameras
            if self.store_for(camera) is None and self.failure_for(camera) is None
        ]
        self.wanted = distinct_cameras(
            [*self.wanted, *new], follows_field=self.settings.follows_field
        )

    def want_no_more(self, camera: Camera) -> None:
        """Forget the wish for a camera."""
        self.wanted = tuple(c for c in self.wanted if not self.is_same(c, camera))
