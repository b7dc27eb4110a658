"""One accepted profile with the stores that exist of it."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimator.profiles.parse import EyeProfile
from filter_service.camera import Camera, distinct_cameras, is_same_camera
from filter_service.errors import FilterError
from filter_service.rendering.engine import LoadedStore
from filter_service.settings import FilterSettings


@dataclass(eq=False)
class PreparedStore:
    """A loaded store and the camera that it was made for.

    Attributes
    ----------
    camera : Camera
    store : LoadedStore
    started_s : float
        When its profile was accepted, or a frame first asked for the camera.
    notes : tuple of str
        About the eye, in sentences.
    is_ready : bool
        The PSFs of a first frame are computed; from then on it serves.
    used_s : float
        When a frame last went through it, or when it was loaded.
    pending : (n,)
        PSFs of a first frame that are being computed.
    next_progress_s : float
        When progress may be told again.
    n_checks : int
        How often missing PSFs of a first frame were found and computed.
    ticket : int
        Of its build.
    """

    camera: Camera
    store: LoadedStore
    started_s: float
    notes: tuple[str, ...] = ()
    is_ready: bool = False
    used_s: float = field(default_factory=time.monotonic)
    pending: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    next_progress_s: float = 0.0
    n_checks: int = 0
    ticket: int = 0


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
    wanted: tuple[Camera, ...] = ()  # cameras whose first frame would wait
    stores: list[PreparedStore] = field(default_factory=list)
    was_ready: bool = False  # for some camera, whatever has become of it
    failures: list[tuple[Camera, FilterError]] = field(default_factory=list)
    accepted_s: float = field(default_factory=time.monotonic)

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
        """Return why no store could be made for a camera."""
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
