"""Session management: start, resumption and end of sessions, and their profiles."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from filter_service.errors import (
    BuildCancelled,
    FilterError,
    NoSession,
    TooManySessions,
)
from filter_service.messages import (
    Accepted,
    Alive,
    ErrorReply,
    EyeName,
    Hello,
    ProfileRequest,
    Reply,
    Welcome,
)
from filter_service.service.client_memory import ClientMemory, ClientTextures
from filter_service.service.config import ServiceConfig
from filter_service.service.connections import Peer
from filter_service.service.router import Outcome, Tracker
from filter_service.service.served_devices import ServedDevice, ServedDevices
from filter_service.service.session import (
    EyeProfiles,
    Session,
    SessionRecord,
    SessionTable,
)

MAX_PENDING_HELLOS = 256
"""Maximum number of clients whose hello is answered once all devices have started."""

PROFILE_PAUSE_S = 0.05
"""Minimum interval between two profiles of an eye: the render worker takes a few
milliseconds to start a build.  Of the profiles that arrive meanwhile, only the newest
is sent."""

log = logging.getLogger("ocufilter")


class SessionManager:
    """Starts, resumes and ends sessions, and sends their profiles to render workers.

    Parameters
    ----------
    config : ServiceConfig
    endpoint : str
        Endpoint of the socket.
    sessions : SessionTable
    devices : ServedDevices
    client_memory : ClientMemory
    client_textures : ClientTextures
    send : callable
        Sends a reply to a peer.
    record : callable
        ``record(key, session)`` stores a session's record, or deletes it (None).

    Attributes
    ----------
    config : ServiceConfig
        The current settings; may be replaced.
    """

    def __init__(
        self,
        config: ServiceConfig,
        endpoint: str,
        sessions: SessionTable,
        devices: ServedDevices,
        client_memory: ClientMemory,
        client_textures: ClientTextures,
        send: Callable[[Peer, Reply], Tracker | None],
        record: Callable[[str, SessionRecord | None], None],
    ) -> None:
        self.config = config
        self._endpoint = endpoint
        self._sessions, self._devices = sessions, devices
        self._client_memory = client_memory
        self._client_textures = client_textures
        self._send, self._record = send, record
        self._pending_hellos: list[tuple[Peer, Hello]] = []  # until devices are known
        self._next_alive_s = time.monotonic() + config.alive_interval_s
        self._next_profile_s = math.inf

    @property
    def due_s(self) -> float:
        """Return the `time.monotonic` at which `run_periodic_tasks` is next due."""
        return min(self._next_alive_s, self._next_profile_s)

    # Start and resumption

    def session_of(self, peer: Peer) -> Session:
        """Return the session of a client.

        Raises
        ------
        NoSession
            If the client has none.
        """
        session = self._sessions.by_peer(peer)
        if session is None:
            raise NoSession(
                "no hello was received", allowed="hello as the first message"
            )
        return session

    def answer_hello(self, peer: Peer, hello: Hello) -> None:
        """Reply to hello, after resuming or starting a session if the client has none.

        Raises
        ------
        TooManySessions
            If all sessions have a connected client.
        """
        if not self._devices.have_reported:
            self._pending_hellos = [h for h in self._pending_hellos if h[0] != peer]
            self._pending_hellos = [
                *self._pending_hellos[1 - MAX_PENDING_HELLOS :],
                (peer, hello),
            ]
            return
        session = self._sessions.by_peer(peer)
        is_resumed = session is not None and session.key == hello.session_key
        if session is None:
            session = self._sessions.by_key(hello.session_key)
            if session is not None and session.owner != peer.key:
                session = None  # belongs to another client
            is_resumed = session is not None
            if session is None:
                session = self._new_session(peer, hello)
            else:
                self._free_client_memory(session)
                self._sessions.reconnect(session, peer, hello.client)
                log.info("session %d resumed (%r)", session.session_id, hello.client)
        transports = [self._endpoint.split("://", 1)[0]]
        if self._client_memory.is_offered:
            transports.append("shm")
        welcome = Welcome(
            session.session_id,
            self._devices.device_of(session).server or {},
            self.config.limits,
            session.credit,
            tuple(transports),
            session_key=session.key,
            session_keep_s=self.config.session_keep_s,
            is_resumed=is_resumed,
            profile_id=session.profile_ids.get("both") if is_resumed else None,
            profile_ids=session.profile_ids if is_resumed else {},
            n_unanswered=session.n_unanswered,
            textures=self._client_textures.offer_to(session),
        )
        self._send(peer, welcome)

    def answer_pending_hellos(self) -> None:
        """Reply to the clients that sent hello before all devices had reported."""
        if not self._devices.have_reported:
            return
        for peer, hello in self._pending_hellos:
            try:
                self.answer_hello(peer, hello)
            except FilterError as error:
                self._send(peer, ErrorReply.from_exception(error))
        self._pending_hellos = []

    def _new_session(self, peer: Peer, hello: Hello) -> Session:
        max_sessions = self.config.max_sessions
        if len(self._sessions) >= max_sessions:
            self._probe_clients(is_due=True)
        while len(self._sessions) >= max_sessions and self._sessions.disconnected:
            self._end(self._sessions.disconnected[0], "replaced by a new session")
        if len(self._sessions) >= max_sessions:
            raise TooManySessions(
                f"the service has {len(self._sessions)} sessions",
                allowed=f"at most {max_sessions}",
            )
        device = self._devices.least_busy()
        session = self._sessions.create(
            peer, hello.client, self.config.credit, device=device.index
        )
        self._record(session.key, session.record())
        self._open(session)
        where = f" on device {device.index}" if len(self._devices) > 1 else ""
        log.info("session %d started (%r)%s", session.session_id, hello.client, where)
        return session

    def restore(self, records: Sequence[SessionRecord]) -> None:
        """Restore the sessions of the previous front end."""
        for record in records:
            self._sessions.restore(Session.restored(record, time.monotonic()))

    def attach_device(
        self, device: ServedDevice, eyes: Sequence[tuple[Any, ...]]
    ) -> None:
        """Synchronize a new render worker with the current sessions.

        Parameters
        ----------
        eyes : sequence of (key, profiles)
            Sessions whose eyes the worker has; ``profiles`` maps each eye to
            (profile id, generation).
        """
        known = dict(eyes)
        for session in self._sessions:
            if session.device != device.index:
                continue
            if session.key not in known:
                self._open(session)
                continue
            for name, (profile_id, generation) in known.pop(session.key).items():
                eye = session.eye(name)
                if eye.generation != generation:  # accepted while no front end ran
                    eye.profile = None
                eye.profile_id, eye.generation = profile_id, generation
        for key in known:
            device.render.send("close", key)

    def _open(self, session: Session) -> None:
        """Send the eyes of a session, with their profiles, to the render worker."""
        generations = {name: eye.generation for name, eye in session.eyes.items()}
        render = self._devices.device_of(session).render
        render.send("open", session.key, session.session_id, generations)
        for eye in session.eyes.values():
            profile = eye.sent_profile or eye.profile
            if profile is not None:
                eye.sent_profile = profile
                render.send("profile", session.key, profile)

    # Profiles

    def request_profile(self, session: Session, request: ProfileRequest) -> None:
        """Queue a profile in place of an older queued one; send it if possible."""
        eye = session.eye(request.eye)
        replaced, eye.queued_profile = eye.queued_profile, request
        if replaced is not None and session.peer is not None:
            error = BuildCancelled(
                f"profile {request.profile_id} replaced profile {replaced.profile_id}"
            )
            reply = ErrorReply.from_exception(error, profile_id=replaced.profile_id)
            self._send(session.peer, reply)
        self._send_queued_profile(session, eye)

    def _send_queued_profile(self, session: Session, eye: EyeProfiles) -> None:
        """Send the queued profile, unless another one was just sent or is pending."""
        now_s = time.monotonic()
        if eye.queued_profile is None or eye.sent_profile is not None:
            return
        due_s = max(eye.next_send_s, session.next_profile_s)
        if now_s < due_s:
            self._next_profile_s = min(self._next_profile_s, due_s)
            return
        eye.next_send_s = now_s + PROFILE_PAUSE_S
        eye.sent_profile, eye.queued_profile = eye.queued_profile, None
        render = self._devices.device_of(session).render
        render.send("profile", session.key, eye.sent_profile)

    def _send_due_profiles(self, now_s: float) -> None:
        if now_s < self._next_profile_s:
            return
        self._next_profile_s = math.inf
        for session in self._sessions:
            for eye in session.eyes.values():
                self._send_queued_profile(session, eye)

    def charge_profile(self, key: str, used_s: float) -> None:
        """Charge a session for reading a profile, which delays its frames and profiles.

        A session then takes at most half of the time of the process that reads them.
        """
        session = self._sessions.by_key(key)
        if session is not None:
            begin_s = max(session.next_profile_s, time.monotonic())
            session.next_profile_s = begin_s + used_s
            self._devices.device_of(session).frames.charge(session, used_s)

    def forward_reply(self, key: str, name: EyeName, reply: Reply) -> None:
        """Forward a render worker's reply about an eye's profile to the client."""
        session = self._sessions.by_key(key)
        if session is None:
            return
        eye = session.eye(name)
        sent = eye.sent_profile
        if sent is not None and isinstance(reply, Accepted | ErrorReply):
            if isinstance(reply, Accepted):
                eye.profile, eye.profile_id = sent, reply.profile_id
                eye.generation = reply.generation
                self._record(key, session.record())
            if reply.profile_id == sent.profile_id:
                eye.sent_profile = None
                self._send_queued_profile(session, eye)
        if session.peer is not None:
            self._send(session.peer, reply)

    # End

    def run_periodic_tasks(self) -> None:
        """Probe clients, send queued profiles, and end sessions that have expired."""
        self._probe_clients()
        now_s = time.monotonic()
        self._send_due_profiles(now_s)
        for session in self._sessions.disconnected:
            if (
                now_s - (session.disconnected_since_s or 0.0)
                > self.config.session_keep_s
            ):
                self._end(session, "the client did not reconnect")

    def end_sessions_on(self, device: ServedDevice) -> None:
        """End the sessions of a device that is out of service."""
        for session in self._sessions:
            if session.device == device.index:
                device.frames.fail_waiting(session)
                self._end(session, "its device is out of service")
        self.answer_pending_hellos()

    def _probe_clients(self, *, is_due: bool = False) -> None:
        """Send `Alive` to every client, which detects vanished ones."""
        now_s = time.monotonic()
        if is_due or now_s >= self._next_alive_s:
            self._next_alive_s = now_s + self.config.alive_interval_s
            for session in self._sessions.connected:
                if session.peer is not None:
                    self._send(session.peer, Alive())

    def disconnect(self, connection: int) -> None:
        """Handle the end of a connection; its session may be resumed for a while."""
        session = self._sessions.by_connection(connection)
        if session is not None and session.peer is not None:
            self._free_client_memory(session)
            self._sessions.disconnect(session, time.monotonic())
            log.info("session %d: client disconnected", session.session_id)

    def end_session(self, peer: Peer, outcome: Outcome | None = None) -> None:
        """End the session of a client, if it has one."""
        session = self._sessions.by_connection(peer.connection)
        if session is not None:
            reason = "" if outcome is None else f"the client is {outcome.value}"
            self._end(session, reason)

    def _end(self, session: Session, reason: str) -> None:
        self._sessions.remove(session)
        self._free_client_memory(session)
        self._record(session.key, None)
        session.peer = None
        self._devices.device_of(session).frames.forget(session)
        self._devices.device_of(session).render.send("close", session.key)
        log.info(
            "session %d ended%s", session.session_id, f": {reason}" if reason else ""
        )

    def _free_client_memory(self, session: Session) -> None:
        """Release the shared memory and textures of a client that has disconnected."""
        self._client_memory.free(session)
        self._client_textures.free(session)
        self._devices.device_of(session).frames.disconnect(session)
