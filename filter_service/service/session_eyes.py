"""The eyes of one session, each with an `EyeFilter` that is created on first use."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from estimator.profiles.parse import EyeProfile
from filter_service.errors import FilterError, NoSession
from filter_service.filtering.builder import Builder
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.stream_eyes import BuildingEye, EyeEvent, EyeReady
from filter_service.messages import (
    Accepted,
    ErrorReply,
    EyeName,
    ProfileRequest,
    Progress,
    Ready,
    Reply,
)

log = logging.getLogger("ocufilter")


@dataclass(eq=False)
class _Eye:
    """The filter of one eye and its last accepted profile."""

    eye_filter: EyeFilter
    profile_id: int | None = None
    generation: int = 0


class SessionEyes:
    """The eyes of one session.

    Parameters
    ----------
    session_id : int
    builder : Builder
        Builder of the eyes.
    send_reply : callable
        ``send_reply(eye, reply)`` sends a reply about the profile of an eye.
    max_cameras : int
        Number of cameras for which each eye stays prepared.
    generations : mapping
        Generation of the last accepted profile of each eye.
    """

    def __init__(
        self,
        session_id: int,
        builder: Builder,
        send_reply: Callable[[EyeName, Reply], None],
        *,
        max_cameras: int,
        generations: Mapping[EyeName, int],
    ) -> None:
        self.session_id = session_id
        self._builder = builder
        self._send_reply = send_reply
        self._max_cameras = max_cameras
        self._generations = generations
        self._eyes: dict[EyeName, _Eye] = {}
        self._is_closed = False

    @property
    def profiles(self) -> dict[EyeName, tuple[int | None, int]]:
        """Return profile_id and generation of each eye."""
        return {
            name: (eye.profile_id, eye.generation) for name, eye in self._eyes.items()
        }

    def close(self) -> None:
        """Release all eyes."""
        self._is_closed = True
        for eye in self._eyes.values():
            eye.eye_filter.close()

    def filter_of(self, name: EyeName) -> EyeFilter:
        """Return the filter of an eye.

        Raises
        ------
        NoSession
            If the session has ended.
        """
        return self._eye(name).eye_filter

    def _eye(self, name: EyeName) -> _Eye:
        if self._is_closed:
            raise NoSession("the session has ended")
        if name not in self._eyes:
            eye_filter = EyeFilter(
                builder=self._builder,
                max_cameras=self._max_cameras,
                on_event=partial(self._send_event, name),
                first_generation=self._generations.get(name, 0) + 1,
            )
            self._eyes[name] = _Eye(eye_filter)
        return self._eyes[name]

    def accept_profile(
        self, request: ProfileRequest, profile: EyeProfile | FilterError
    ) -> Reply:
        """Set a profile; return the reply, accepted or an error.

        Parameters
        ----------
        request : ProfileRequest
        profile : EyeProfile or FilterError
            The parsed body, or why it was refused.
        """
        try:
            if isinstance(profile, FilterError):
                raise profile
            eye = self._eye(request.eye)
            accepted = eye.eye_filter.set_profile(
                profile,
                settings=request.settings,
                views=request.views,
                profile_id=request.profile_id,
            )
        except Exception as error:
            if not isinstance(error, FilterError):
                log.exception("a profile could not be processed")
                error = FilterError(f"{type(error).__name__}: {error}")
            return ErrorReply.from_exception(error, profile_id=request.profile_id)
        eye.profile_id, eye.generation = request.profile_id, accepted.generation
        return Accepted(
            request.profile_id,
            accepted.generation,
            is_building=accepted.first_camera_count > 0,
            n_cameras=accepted.first_camera_count,
            eye=request.eye,
        )

    def _send_event(self, name: EyeName, event: EyeEvent) -> None:
        """Convert an event of a profile to a reply and send it."""
        profile_id, generation = event.eye.profile_id, event.eye.generation
        reply: Reply
        if isinstance(event, BuildingEye):
            reply = Progress(
                profile_id, generation, event.stage, event.fraction, eye=name
            )
        elif isinstance(event, EyeReady):
            reply = Ready(
                profile_id,
                generation,
                build_ms=event.build_ms,
                psf_count=event.psf_count,
                memory_mb=event.memory_mb,
                pixel_pitch_mrad=event.camera.pixel_pitch_mrad,
                notes=event.notes,
                eye=name,
            )
        else:
            reply = ErrorReply.from_exception(event.error, profile_id=profile_id)
        self._send_reply(name, reply)
