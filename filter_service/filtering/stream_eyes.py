"""The eyes of one stream of frames: which one serves, and what is to be built.

State only: no GL, no processes.  `workshop` acts on what it says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from estimator.profiles.parse import EyeProfile
from filter_service.building.jobs import LookAt
from filter_service.camera import Camera
from filter_service.errors import FilterError, NoProfile
from filter_service.filtering.accepted_profile import AcceptedProfile, PreparedStore
from filter_service.filtering.filtered import EyeEvent
from filter_service.rendering.engine import LoadedStore
from filter_service.settings import FilterSettings


@dataclass(frozen=True)
class RenderPlan:
    """Through which eye a frame is seen, with one store for each view.

    ``is_complete`` is false where one of the stores is a preview.
    """

    eye: AcceptedProfile
    stores: tuple[LoadedStore, ...]
    is_complete: bool = True


@dataclass(eq=False)
class StreamEyes:
    """The newest eye of a stream, and the one that serves until it is ready.

    Parameters
    ----------
    on_event : callable
        Told of every `EyeEvent`.
    max_cameras : int
        Stores that one eye keeps.
    first_cameras : tuple of Camera
        What to prepare for while no frame has come.
    """

    on_event: Callable[[EyeEvent], None]
    max_cameras: int = 4
    first_cameras: tuple[Camera, ...] = ()
    ticket: int | None = None
    building: tuple[AcceptedProfile, Camera] | None = None
    look_at: LookAt | None = None  # of the last frame
    eyes: list[AcceptedProfile] = field(default_factory=list)  # newest first, two
    retired: list[LoadedStore] = field(default_factory=list)  # stores to be freed
    _n_generations: int = 0
    _last_cameras: tuple[Camera, ...] = ()

    def plan(self, cameras: Sequence[Camera], look_at: LookAt) -> RenderPlan | None:
        """Return how to render a frame; None while its eye is being prepared.

        The newest eye is asked to prepare for the frame's cameras.  Until it has
        something to show, the eye before it goes on serving; that one is given up as
        soon as the newest is complete and cannot fail any more.

        Raises
        ------
        NoProfile, BuildFailed and other session errors
        """
        self._last_cameras = tuple(cameras)
        self.look_at = look_at
        if not self.eyes:
            raise NoProfile("no profile was sent", allowed="a profile before frames")
        newest = self.eyes[0]
        newest.want(cameras)
        for eye in self.eyes:
            found = [s for c in cameras if (s := eye.store_for(c)) is not None]
            if len(found) < len(cameras):
                continue
            for camera in cameras:
                eye.note_use(camera)
            is_complete = all(prepared.is_complete for prepared in found)
            if eye is newest and is_complete:
                self._keep_only_newest()
            return RenderPlan(
                eye, tuple(prepared.store for prepared in found), is_complete
            )
        for camera in cameras:
            failure = newest.failure_for(camera)
            if failure is not None:
                raise failure.with_traceback(None)  # raised again for every frame
        return None

    def add_profile(
        self,
        profile: EyeProfile,
        settings: FilterSettings,
        cameras: Sequence[Camera] = (),
        *,
        profile_id: int | None = None,
    ) -> AcceptedProfile:
        """Make a profile the newest eye; the one in use stays until then.

        It is prepared for the given cameras, else for those of the last frame, else for
        those of the eye in use.
        """
        self._n_generations += 1
        in_use = [old for old in self.eyes if old.stores][:1]
        cameras = cameras or self._last_cameras
        cameras = cameras or [s.camera for old in in_use for s in old.stores]
        cameras = cameras or self.first_cameras
        own_id = self._n_generations if profile_id is None else profile_id
        eye = AcceptedProfile(self._n_generations, own_id, profile, settings)
        eye.want(cameras)
        for old in self.eyes:
            if old not in in_use:
                self._retire(old)
        self.eyes = [eye, *in_use]
        return eye

    def unfinished_eye(self) -> AcceptedProfile | None:
        """Return the newest eye if its profile has had no ending yet.

        A preview is not one: the profile may still fail.
        """
        if not self.eyes or any(s.is_complete for s in self.eyes[0].stores):
            return None
        newest = self.eyes[0]
        return newest if newest.wanted or not newest.failures else None

    def next_build(self) -> tuple[AcceptedProfile, Camera] | None:
        """Return what should be built next, if anything."""
        if not self.eyes or not self.eyes[0].wanted:
            return None
        return self.eyes[0], self.eyes[0].wanted[0]

    def put_in_place(self, eye: AcceptedProfile, prepared: PreparedStore) -> None:
        """Let frames use a loaded store; forget the camera unused for longest.

        It replaces the preview of its camera.
        """
        if prepared.is_complete:
            eye.want_no_more(prepared.camera)
        replaced = eye.store_for(prepared.camera)
        if replaced is not None:
            eye.stores.remove(replaced)
            self.retired.append(replaced.store)
        eye.stores.append(prepared)
        while len(eye.stores) > self.max_cameras:
            self.retired.append(eye.stores.pop(0).store)

    def fail_build(
        self, eye: AcceptedProfile, camera: Camera, error: FilterError
    ) -> None:
        """Note why a build failed; a profile that never worked gives way to the old."""
        eye.want_no_more(camera)
        eye.failures.append((camera, error))
        has_worked = any(prepared.is_complete for prepared in eye.stores)
        if not has_worked and len(self.eyes) > 1 and eye is self.eyes[0]:
            self._retire(self.eyes.pop(0))

    def end(self) -> None:
        """Give up everything; `retired` then holds all stores."""
        for eye in self.eyes:
            self._retire(eye)
        self.eyes = []

    def _keep_only_newest(self) -> None:
        for old in self.eyes[1:]:
            self._retire(old)
        self.eyes = self.eyes[:1]

    def _retire(self, eye: AcceptedProfile) -> None:
        self.retired += [prepared.store for prepared in eye.stores]
        eye.stores = []
