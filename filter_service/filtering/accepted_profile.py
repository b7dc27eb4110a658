"""An accepted profile and its stores."""

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
    """A loaded store and the camera that it was built for.

    Attributes
    ----------
    camera : Camera
    store : LoadedStore
    started_s : float
        Time when its profile was accepted, or when a frame first used the camera.
    notes : tuple of str
        Notes about the eye, in sentences.
    is_ready : bool
        Whether the PSFs of a first frame are computed; from then on frames use it.
    used_s : float
        Time when a frame last used it, or when it was loaded.
    pending : (n,)
        Indices of a first frame's PSFs that are being computed.
    next_progress_s : float
        Earliest time of the next progress event.
    n_checks : int
        Number of times that missing PSFs of a first frame were found and computed.
    ticket : int
        Ticket of its build.
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
    """An accepted profile and its stores.

    ``generation`` counts the accepted profiles of a session; every result names it.
    Stores are in order of last use, at most one for each camera.
    """

    generation: int
    profile_id: int
    profile: EyeProfile
    settings: FilterSettings
    wanted: tuple[Camera, ...] = ()  # cameras whose first frame would wait
    stores: list[PreparedStore] = field(default_factory=list)
    was_ready: bool = False  # for any camera, at any time
    failures: list[tuple[Camera, FilterError]] = field(default_factory=list)
    accepted_s: float = field(default_factory=time.monotonic)

    def is_same(self, first: Camera, second: Camera) -> bool:
        """Return whether one store of this eye fits both cameras."""
        return is_same_camera(first, second, follows_field=self.settings.follows_field)

    def store_for(self, camera: Camera) -> PreparedStore | None:
        """Return the store for a camera, if there is one."""
        return next((s for s in self.stores if self.is_same(s.camera, camera)), None)

    def note_use(self, camera: Camera) -> None:
        """Mark a camera's store as the last used."""
        found = self.store_for(camera)
        if found is not None:
            found.used_s = time.monotonic()
        self.stores.sort(key=lambda prepared: self.is_same(prepared.camera, camera))

    def failure_for(self, camera: Camera) -> FilterError | None:
        """Return the error of a failed build for a camera, if any."""
        return next((e for c, e in self.failures if self.is_same(c, camera)), None)

    def want(self, cameras: Iterable[Camera]) -> None:
        """Request stores for cameras that have none, except for failed ones."""
        new = [
            camera
            for camera in cameras
            if self.store_for(camera) is None and self.failure_for(camera) is None
        ]
        self.wanted = distinct_cameras(
            [*self.wanted, *new], follows_field=self.settings.follows_field
        )

    def want_no_more(self, camera: Camera) -> None:
        """Withdraw the request for a camera."""
        self.wanted = tuple(c for c in self.wanted if not self.is_same(c, camera))
