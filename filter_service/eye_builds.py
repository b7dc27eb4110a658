"""Profiles of all sessions on their way through the worker to the renderer."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Any

from filter_service.build_job import BuildJob, BuiltStore
from filter_service.errors import BuildCancelled, FilterError, RenderFailed
from filter_service.messages import (
    Accepted,
    ErrorReply,
    ProfileRequest,
    Progress,
    Ready,
    Reply,
)
from filter_service.session import Eye, Pitch, Session
from filter_service.worker_handle import (
    BuildDone,
    BuildError,
    BuildEvent,
    BuildProgress,
    WorkerHandle,
)

log = logging.getLogger("ocufilter")


class EyeBuilds:
    """Accepts profiles, has their stores built, loads them, tells the clients.

    Parameters
    ----------
    worker : WorkerHandle
    renderer : FilterRenderer, or another with its ``load``
    check_profile : callable
        ``check_profile(body, settings)`` raises a FilterError for a wrong profile.
    send : callable
        ``send(identity, reply)``; it may end the session.
    max_blur_radius_px : int
    """

    def __init__(
        self,
        worker: WorkerHandle,
        *,
        renderer: Any,
        check_profile: Callable[[dict, Any], object],
        send: Callable[[bytes, Reply], None],
        max_blur_radius_px: int,
    ) -> None:
        self._worker = worker
        self._renderer = renderer
        self._check_profile = check_profile
        self._send = send
        self._max_blur_radius_px = max_blur_radius_px

    def take_profile(self, session: Session, request: ProfileRequest) -> None:
        """Accept a profile; a build of an older one that still runs is cancelled.

        Raises
        ------
        UnknownProfile
            The session goes on as before.
        """
        self._check_profile(request.body, request.settings)
        # Accepted in the same pass counts as well: its build has not begun, but its
        # sender awaits an ending too.
        replaced = [session.building[0]] if session.building is not None else []
        unfinished = session.unfinished_eye()
        if unfinished is not None and unfinished not in replaced:
            replaced.append(unfinished)
        self.cancel(session)
        for old in replaced:
            error = BuildCancelled(
                f"profile {request.profile_id} took the place of "
                f"profile {old.profile_id}"
            )
            self._tell_failure(session, old, error)
        eye = session.add_profile(request)
        free_retired(session)
        self._send(
            session.identity,
            Accepted(request.profile_id, eye.generation, bool(eye.wanted)),
        )

    def cancel(self, session: Session) -> None:
        """Stop what is being built for a session."""
        if session.ticket is not None:
            self._worker.cancel(session.ticket)
        session.ticket = session.building = None

    def advance(self, sessions: Iterable[Session]) -> None:
        """Take in what the worker has to say; keep one build of each session going."""
        sessions = list(sessions)
        for event in self._worker.poll():
            session = next((s for s in sessions if s.ticket == event.ticket), None)
            # Without a session, it has ended or wants something newer.
            if session is not None:
                self._handle(session, event)
        for session in sessions:
            following = session.next_build()
            if session.building is None and following is not None:
                eye, pitch = session.building = following
                session.ticket = self._worker.submit(
                    BuildJob(eye.body, eye.settings, pitch, self._max_blur_radius_px)
                )

    def _handle(self, session: Session, event: BuildEvent) -> None:
        eye, pitch = session.building
        if isinstance(event, BuildProgress):
            progress = Progress(
                eye.profile_id, eye.generation, event.stage, event.fraction
            )
            self._send(session.identity, progress)
            return
        session.ticket = session.building = None
        if isinstance(event, BuildDone):
            self._put_in_place(session, eye, pitch, event.built)
        elif isinstance(event, BuildError):
            session.fail_build(eye, pitch, event.error)
            self._tell_failure(session, eye, event.error)

    def _put_in_place(
        self, session: Session, eye: Eye, pitch: Pitch, built: BuiltStore
    ) -> None:
        try:
            store = self._renderer.load(built.store)
        except Exception as error:
            if not isinstance(error, FilterError):
                log.exception("a store could not be loaded")
                error = RenderFailed(f"{type(error).__name__}: {error}")
            session.fail_build(eye, pitch, error)
            self._tell_failure(session, eye, error)
            return
        session.finish_build(eye, pitch, store)
        free_retired(session)
        ready = Ready(
            profile_id=eye.profile_id,
            generation=eye.generation,
            build_ms=built.build_ms,
            psf_count=built.psf_count,
            memory_mb=built.memory_mb,
            pixel_pitch_mrad=pitch,
            notes=built.notes,
        )
        self._send(session.identity, ready)

    def _tell_failure(self, session: Session, eye: Eye, error: FilterError) -> None:
        reply = ErrorReply.from_exception(error, profile_id=eye.profile_id)
        self._send(session.identity, reply)


def free_retired(session: Session) -> None:
    """Free the stores that a session has given up."""
    for store in session.retired:
        store.release()
    session.retired = []
