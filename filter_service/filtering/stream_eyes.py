"""The eyes of one stream of frames: which one serves, and what is to be built.

State only: no GL, no processes.  `workshop` acts on what it says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from estimator.profiles.parse import EyeProfile
from filter_service.building.jobs import LookAt
from filter_service.building.used_ranges import UsedRanges
from filter_service.camera import Camera
from filter_service.errors import FilterError, NoProfile
from filter_service.filtering.accepted_profile import AcceptedProfile, PreparedStore
from filter_service.filtering.filtered import EyeEvent
from filter_service.filtering.stream_use import StreamUse
from filter_service.rendering.engine import LoadedStore
from filter_service.settings import FilterSettings


@dataclass(frozen=True)
class RenderPlan:
    """Through which eye a frame is seen, with one store for each view.

    ``is_complete`` is false where one of the stores is a preview, or does not hold the
    state of the frame yet: then ``is_prepared`` is, too, unless that stays so, as
    ``notes`` say.
    """

    eye: AcceptedProfile
    stores: tuple[LoadedStore, ...]
    is_complete: bool = True
    is_prepared: bool = True
    notes: tuple[str, ...] = ()


class Wanted(NamedTuple):
    """A store to be built; ``extends`` says that another serves its camera so far."""

    eye: AcceptedProfile
    camera: Camera
    ranges: UsedRanges | None = None
    extends: bool = False
    with_preview: bool = True


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
    first_generation : int
        Where profiles are counted from.
    """

    on_event: Callable[[EyeEvent], None]
    max_cameras: int = 4
    first_cameras: tuple[Camera, ...] = ()
    first_generation: int = 1
    ticket: int | None = None
    building: Wanted | None = None
    look_at: LookAt | None = None  # of the last frame
    eyes: list[AcceptedProfile] = field(default_factory=list)  # newest first, two
    retired: list[LoadedStore] = field(default_factory=list)  # stores to be freed
    _n_accepted: int = 0
    use: StreamUse = field(default_factory=StreamUse)
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
            found = [
                self._best(eye, s)
                for c in cameras
                if (s := eye.store_for(c)) is not None
            ]
            if len(found) < len(cameras):
                continue
            for camera in cameras:
                eye.note_use(camera)
            is_complete = all(prepared.is_complete for prepared in found)
            if eye is newest and is_complete:
                self._keep_only_newest()
            holds = all(self._holds(eye, one) for one in found)
            failures = self._failures_now(eye, found)
            return RenderPlan(
                eye,
                tuple(prepared.store for prepared in found),
                is_complete=is_complete and holds,
                is_prepared=holds or bool(failures) or eye is not newest,
                notes=failures,
            )
        for camera in cameras:
            failure = newest.failure_for(camera)
            if failure is not None:
                raise failure.with_traceback(None)  # raised again for every frame
        return None

    def is_final(self, plan: RenderPlan) -> bool:
        """Return whether nothing better is to come for the state of the last frame."""
        is_newest = plan.eye is self.eyes[0]
        return is_newest and (plan.is_complete or bool(plan.notes))

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
        generation = self.first_generation + self._n_accepted
        self._n_accepted += 1
        in_use = [old for old in self.eyes if old.stores][:1]
        cameras = cameras or self._last_cameras
        cameras = cameras or [s.camera for old in in_use for s in old.stores]
        cameras = cameras or self.first_cameras
        own_id = generation if profile_id is None else profile_id
        eye = AcceptedProfile(generation, own_id, profile, settings)
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
        if not self.eyes or self.eyes[0].was_complete:
            return None
        newest = self.eyes[0]
        return newest if newest.wanted or not newest.failures else None

    def next_build(self) -> Wanted | None:
        """Return what should be built next, if anything.

        First what has nothing yet, then more of what frames are about to leave.
        """
        if not self.eyes:
            return None
        eye = self.eyes[0]
        if eye.wanted:
            camera = eye.wanted[0]
            ranges = None
            if eye.settings.follows_stream:
                ranges = self.use.wanted(0.0, eye.settings)
            return Wanted(eye, camera, ranges)
        used = [eye.store_for(camera) for camera in self._last_cameras]
        return next(
            (
                extension
                for prepared in used
                if prepared is not None
                and (extension := self._extension(eye, prepared)) is not None
            ),
            None,
        )

    @property
    def builds_in_vain(self) -> bool:
        """Return whether frames left what is being built as the first of an eye.

        It was begun before the first of them came, for states that they do not have.
        """
        wanted, now = self.building, self.use.now
        if wanted is None or wanted.extends or wanted.ranges is None or now is None:
            return False
        return not wanted.ranges.holds(now.within(wanted.eye.settings))

    def _extension(
        self, eye: AcceptedProfile, prepared: PreparedStore
    ) -> Wanted | None:
        """Return more of a store where frames leave it."""
        if prepared.ranges is None or not prepared.is_complete:
            return None
        build_s, settings = prepared.build_s, eye.settings
        if not self.use.leaves(prepared.ranges, build_s, settings):
            return None
        ranges = self.use.wanted(build_s, settings)
        if ranges in prepared.failed or prepared.ranges.holds(ranges):
            return None
        # Where frames are within what there is, a preview would only show less.
        outside = not self._holds(eye, prepared)
        return Wanted(eye, prepared.camera, ranges, extends=True, with_preview=outside)

    def _best(self, eye: AcceptedProfile, prepared: PreparedStore) -> PreparedStore:
        """Return what a frame sees through: a preview only where it shows more."""
        behind = prepared.behind
        return behind if behind and self._holds(eye, behind) else prepared

    def _holds(self, eye: AcceptedProfile, prepared: PreparedStore) -> bool:
        """Return whether a store was prepared for the state of the last frame."""
        now = self.use.now
        if prepared.ranges is None or now is None:
            return True
        return prepared.ranges.holds(now.within(eye.settings))

    def _failures_now(
        self, eye: AcceptedProfile, used: list[PreparedStore]
    ) -> tuple[str, ...]:
        """Say why there is no more for the state of the last frame."""
        said = "what this frame asks for could not be prepared"
        reasons: dict[str, None] = {}
        for prepared in used:
            whole = None if prepared.is_complete else eye.failure_for(prepared.camera)
            if whole is not None:  # its preview is all there is
                reasons[f"{said}: {whole}"] = None
            if not self._holds(eye, prepared):
                reasons |= {f"{said}: {one}": None for one in prepared.failed.values()}
        return tuple(reasons)

    def put_in_place(self, eye: AcceptedProfile, prepared: PreparedStore) -> None:
        """Let frames use a loaded store; forget the camera unused for longest.

        It replaces the preview of its camera; a preview of more stands before what is
        complete, until there is more that is.
        """
        if prepared.is_complete:
            eye.want_no_more(prepared.camera)
            eye.was_complete = True
        replaced = eye.store_for(prepared.camera)
        if replaced is not None:
            eye.stores.remove(replaced)
            if replaced.is_complete and not prepared.is_complete:
                prepared = replace(prepared, behind=replaced)
            else:
                self.retired += replaced.loaded
        eye.stores.append(prepared)
        while len(eye.stores) > self.max_cameras:
            self.retired += eye.stores.pop(0).loaded

    def fail_extension(self, wanted: Wanted, error: FilterError) -> None:
        """Note why more of a store could not be built; what there is goes on."""
        eye, prepared = wanted.eye, wanted.eye.store_for(wanted.camera)
        if prepared is not None and prepared.behind is not None:
            eye.stores[eye.stores.index(prepared)] = prepared.behind
            self.retired.append(prepared.store)
            prepared = prepared.behind
        if prepared is not None and wanted.ranges is not None:
            prepared.failed[wanted.ranges] = str(error)

    def fail_build(
        self, eye: AcceptedProfile, camera: Camera, error: FilterError
    ) -> None:
        """Note why a build failed; a profile that never worked gives way to the old."""
        eye.want_no_more(camera)
        eye.failures.append((camera, error))
        has_worked = any(prepared.has_complete for prepared in eye.stores)
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
        for prepared in eye.stores:
            self.retired += prepared.loaded
        eye.stores = []
