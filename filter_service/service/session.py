"""One client's session: its eyes, what is to be built, its waiting frame, its credit.

State only: no sockets, no GL, no processes.  `server` acts on what it says.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from filter_service.errors import CreditExceeded, FilterError, NoProfile
from filter_service.messages import Camera, Frame, ProfileRequest, ProfileSettings
from filter_service.psfs.camera_match import distinct_cameras, is_same_camera
from filter_service.service.build_job import LookAt


@dataclass(frozen=True, eq=False)
class PreparedStore:
    """A loaded store and the camera it was built for.

    ``is_complete`` is false for a preview, which a complete store will replace.
    """

    camera: Camera
    store: Any
    is_complete: bool = True


@dataclass
class Eye:
    """One accepted profile with the stores that exist of it.

    ``generation`` counts the accepted profiles of a session; every result names it.
    Stores are in order of last use, at most one for each camera.
    """

    generation: int
    profile_id: int
    body: dict[str, Any]
    settings: ProfileSettings
    wanted: tuple[Camera, ...] = ()
    stores: list[PreparedStore] = field(default_factory=list)
    failures: list[tuple[Camera, FilterError]] = field(default_factory=list)

    def is_same(self, first: Camera, second: Camera) -> bool:
        """Return whether one store of this eye serves both cameras."""
        return is_same_camera(first, second, follows_field=self.settings.follows_field)

    def store_for(self, camera: Camera) -> PreparedStore | None:
        """Return the store that serves a camera."""
        return next((s for s in self.stores if self.is_same(s.camera, camera)), None)

    def note_use(self, camera: Camera) -> None:
        """Move a camera's store to the end."""
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


@dataclass(frozen=True)
class WaitingFrame:
    """A frame with the times that its stages need."""

    frame: Frame
    received_s: float
    decoded_s: float


@dataclass(frozen=True)
class RenderPlan:
    """Through which eye a frame is seen, with one store for each view.

    ``is_complete`` is false where one of the stores is a preview.
    """

    eye: Eye
    stores: tuple[Any, ...]
    is_complete: bool = True


@dataclass
class Session:
    """What the service knows of one client.

    Parameters
    ----------
    session_id : int
    identity : bytes
        The client's routing id.
    credit : int
        Frames it may have unanswered.
    max_cameras : int
        Stores that one eye keeps.
    """

    session_id: int
    identity: bytes
    client: str
    credit: int
    max_cameras: int
    n_unanswered: int = 0
    waiting: WaitingFrame | None = None
    ticket: int | None = None
    building: tuple[Eye, Camera] | None = None
    look_at: LookAt | None = None  # of the last frame
    eyes: list[Eye] = field(default_factory=list)  # newest first, at most two
    retired: list[Any] = field(default_factory=list)  # stores to be freed
    unsent: list[Any] = field(default_factory=list)  # trackers of large replies
    _n_generations: int = 0
    _last_cameras: tuple[Camera, ...] = ()

    # Frames

    def take_in(self, waiting: WaitingFrame) -> WaitingFrame | None:
        """Keep a frame as the newest; return the one that it supersedes.

        Raises
        ------
        CreditExceeded
            The client has too many unanswered frames; this one is not kept.
        """
        if self.n_unanswered >= self.credit:
            raise CreditExceeded(
                f"{self.n_unanswered} frames are unanswered",
                field="frame_id",
                allowed=f"{self.credit} unanswered frames",
            )
        self.n_unanswered += 1
        superseded, self.waiting = self.waiting, waiting
        return superseded

    def plan(self, frame: Frame) -> RenderPlan | None:
        """Return how to render a frame; None while its eye is being prepared.

        The newest eye is asked to prepare for the frame's cameras.  Until it has
        something to show, the eye before it goes on serving; that one is given up as
        soon as the newest is complete and cannot fail any more.

        Raises
        ------
        NoProfile, BuildFailed and other session errors
        """
        cameras = [view.camera for view in frame.views]
        self._last_cameras = tuple(cameras)
        self.look_at = LookAt(frame.pupil_diameter_mm, frame.focus_dpt)
        if not self.eyes:
            raise NoProfile("no profile was sent", allowed="a profile before frames")
        newest = self.eyes[0]
        newest.want(cameras)
        for eye in self.eyes:
            found = [eye.store_for(camera) for camera in cameras]
            if any(prepared is None for prepared in found):
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

    # Profiles

    def add_profile(self, request: ProfileRequest) -> Eye:
        """Make a checked profile the newest eye; the one in use stays until then.

        It is prepared for the cameras that the request names, else for those of the
        last frame, else for those of the eye in use.
        """
        self._n_generations += 1
        in_use = [old for old in self.eyes if old.stores][:1]
        cameras = request.cameras or self._last_cameras
        cameras = cameras or [s.camera for old in in_use for s in old.stores]
        eye = Eye(
            generation=self._n_generations,
            profile_id=request.profile_id,
            body=request.body,
            settings=request.settings,
        )
        eye.want(cameras)
        for old in self.eyes:
            if old not in in_use:
                self._retire(old)
        self.eyes = [eye, *in_use]
        return eye

    def unfinished_eye(self) -> Eye | None:
        """Return the newest eye if its profile has had no ending yet.

        A preview is not one: the profile may still fail.
        """
        if not self.eyes or any(s.is_complete for s in self.eyes[0].stores):
            return None
        newest = self.eyes[0]
        return newest if newest.wanted or not newest.failures else None

    def next_build(self) -> tuple[Eye, Camera] | None:
        """Return what should be built next, if anything."""
        if not self.eyes or not self.eyes[0].wanted:
            return None
        return self.eyes[0], self.eyes[0].wanted[0]

    def put_in_place(self, eye: Eye, prepared: PreparedStore) -> None:
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

    def fail_build(self, eye: Eye, camera: Camera, error: FilterError) -> None:
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
        self.waiting = None

    def _keep_only_newest(self) -> None:
        for old in self.eyes[1:]:
            self._retire(old)
        self.eyes = self.eyes[:1]

    def _retire(self, eye: Eye) -> None:
        self.retired += [prepared.store for prepared in eye.stores]
        eye.stores = []
