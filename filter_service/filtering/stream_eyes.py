"""The eyes of one stream: the newest one, and the previous one until it is ready.

A profile is requested, then building, then ready.  This module only holds the state;
`builder` acts on it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, Literal, NamedTuple
from weakref import WeakSet

from estimator.profiles.parse import EyeProfile
from filter_service.camera import Camera, distinct_cameras, is_same_camera
from filter_service.errors import FilterError, NoProfile
from filter_service.filtering.frame_history import FrameHistory
from filter_service.filtering.psf_work import PredictedNodes, PsfWork
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.media_effects import MediaEffects
from filter_service.settings import FilterSettings


@dataclass(eq=False)
class PreparedStore:
    """A store that an engine has loaded, and the camera that it was built for.

    Attributes
    ----------
    camera : Camera
    store : FrameStore
    started_s : float
        Time when its profile was accepted, or when a frame first used the camera.
    notes : tuple of str
        Notes about the eye, in sentences.
    is_ready : bool
        Whether the PSFs of a first frame are computed, so that frames use the store.
    last_used_s : float
        Time when a frame last used it, or when it was loaded.
    work : PsfWork, optional
        PSFs that are being computed: of a first frame, then of predicted states.
    predicted : PredictedNodes
        Nodes of predicted states.
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
    store: FrameStore
    started_s: float
    notes: tuple[str, ...] = ()
    is_ready: bool = False
    last_used_s: float = field(default_factory=time.monotonic)
    work: PsfWork | None = None
    predicted: PredictedNodes = field(default_factory=PredictedNodes)
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
    first_camera_count : int
        Number of cameras that were requested with the profile.
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
    first_camera_count: int = 0
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


@dataclass(frozen=True)
class Preparing:
    """Why a frame is not filtered yet, in place of its result; it is false.

    Attributes
    ----------
    reason : "preparing" or "extending"
        Whether no eye is ready for the frame, or only PSFs of its state or the newest
        eye are missing.
    fraction : float, optional
        Completed fraction, 0 to 1, if it is known.
    stage : str
        What is computed now.
    """

    reason: Literal["preparing", "extending"]
    fraction: float | None = None
    stage: str = ""

    def __bool__(self) -> Literal[False]:
        """Return false, unlike results."""
        return False


@dataclass(frozen=True)
class BuildingEye:
    """Progress of a profile: the completed fraction, 0 to 1, and the stage."""

    eye: AcceptedProfile
    fraction: float
    stage: str


@dataclass(frozen=True)
class EyeReady:
    """The PSFs for a first frame of a camera are computed.

    Attributes
    ----------
    build_ms : float
        Time since the profile was accepted.
    psf_count : int
        Number of computed PSFs.
    memory_mb : float
        Memory of the PSFs, 10^6 bytes.
    notes : tuple of str
        Notes for the user.
    """

    eye: AcceptedProfile
    camera: Camera
    build_ms: float
    psf_count: int
    memory_mb: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class EyeFailed:
    """A profile, or its PSFs for a camera, could not be prepared."""

    eye: AcceptedProfile
    error: FilterError


EyeEvent = BuildingEye | EyeReady | EyeFailed


class BuildTarget(NamedTuple):
    """An eye and the camera to build it for."""

    eye: AcceptedProfile
    camera: Camera


