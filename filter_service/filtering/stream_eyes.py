"""The eyes of one stream: the newest one, and the previous one until it is ready.

A profile is requested, then building, then ready.  This module only holds the state;
`builder` acts on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple
from weakref import WeakSet

from estimator.profiles.parse import EyeProfile
from filter_service.camera import Camera
from filter_service.errors import FilterError, NoProfile
from filter_service.filtering.accepted_profile import AcceptedProfile, PreparedStore
from filter_service.filtering.filtered import EyeEvent, Preparing
from filter_service.filtering.predicted_states import FrameHistory
from filter_service.rendering.engine import LoadedStore
from filter_service.settings import FilterSettings


@dataclass(frozen=True)
class RenderPlan:
    """The eye that renders a frame, and the store of each view."""

    eye: AcceptedProfile
    stores: tuple[LoadedStore, ...]


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
    retired : list of LoadedStore
        Stores to be released.
    begun : WeakSet
        Frames that are begun and neither finished nor dropped.
    history : FrameHistory
        Last frames.
    """

    on_event: Callable[[EyeEvent], None]
    max_cameras: int = 4
    first_cameras: tuple[Camera, ...] = ()
    first_generation: int = 1
    ticket: int | None = None
    building: BuildTarget | None = None
    eyes: list[AcceptedProfile] = field(default_factory=list)
    retired: list[LoadedStore] = field(default_factory=list)
    begun: WeakSet[Any] = field(default_factory=WeakSet)
    history: FrameHistory = field(default_factory=FrameHistory)
    _n_accepted: int = 0
    _last_cameras: tuple[Camera, ...] = ()

    def plan(
        self, cameras: Sequence[Camera], *, newest_only: bool = False
    ) -> RenderPlan | Preparing:
        """Return how to render a frame, or why no eye can render it yet.

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
            return RenderPlan(eye, tuple(s.store for s in found[eye.generation]))
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
            Cameras to prepare for; by default those of the last frame, otherwise those
            of the eye in use.
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
