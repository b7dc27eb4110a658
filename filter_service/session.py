"""One client's session: its eyes, what is to be built, its waiting frame, its credit.

State only: no sockets, no GL, no processes.  `server` acts on what it says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from filter_service.errors import CreditExceeded, FilterError, NoProfile
from filter_service.messages import Frame, ProfileRequest, ProfileSettings

Pitch = tuple[float, float]

PITCH_TOLERANCE = 1e-3
"""Pitches this close share a PSF store; the renderer accepts the same."""


def is_same_pitch(first: Pitch, second: Pitch) -> bool:
    """Return whether a store for one pixel pitch serves the other."""
    return all(
        abs(a / b - 1.0) <= PITCH_TOLERANCE for a, b in zip(first, second, strict=True)
    )


def distinct_pitches(pitches: Sequence[Pitch]) -> list[Pitch]:
    """Return the pitches that need a store each, in order."""
    distinct: list[Pitch] = []
    for pitch in pitches:
        if not any(is_same_pitch(pitch, known) for known in distinct):
            distinct.append(pitch)
    return distinct


@dataclass
class Eye:
    """One accepted profile with the stores that exist of it.

    ``generation`` counts the accepted profiles of a session; every result names it.
    """

    generation: int
    profile_id: int
    body: dict[str, Any]
    settings: ProfileSettings
    wanted: list[Pitch]
    stores: list[tuple[Pitch, Any]] = field(default_factory=list)
    failures: list[tuple[Pitch, FilterError]] = field(default_factory=list)

    def store_for(self, pitch: Pitch) -> Any | None:
        """Return the loaded store that serves a pitch."""
        return next((s for p, s in self.stores if is_same_pitch(p, pitch)), None)

    def note_use(self, pitch: Pitch) -> None:
        """Move a pitch's store to the end: `stores` is in order of last use."""
        self.stores.sort(key=lambda item: is_same_pitch(item[0], pitch))

    def failure_for(self, pitch: Pitch) -> FilterError | None:
        """Return why the build for a pitch failed."""
        return next((e for p, e in self.failures if is_same_pitch(p, pitch)), None)

    def want(self, pitch: Pitch) -> None:
        """Ask for a store for this pitch, unless it is there, asked for, or failed."""
        if self.store_for(pitch) is None and self.failure_for(pitch) is None:
            self.wanted = distinct_pitches([*self.wanted, pitch])


@dataclass(frozen=True)
class WaitingFrame:
    """A frame with the times that its stages need."""

    frame: Frame
    received_s: float
    decoded_s: float


@dataclass(frozen=True)
class RenderPlan:
    """Through which eye a frame is seen, with one store for each view."""

    eye: Eye
    stores: tuple[Any, ...]


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
    building: tuple[Eye, Pitch] | None = None
    eyes: list[Eye] = field(default_factory=list)  # newest first, at most two
    retired: list[Any] = field(default_factory=list)  # stores to be freed
    unsent: list[Any] = field(default_factory=list)  # trackers of large replies
    _n_generations: int = 0
    _last_pitches: list[Pitch] = field(default_factory=list)

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

        The newest eye is asked to prepare for the frame's cameras.  Until it has, the
        eye before it goes on serving, and it is given up as soon as it is not needed.

        Raises
        ------
        NoProfile, BuildFailed and other session errors
        """
        if not self.eyes:
            raise NoProfile("no profile was sent", allowed="a profile before frames")
        pitches = [view.camera.pixel_pitch_mrad for view in frame.views]
        self._last_pitches = distinct_pitches(pitches)
        for pitch in pitches:
            self.eyes[0].want(pitch)
        for i, eye in enumerate(self.eyes):
            stores = [eye.store_for(pitch) for pitch in pitches]
            if all(store is not None for store in stores):
                for pitch in pitches:
                    eye.note_use(pitch)
                if i == 0:
                    self._keep_only_newest()
                return RenderPlan(eye, tuple(stores))
        for pitch in pitches:
            failure = self.eyes[0].failure_for(pitch)
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
        pitches = [camera.pixel_pitch_mrad for camera in request.cameras]
        pitches = pitches or self._last_pitches
        pitches = pitches or [pitch for old in in_use for pitch, _ in old.stores]
        eye = Eye(
            generation=self._n_generations,
            profile_id=request.profile_id,
            body=request.body,
            settings=request.settings,
            wanted=distinct_pitches(pitches),
        )
        for old in self.eyes:
            if old not in in_use:
                self._retire(old)
        self.eyes = [eye, *in_use]
        return eye

    def unfinished_eye(self) -> Eye | None:
        """Return the newest eye if its profile has had no ending yet."""
        if not self.eyes or self.eyes[0].stores:
            return None
        newest = self.eyes[0]
        return newest if newest.wanted or not newest.failures else None

    def next_build(self) -> tuple[Eye, Pitch] | None:
        """Return what should be built next, if anything."""
        if not self.eyes or not self.eyes[0].wanted:
            return None
        return self.eyes[0], self.eyes[0].wanted[0]

    def finish_build(self, eye: Eye, pitch: Pitch, store: Any) -> None:
        """Put a loaded store in place; forget the camera unused for longest."""
        eye.wanted = [p for p in eye.wanted if not is_same_pitch(p, pitch)]
        eye.stores.append((pitch, store))
        while len(eye.stores) > self.max_cameras:
            _, oldest = eye.stores.pop(0)
            self.retired.append(oldest)

    def fail_build(self, eye: Eye, pitch: Pitch, error: FilterError) -> None:
        """Note why a build failed; a profile that never worked gives way to the old."""
        eye.wanted = [p for p in eye.wanted if not is_same_pitch(p, pitch)]
        eye.failures.append((pitch, error))
        if not eye.stores and len(self.eyes) > 1 and eye is self.eyes[0]:
            self.eyes.pop(0)

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
        self.retired += [store for _, store in eye.stores]
        eye.stores = []