@dataclass(eq=False)
class StreamEyes:
    """The newest eye of a stream, and the previous one until the newest is ready.

    Parameters
    ----------
    on_event : callable
        Called with each `EyeEvent`.
    max_cameras : int
        Maximum number of stores of one eye.
    first_cameras : tuple of Camera
        Cameras to prepare for until a frame arrives.
    first_generation : int
        Generation of the first profile.

    Attributes
    ----------
    ticket, building : int and BuildTarget, optional
        Current build in the worker.
    eyes : list of AcceptedProfile
        The newest one and, while that is not ready, the previous one.
    retired : list of FrameStore
        Stores to be released.
    begun : WeakSet
        Frames that are begun and neither finished nor dropped.
    history : FrameHistory
        Last frames.
    events : SimpleQueue
        Events that were not delivered yet.
    """

    on_event: Callable[[EyeEvent], None]
    max_cameras: int = 4
    first_cameras: tuple[Camera, ...] = ()
    first_generation: int = 1
    ticket: int | None = None
    building: BuildTarget | None = None
    eyes: list[AcceptedProfile] = field(default_factory=list)
    retired: list[FrameStore] = field(default_factory=list)
    begun: WeakSet[Any] = field(default_factory=WeakSet)
    history: FrameHistory = field(default_factory=FrameHistory)
    events: SimpleQueue[EyeEvent] = field(default_factory=SimpleQueue)
    _n_accepted: int = 0
    _last_cameras: tuple[Camera, ...] = ()

    def plan(
        self, cameras: Sequence[Camera], *, newest_only: bool = False
    ) -> tuple[AcceptedProfile, list[FrameStore]] | Preparing:
        """Return the eye and the store of each view, or why no eye is ready.

        This requests stores of the newest eye for the frame's cameras.  Frames use the
        previous eye until the newest is ready, unless ``newest_only`` is set; then the
        previous one is retired.

        Raises
        ------
        NoProfile
            If no profile was accepted.
        FilterError
            If the build of the newest eye failed for one of the cameras.
        """
        self._last_cameras = tuple(cameras)
        if not self.eyes:
            raise NoProfile("no profile was sent", allowed="a profile before frames")
        newest = self.eyes[0]
        newest.request(cameras)
        found = {
            eye.generation: [
                s for camera in cameras if (s := eye.store_for(camera)) is not None
            ]
            for eye in self.eyes
        }
        usable = [e for e in self.eyes if len(found[e.generation]) == len(cameras)]
        ready = [e for e in usable if all(s.is_ready for s in found[e.generation])]
        for eye in (*ready, *usable):
            for camera in cameras:
                eye.mark_used(camera)
            if eye is newest and eye in ready:
                self._retire_older()
            if newest_only and eye is not newest:
                return Preparing("extending", newest.fraction, newest.stage)
            return eye, [s.store for s in found[eye.generation]]
        for camera in cameras:
            failure = newest.failure_for(camera)
            if failure is not None:
                raise failure.with_traceback(None)  # raised again for every frame
        return Preparing("preparing", newest.fraction, newest.stage)

    def add_profile(
        self,
        profile: EyeProfile,
        settings: FilterSettings,
        cameras: Sequence[Camera] = (),
        *,
        profile_id: int | None = None,
    ) -> AcceptedProfile:
        """Make a profile the newest eye; the eye in use stays until it is ready.

        Parameters
        ----------
        profile : EyeProfile
        settings : FilterSettings
        cameras : sequence of Camera
            Cameras to prepare for; by default the cameras of the last frame, otherwise
            the cameras of the eye in use.
        profile_id : int, optional
            Identifier that results return; by default the generation.
        """
        generation = self.first_generation + self._n_accepted
        self._n_accepted += 1
        in_use = [old for old in self.eyes if old.was_ready and old.stores][:1]
        cameras = cameras or self._last_cameras
        cameras = cameras or [s.camera for old in in_use for s in old.stores]
        cameras = cameras or self.first_cameras
        own_id = generation if profile_id is None else profile_id
        eye = AcceptedProfile(generation, own_id, profile, settings)
        eye.request(cameras)
        eye.first_camera_count = len(eye.requested)
        for old in self.eyes:
            if old not in in_use:
                self._retire(old)
        self.eyes = [eye, *in_use]
        return eye

    def unfinished_eye(self) -> AcceptedProfile | None:
        """Return the newest eye if it is neither ready nor failed."""
        if not self.eyes or self.eyes[0].was_ready:
            return None
        newest = self.eyes[0]
        return newest if newest.requested or not newest.failures else None

    def next_build(self) -> BuildTarget | None:
        """Return the next eye and camera to build, if there are any."""
        if not self.eyes:
            return None
        eye = self.eyes[0]
        camera = next((c for c in eye.requested if eye.store_for(c) is None), None)
        return None if camera is None else BuildTarget(eye, camera)

    def store_to_warm(self) -> tuple[AcceptedProfile, PreparedStore] | None:
        """Return the newest eye and one of its stores that is not ready, if any."""
        if not self.eyes:
            return None
        eye = self.eyes[0]
        store = next((s for s in eye.stores if not s.is_ready), None)
        return None if store is None else (eye, store)

    def store_in_use(self) -> PreparedStore | None:
        """Return the newest eye's store for the last frame, if it is ready."""
        if not self.eyes or not self._last_cameras:
            return None
        found = self.eyes[0].store_for(self._last_cameras[0])
        return found if found is not None and found.is_ready else None

    def add_store(self, eye: AcceptedProfile, prepared: PreparedStore) -> None:
        """Add a loaded store; retire the least recently used ones beyond the limit."""
        replaced = eye.store_for(prepared.camera)
        if replaced is not None:
            eye.stores.remove(replaced)
            self.retired.append(replaced.store)
        eye.stores.append(prepared)
        while len(eye.stores) > self.max_cameras:
            self.retired.append(eye.stores.pop(0).store)

    def set_ready(self, eye: AcceptedProfile, prepared: PreparedStore) -> None:
        """Mark a store as ready for frames."""
        prepared.is_ready = eye.was_ready = True
        eye.withdraw(prepared.camera)

    def fail_build(
        self, eye: AcceptedProfile, camera: Camera, error: FilterError
    ) -> None:
        """Record a failed build; drop the newest eye if it was never ready."""
        eye.withdraw(camera)
        eye.failures.append((camera, error))
        failed = eye.store_for(camera)
        if failed is not None:
            eye.stores.remove(failed)
            self.retired.append(failed.store)
        if not eye.was_ready and len(self.eyes) > 1 and eye is self.eyes[0]:
            self._retire(self.eyes.pop(0))

    def end(self) -> None:
        """Retire all eyes."""
        for eye in self.eyes:
            self._retire(eye)
        self.eyes = []

    def _retire_older(self) -> None:
        for old in self.eyes[1:]:
            self._retire(old)
        self.eyes = self.eyes[:1]

    def _retire(self, eye: AcceptedProfile) -> None:
        self.retired += [prepared.store for prepared in eye.stores]
        eye.stores = []
