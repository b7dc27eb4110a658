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
from filter_service.service.client_memory import ClientMemory
from filter_service.service.config import ServiceConfig
from filter_service.service.connections import Peer
from filter_service.service.router import Outcome, Tracker
from filter_service.service.served_devices import ServedDevice, ServedDevices
from filter_service.service.session import EyeProfiles, Session, SessionRecord
from filter_service.service.session_table import SessionTable

MAX_GREETINGS = 256
"""Maximum number of clients that wait for the reply to hello while a device starts."""

PROFILE_PAUSE_S = 0.05
"""Minimum interval between two profiles of an eye: the render worker needs some
milliseconds to read and start one.  Of profiles that arrive meanwhile, only the newest
counts."""

log = logging.getLogger("ocufilter")


class SessionManager:
    """Manages the sessions of clients, each on one device.

    Parameters
    ----------
    config : ServiceConfig
    endpoint : str
        Endpoint of the socket.
    sessions : SessionTable
    devices : ServedDevices
    client_memory : ClientMemory
    send : callable
        Sends a reply to a peer.
    record : callable
        ``record(key, session)`` stores a session, or its end (None).

    Attributes
    ----------
    config : ServiceConfig
        The settings as last read.
    """

    def __init__(
        self,
        config: ServiceConfig,
        endpoint: str,
        sessions: SessionTable,
        devices: ServedDevices,
        client_memory: ClientMemory,
        send: Callable[[Peer, Reply], Tracker | None],
        record: Callable[[str, SessionRecord | None], None],
    ) -> None:
        self.config = config
        self._endpoint = endpoint
        self._sessions, self._devices = sessions, devices
        self._client_memory = client_memory
        self._send, self._record = send, record
        self._greetings: list[tuple[Peer, Hello]] = []  # until devices are known
        self._next_alive_s = time.monotonic() + config.alive_interval_s
        self._next_profile_s = math.inf

    @property
    def due_s(self) -> float:
        """Time when `tidy` next has work to do, on the monotonic clock."""
        return min(self._next_alive_s, self._next_profile_s)

    # Start and resumption

    def session_at(self, peer: Peer) -> Session:
        """Return the session of a client.

        Raises
        ------
        NoSession
        """
        session = self._sessions.at(peer)
        if session is None:
            raise NoSession(
                "no hello was received", allowed="hello as the first message"
            )
        return session

    def greet(self, peer: Peer, hello: Hello) -> None:
        """Answer hello: with the client's session, a resumed one, or a new one.

        Raises
        ------
        TooManySessions
        """
        if not self._devices.are_known:  # one has not reported yet
            self._greetings = [g for g in self._greetings if g[0] != peer]
            self._greetings = [*self._greetings[1 - MAX_GREETINGS :], (peer, hello)]
            return
        session, is_resumed = self._sessions.at(peer), False
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
            self._devices.of(session).server or {},
            self.config.limits,
            session.credit,
            tuple(transports),
            session_key=session.key,
            session_keep_s=self.config.session_keep_s,
            is_resumed=is_resumed,
            profile_id=session.profile_ids.get("both") if is_resumed else None,
            profile_ids=session.profile_ids if is_resumed else {},
        )
        self._send(peer, welcome)

    def greet_waiting(self) -> None:
        """Answer the clients that sent hello before all devices had reported."""
        if not self._devices.are_known:
            return
        for peer, hello in self._greetings:
            try:
                self.greet(peer, hello)
            except FilterError as error:
                self._send(peer, ErrorReply.from_exception(error))
        self._greetings = []

    def _new_session(self, peer: Peer, hello: Hello) -> Session:
        most = self.config.max_sessions
        if len(self._sessions) >= most:
            self._probe_clients(is_due=True)
        while len(self._sessions) >= most and self._sessions.away:
            self._forget(self._sessions.away[0], "its place is needed")
        if len(self._sessions) >= most:
            raise TooManySessions(
                f"{len(self._sessions)} clients are being served",
                allowed=f"{most} clients",
            )
        device = self._devices.least_busy()
        session = self._sessions.begin(
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
            self._sessions.remember(Session.restored(record, time.monotonic()))

    def attach_device(
        self, device: ServedDevice, eyes: Sequence[tuple[Any, ...]]
    ) -> None:
        """Synchronize a device with the current sessions.

        Parameters
        ----------
        eyes : sequence of (key, profiles)
            Sessions whose eyes the device has; ``profiles`` maps each eye to (profile
            id, generation).
        """
        held = dict(eyes)
        for session in self._sessions:
            if session.device != device.index:
                continue
            if session.key not in held:
                self._open(session)
                continue
            for name, (profile_id, generation) in held.pop(session.key).items():
                eye = session.eye(name)
                if eye.generation != generation:  # accepted as the front end ended
                    eye.profile = None
                eye.profile_id, eye.generation = profile_id, generation
        for key in held:
            device.render.tell("close", key)

    def _open(self, session: Session) -> None:
        """Send the eyes of a session, with their profiles, to the render worker."""
        generations = {name: eye.generation for name, eye in session.eyes.items()}
        render = self._devices.of(session).render
        render.tell("open", session.key, session.session_id, generations)
        for eye in session.eyes.values():
            profile = eye.asked_profile or eye.profile
            if profile is not None:
                eye.asked_profile = profile
                render.tell("profile", session.key, profile)

    # Profiles

    def take_profile(self, session: Session, request: ProfileRequest) -> None:
        """Request a profile; of several pending ones the newest counts."""
        eye = session.eye(request.eye)
        replaced, eye.next_profile = eye.next_profile, request
        if replaced is not None and session.peer is not None:
            error = BuildCancelled(
                f"profile {request.profile_id} took the place of profile "
                f"{replaced.profile_id}"
            )
            reply = ErrorReply.from_exception(error, profile_id=replaced.profile_id)
            self._send(session.peer, reply)
        self._ask_next_profile(session, eye)

    def _ask_next_profile(self, session: Session, eye: EyeProfiles) -> None:
        """Send the newest profile, unless one is in progress or was just sent."""
        now_s = time.monotonic()
        if eye.next_profile is None or eye.asked_profile is not None:
            return
        if now_s < eye.next_ask_s:
            self._next_profile_s = min(self._next_profile_s, eye.next_ask_s)
            return
        eye.next_ask_s = now_s + PROFILE_PAUSE_S
        eye.asked_profile, eye.next_profile = eye.next_profile, None
        render = self._devices.of(session).render
        render.tell("profile", session.key, eye.asked_profile)

    def _ask_due_profiles(self, now_s: float) -> None:
        if now_s < self._next_profile_s:
            return
        self._next_profile_s = math.inf
        for session in self._sessions:
            for eye in session.eyes.values():
                self._ask_next_profile(session, eye)

    def pass_on(self, key: str, name: EyeName, reply: Reply) -> None:
        """Pass a render worker's reply about an eye's profile on to the client."""
        session = self._sessions.by_key(key)
        if session is None:
            return
        eye = session.eye(name)
        asked = eye.asked_profile
        if asked is not None and isinstance(reply, Accepted | ErrorReply):
            if isinstance(reply, Accepted):
                eye.profile, eye.profile_id = asked, reply.profile_id
                eye.generation = reply.generation
                self._record(key, session.record())
            if reply.profile_id == asked.profile_id:
                eye.asked_profile = None
                self._ask_next_profile(session, eye)
        if session.peer is not None:
            self._send(session.peer, reply)

    # End

    def tidy(self) -> None:
        """Probe clients, and end the sessions of those that did not return."""
        self._probe_clients()
        now_s = time.monotonic()
        self._ask_due_profiles(now_s)
        for session in self._sessions.away:
            if now_s - (session.away_since_s or 0.0) > self.config.session_keep_s:
                self._forget(session, "its client did not reconnect")

    def give_up(self, device: ServedDevice) -> None:
        """End the sessions of a lost device; new ones start on other devices."""
        for session in self._sessions:
            if session.device == device.index:
                device.frames.lose_waiting(session)
                self._forget(session, "its device is gone")
        self.greet_waiting()

    def _probe_clients(self, *, is_due: bool = False) -> None:
        """Send `Alive` to every client, which detects vanished ones."""
        now_s = time.monotonic()
        if is_due or now_s >= self._next_alive_s:
            self._next_alive_s = now_s + self.config.alive_interval_s
            for session in self._sessions.present:
                if session.peer is not None:
                    self._send(session.peer, Alive())

    def leave(self, peer: Peer) -> None:
        """Keep the session of a vanished client for a while."""
        self.lose(peer.connection)

    def lose(self, connection: int) -> None:
        """Handle the end of a connection; keep its session for a while."""
        session = self._sessions.on_connection(connection)
        if session is not None and session.peer is not None:
            self._free_client_memory(session)
            self._sessions.leave(session, time.monotonic())
            log.info("session %d: its client disconnected", session.session_id)

    def end_session(self, peer: Peer, outcome: Outcome | None = None) -> None:
        """End the session of a client, if it has one."""
        session = self._sessions.on_connection(peer.connection)
        if session is not None:
            why = "" if outcome is None else f"the client is {outcome.value}"
            self._forget(session, why)

    def _forget(self, session: Session, why: str) -> None:
        self._sessions.remove(session)
        self._free_client_memory(session)
        self._record(session.key, None)
        session.peer = None
        self._devices.of(session).frames.forget(session)
        self._devices.of(session).render.tell("close", session.key)
        log.info("session %d ends%s", session.session_id, f": {why}" if why else "")

    def _free_client_memory(self, session: Session) -> None:
        """Release the shared memory of a client that is gone."""
        self._client_memory.end(session)
        self._devices.of(session).frames.leave(session)
