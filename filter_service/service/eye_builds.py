"""Profiles of all sessions on their way through the worker to the renderer."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from filter_service.errors import BuildCancelled, FilterError, RenderFailed
from filter_service.messages import (
    Accepted,
    Camera,
    ErrorReply,
    ProfileRequest,
    Progress,
    Ready,
    Reply,
)
from filter_service.rendering.store_upload import Upload
from filter_service.service.build_job import BuildJob, BuildLimits, BuiltStore
from filter_service.service.session import Eye, PreparedStore, Session
from filter_service.service.worker_handle import (
    BuildDone,
    BuildError,
    BuildEvent,
    BuildProgress,
    WorkerHandle,
)

log = logging.getLogger("ocufilter")


@dataclass(frozen=True, eq=False)
class _Loading:
    """A store that is built and not yet on the GPU."""

    session: Session
    eye: Eye
    camera: Camera
    built: BuiltStore
    upload: Upload


class EyeBuilds:
    """Accepts profiles, has their stores built, loads them, tells the clients.

    Parameters
    ----------
    worker : WorkerHandle
    renderer : FilterRenderer, or another with its ``load_steps``
    check_profile : callable
        ``check_profile(body, settings)`` raises a FilterError for a wrong profile.
    send : callable
        ``send(identity, reply)``; it may end the session.
    limits : BuildLimits
    """

    def __init__(
        self,
        worker: WorkerHandle,
        *,
        renderer: Any,
        check_profile: Callable[[dict, Any], object],
        send: Callable[[bytes, Reply], None],
        limits: BuildLimits,
    ) -> None:
        self._worker = worker
        self._renderer = renderer
        self._check_profile = check_profile
        self._send = send
        self._limits = limits
        self._loads: list[_Loading] = []
        self._released: list[Any] = []
        self._going: list[Any] = []

    @property
    def is_loading(self) -> bool:
        """Return whether `advance` has something to do at once."""
        return bool(self._loads)

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
        self.free_retired(session)
        self._send(
            session.identity,
            Accepted(
                request.profile_id,
                eye.generation,
                is_building=bool(eye.wanted),
                n_cameras=len(eye.wanted),
            ),
        )

    def cancel(self, session: Session) -> None:
        """Stop what is being built and loaded for a session."""
        if session.ticket is not None:
            self._worker.cancel(session.ticket)
        session.ticket = session.building = None
        for loading in self._loads_of(session):
            self._loads.remove(loading)
            loading.upload.give_up()

    def free_retired(self, session: Session) -> None:
        """Free the stores that a session has given up."""
        for store in session.retired:
            store.release()
        self._released += session.retired
        session.retired = []

    def _drop_released(self) -> None:
        """Let go of what was released, one turn later and in a thread.

        To return half a gigabyte to the system takes 0.2 s; by then the renderer has
        let go of it too.
        """
        dropped, self._going = self._going, self._released
        self._released = []
        if dropped:
            threading.Thread(target=dropped.clear, daemon=True).start()

    def advance(self, sessions: Iterable[Session], *, load_s: float) -> None:
        """Take in what the worker has to say; keep one build of each session going.

        Parameters
        ----------
        load_s : float
            For copying stores to the GPU; a slice may take longer by a little.
        """
        self._drop_released()
        sessions = list(sessions)
        for event in self._worker.poll():
            session = next((s for s in sessions if s.ticket == event.ticket), None)
            # Without a session, it has ended or wants something newer.
            if session is not None:
                self._handle(session, event)
        self._advance_loads(time.monotonic() + load_s)
        for session in sessions:
            following = session.next_build()
            if session.building is None and following is not None:
                session.building = following
                session.ticket = self._worker.submit(self._job(session, *following))

    def _job(self, session: Session, eye: Eye, camera: Camera) -> BuildJob:
        return BuildJob(
            body=eye.body,
            settings=eye.settings,
            camera=camera,
            limits=self._limits,
            look_at=session.look_at,
        )

    def _handle(self, session: Session, event: BuildEvent) -> None:
        eye, camera = session.building
        if isinstance(event, BuildProgress):
            progress = Progress(
                eye.profile_id, eye.generation, event.stage, event.fraction
            )
            self._send(session.identity, progress)
        elif isinstance(event, BuildDone):
            if event.built.is_complete:
                session.ticket = None
            upload = Upload(self._renderer.load_steps(event.built.store))
            self._loads.append(_Loading(session, eye, camera, event.built, upload))
        elif isinstance(event, BuildError):
            self._fail(session, eye, camera, event.error)

    def _loads_of(self, session: Session) -> list[_Loading]:
        return [loading for loading in self._loads if loading.session is session]

    def _advance_loads(self, deadline_s: float) -> None:
        """Go on with the oldest load: a session's preview before the rest."""
        while self._loads:
            loading = self._loads[0]
            session, eye, camera = loading.session, loading.eye, loading.camera
            try:
                if not loading.upload.advance(deadline_s):
                    return
            except Exception as error:
                if not isinstance(error, FilterError):
                    log.exception("a store could not be loaded")
                    error = RenderFailed(f"{type(error).__name__}: {error}")
                if session.ticket is not None:
                    self._worker.cancel(session.ticket)
                self._fail(session, eye, camera, error)
            else:
                self._loads.pop(0)
                self._released.append(loading.built)
                self._put_in_place(loading)

    def _put_in_place(self, loading: _Loading) -> None:
        session, eye, built = loading.session, loading.eye, loading.built
        if built.is_complete:
            session.building = None
        session.put_in_place(
            eye, PreparedStore(loading.camera, loading.upload.loaded, built.is_complete)
        )
        self.free_retired(session)
        ready = Ready(
            profile_id=eye.profile_id,
            generation=eye.generation,
            build_ms=built.build_ms,
            psf_count=built.psf_count,
            memory_mb=built.memory_mb,
            pixel_pitch_mrad=loading.camera.pixel_pitch_mrad,
            notes=built.notes,
            is_complete=built.is_complete,
        )
        self._send(session.identity, ready)

    def _fail(
        self, session: Session, eye: Eye, camera: Camera, error: FilterError
    ) -> None:
        """End the building of a store, whether it failed there or at being loaded."""
        session.ticket = None
        self.cancel(session)
        session.fail_build(eye, camera, error)
        self.free_retired(session)
        self._tell_failure(session, eye, error)

    def _tell_failure(self, session: Session, eye: Eye, error: FilterError) -> None:
        reply = ErrorReply.from_exception(error, profile_id=eye.profile_id)
        self._send(session.identity, reply)
