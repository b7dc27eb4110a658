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
from filter_service.rendering.media_effects import MediaEffects
from filter_service.settings import FilterSettings


@dataclass(eq=False)
class PreparedStore:
    """A store that an engine has loaded, and the camera that it was built for.

    Attributes
    ----------
    camera : Camera
    store : LoadedStore
    started_s : float
        Time when its profile was accepted, or when a frame first used the camera.
    notes : tuple of str
        Notes about the eye, in sentences.
    is_ready : bool
        Whether the PSFs of a first frame are computed, so that frames use the store.
    last_used_s : float
        Time when a frame last used it, or when it was loaded.
    pending : (n,)
        Indices of the PSFs of a first frame that are being computed.
    next_progress_s : float
        Earliest time of the next progress event.
    n_checks : int
        Number of completed checks for missing PSFs of a first frame.
    n_most_computed : int
        Largest number of PSFs that have been computed at a time.
    ticket : int
        Ticket of its build.
    """

    camera: Camera
    store: LoadedStore
    started_s: float
    notes: tuple[str, ...] = ()
    is_ready: bool = False
    last_used_s: float = field(default_factory=time.monotonic)
    pending: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    next_progress_s: float = 0.0
    n_checks: int = 0
    n_most_computed: int = 0
    ticket: int = 0


@dataclass(eq=False)
class AcceptedProfile:
    """An accepted profile and its stores.

    Attributes
    ----------
    generation : int
        Number of the profile in its stream; results return it.
    profile_id : int
        The caller's identifier of the profile.
    profile : EyeProfile
    settings : FilterSettings
    requested : tuple of Camera
        Cameras for which no store is ready yet.
    stores : list of PreparedStore
        Stores in order of last use, at most one for each camera.
    was_ready : bool
        Whether a store has been ready at any time.
    failures : list of (Camera, FilterError)
        Failed builds.
    accepted_s : float
        Time of acceptance.
    fraction : float, optional
        Completed fraction of its preparation.
    stage : str
        Current stage of its preparation.
    """

    generation: int
    profile_id: int
    profile: EyeProfile
    settings: FilterSettings
    requested: tuple[Camera, ...] = ()
    stores: list[PreparedStore] = field(default_factory=list)
    was_ready: bool = False
    failures: list[tuple[Camera, FilterError]] = field(default_factory=list)
    accepted_s: float = field(default_factory=time.monotonic)
    fraction: float | None = None
    stage: str = ""

    @property
    def media_effects(self) -> MediaEffects | None:
        """Return the effects of the media, which the published pipeline lacks."""
        if self.settings.pipeline == "published":
            return None
        return MediaEffects.of(self.profile, self.settings.display)

    def shares_store(self, first: Camera, second: Camera) -> bool:
        """Return whether both cameras can share a store of this eye."""
        return is_same_camera(first, second, follows_field=self.settings.follows_field)

    def store_for(self, camera: Camera) -> PreparedStore | None:
        """Return the store for a camera, if there is one."""
        return next(
            (s for s in self.stores if self.shares_store(s.camera, camera)), None
        )

    def mark_used(self, camera: Camera) -> None:
        """Mark a camera's store as the last one used."""
        found = self.store_for(camera)
        if found is not None:
            found.last_used_s = time.monotonic()
        self.stores.sort(
            key=lambda prepared: self.shares_store(prepared.camera, camera)
        )

    def failure_for(self, camera: Camera) -> FilterError | None:
        """Return the error of the failed build for a camera, if there is one."""
        return next((e for c, e in self.failures if self.shares_store(c, camera)), None)

    def request(self, cameras: Iterable[Camera]) -> None:
        """Request stores for cameras that have neither a store nor a failed build."""
        new = [
            camera
            for camera in cameras
            if self.store_for(camera) is None and self.failure_for(camera) is None
        ]
        self.requested = distinct_cameras(
            [*self.requested, *new], follows_field=self.settings.follows_field
        )

    def withdraw(self, camera: Camera) -> None:
        """Withdraw the request for a camera."""
        self.requested = tuple(
            c for c in self.requested if not self.shares_store(c, camera)
        )
