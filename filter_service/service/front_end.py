"""The front end: the process that owns the socket, the sessions and their credit.

It validates every message, answers what it can itself, and passes frames and profiles
to a render worker over a link.  The worker filters one frame at a time, or a small one
during a large one: the newest frame of each client, scheduled by the time that clients
have used.  Each device has a worker of its own, and a session is on one device.  Images
travel in shared memory.  The front end renders nothing, so it answers while a frame is
rendered, however long that takes.
"""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from typing import Any

from filter_service.errors import (
    BadMessage,
    BuildCancelled,
    FilterError,
    NotAllowed,
)
from filter_service.keys import KeyRing
from filter_service.messages import (
    Bye,
    Closing,
    Dropped,
    ErrorReply,
    EyeName,
    Frame,
    Hello,
    Ping,
    Pong,
    ProfileRequest,
    Reply,
    Share,
    Unshare,
    decode_request,
    encode,
    is_bye,
    peek_ids,
)
from filter_service.service.client_memory import MAX_PARTS_PER_VIEW, ClientMemory
from filter_service.service.config import ServiceConfig
from filter_service.service.connections import Connections, Peer
from filter_service.service.descriptors import DescriptorLimit
from filter_service.service.frame_queue import FrameQueue
from filter_service.service.listening_socket import socket_family
from filter_service.service.metrics import serve_metrics
from filter_service.service.process_channel import Link, LinkClosed
from filter_service.service.process_info import resident_memory_mb
from filter_service.service.rate_limit import Verdict
from filter_service.service.render_client import RenderClient
from filter_service.service.router import (
    Outcome,
    Received,
    Refused,
    Router,
    Tracker,
)
from filter_service.service.served_devices import ServedDevice, ServedDevices
from filter_service.service.session import Session, SessionRecord
from filter_service.service.session_manager import SessionManager
from filter_service.service.session_table import SessionTable
from filter_service.wire.message import Message

MAX_MESSAGES_PER_TURN = 64  # a flooding client must not delay the others
MAX_PARTS_LEFT_OUT = 1000  # more surplus parts are no accident
IDLE_WAIT_S = 1.0
TRIM_INTERVAL_S = 10.0
CLOSING_LINGER_MS = 200
MB = 10**6
log = logging.getLogger("ocufilter")


class FrontEnd:
    """The front end: serves sessions behind one ROUTER socket.

    Parameters
    ----------
    config : ServiceConfig
    supervisor : Link
        Link to the supervisor.
    """

    def __init__(self, config: ServiceConfig, supervisor: Link) -> None:
        self.config = config
        self._limits = config.limits
        self._supervisor = supervisor
        self._sessions = SessionTable()
        self._descriptors = DescriptorLimit(config.max_sessions)
        self._connections = Connections(
            self._descriptors.max_connections,
            self._sessions.connections,
            socket_family(config.bind),
        )
        self._n_unheard = 0
        self._is_degraded = False
        self._devices = ServedDevices(
            *(config.device_names, config.max_image_mb * MB, self._descriptors),
            *(self._sessions, self._send),
        )
        self._n_faults = 0
        self._next_trim_s = time.monotonic() + TRIM_INTERVAL_S
        self._router = Router(
            config.bind,
            config.max_message_part_bytes,
            1 + MAX_PARTS_PER_VIEW * self._limits.max_views,
            connections=self._connections,
            keys=_checked_keys(config.keys_dir),
        )
        self.endpoint = self._router.endpoint
        self._client_memory = ClientMemory(config, self.endpoint, self._render_of)
        self._session_manager = SessionManager(
            config,
            self.endpoint,
            self._sessions,
            self._devices,
            self._client_memory,
            self._send,
            self._record,
        )
        if config.metrics_port:
            serve_metrics(config.metrics_port, self.metrics)

    def metrics(self) -> dict[str, float]:
        """Return the values of `METRICS`; called from another thread."""
        desks = [device.frames for device in self._devices]
        return {
            "ocufilter_ready": float(self._devices.are_ready),
            "ocufilter_degraded": float(self._is_degraded),
            "ocufilter_connections": len(self._connections),
            "ocufilter_connections_evicted_total": self._connections.n_evicted,
            "ocufilter_sessions": len(self._sessions.present),
            "ocufilter_sessions_away": len(self._sessions.away),
            "ocufilter_frames_filtered_total": sum(d.n_rendered for d in desks),
            "ocufilter_frames_dropped_total": sum(d.n_dropped for d in desks),
            "ocufilter_filter_seconds_total": sum(d.filtered_s for d in desks),
            "ocufilter_messages_unheard_total": self._n_unheard,
            "ocufilter_faults_total": self._n_faults,
            "ocufilter_memory_bytes": MB * self._memory_mb,
            "ocufilter_psfs_bytes": MB * sum(d.stores_mb for d in self._devices),
            "ocufilter_render_silent_seconds": self._devices.silent_s,
        }

    @property
    def _memory_mb(self) -> float:
        return resident_memory_mb() + self._devices.memory_mb

    def _render_of(self, session: Session) -> RenderClient:
        return self._devices.of(session).render

    def _frames_of(self, session: Session) -> FrameQueue:
        return self._devices.of(session).frames

    # Event loop

    def run(self) -> None:
        """Serve until the supervisor sends stop or is gone."""
        try:
            while self._run_once():
                pass
        except LinkClosed:
            log.error("the parent process ended")
        finally:
            self._close()

    def _listen_to_supervisor(self) -> bool:
        """Handle the supervisor's messages; return whether to go on."""
        with self._descriptors.reserve():  # may receive links to new processes
            messages = self._supervisor.receive()
        # A list: every message is handled, whatever the first ones return.
        return all([self.take_control(*message) for message in messages])  # noqa: C419

    def take_control(self, message: tuple[Any, ...], descriptors: list[int]) -> bool:
        """Handle a message of the supervisor; return whether to go on."""
        if message[0] == "link":
            device = self._devices[message[1]]
            device.frames.lose_held()
            device.render.join(Link.from_descriptor(descriptors[0]))
        elif message[0] == "sessions":
            self._session_manager.restore(message[1])
        elif message[0] == "lost":
            self._give_up(self._devices[message[1]])
        elif message[0] == "found":
            self._devices[message[1]].is_lost = False
        elif message[0] == "degraded":
            self._is_degraded = message[1]
        elif message[0] == "config":
            self.config = self._session_manager.config = message[1]
            self._limits = self.config.limits
        return bool(message[0] != "stop")

    def _run_once(self) -> bool:
        """Run one iteration of the event loop; return whether to go on."""
        readable, writable = self._devices.descriptors()
        readable = readable | {self._supervisor.fileno()}
        if self._supervisor.has_unsent:
            writable = writable | {self._supervisor.fileno()}
        self._router.watch(readable, writable)
        self._router.wait(self._wait_s())
        self._supervisor.flush()
        # Before clients, so that replies reflect the supervisor's latest messages.
        if not self._listen_to_supervisor():
            return False
        for device in self._devices:
            self._listen_to(device)
        for number in self._router.take_ended():
            self._session_manager.lose(number)
        self._take_in_messages()
        for device in self._devices:
            device.frames.submit_one()
        self._tidy()
        return True

    def _wait_s(self) -> float:
        now_s = time.monotonic()
        if self._router.is_dropping:
            return 0.0
        soon_s = self._devices.wait_s(now_s)
        if soon_s is not None:
            return soon_s
        due_s = min(self._session_manager.due_s, self._next_trim_s)
        return min(IDLE_WAIT_S, max(0.0, due_s - now_s))

    def _close(self) -> None:
        for session in self._sessions.present:
            with suppress(Exception):
                if session.peer is not None:
                    self._router.send(session.peer, encode(Closing()))
        self._router.close(linger_ms=CLOSING_LINGER_MS)

    def _tidy(self) -> None:
        """Run periodic tasks."""
        now_s = time.monotonic()
        for device in self._devices:
            device.frames.tidy()
        self._session_manager.tidy()
        if now_s >= self._next_trim_s:
            self._next_trim_s = now_s + TRIM_INTERVAL_S
            for device in self._devices:
                if device.frames.is_idle:
                    device.render.trim()
        for device in self._devices:
            self._end_if_stuck(device)

    def _end_if_stuck(self, device: ServedDevice) -> None:
        limit_s = self.config.frame_limit_s
        if device.render.is_up and device.render.stuck_s > limit_s:
            log.error("the render worker has not responded for %g s", limit_s)
            device.render.excuse()
            self._supervisor.send(("hung", device.index))

    # Render workers

    def _listen_to(self, device: ServedDevice) -> None:
        try:
            for kind, *rest in device.render.receive():
                if kind == "answer":
                    device.frames.accept_result(*rest)
                elif kind == "tell":
                    self._pass_on(*rest)
                elif kind == "state":
                    device.memory_mb, device.stores_mb, device.is_building = rest
                elif kind == "here":
                    self._begin_with(device, *rest)
        except LinkClosed:
            device.frames.lose_held()

    def _pass_on(self, key: str, eye: EyeName, reply: Reply) -> None:
        """Pass a reply about a profile to its client; count a refusal."""
        session = self._sessions.by_key(key)
        if session is not None and session.peer is not None:
            if isinstance(reply, ErrorReply) and reply.code != BuildCancelled.code:
                self._connections.note_refusal(session.peer.connection)
        self._session_manager.pass_on(key, eye, reply)

    def _begin_with(
        self,
        device: ServedDevice,
        server: dict[str, str],
        eyes: list[tuple[Any, ...]],
        may_rest: bool,
    ) -> None:
        """Synchronize the sessions with those of a new render worker."""
        device.server, device.render.may_rest = server, may_rest
        self._session_manager.attach_device(device, eyes)
        device.render.is_ready = True
        self._supervisor.send(("met", device.index))
        self._session_manager.greet_waiting()

    def _give_up(self, device: ServedDevice) -> None:
        """End the sessions of a lost device; new ones start on other devices."""
        device.give_up()
        device.frames.lose_held()
        self._session_manager.give_up(device)

    # Messages

    def _take_in_messages(self) -> None:
        """Handle pending messages.

        Superseded frames are answered only afterward.  A client that keeps to its
        credit then never appears to exceed it, however fast it reacts to a reply.
        """
        superseded: list[tuple[Session, Frame]] = []
        for _ in range(MAX_MESSAGES_PER_TURN):
            try:
                received = self._router.receive()
            except Refused as refused:
                self._disconnect(refused)
                continue
            if received is None:
                break
            if not self._is_heard(received):
                continue
            try:
                self._take_in(received, superseded)
            except Exception:  # must not affect other clients
                self._n_faults += 1
                log.exception(
                    "internal error %d: could not send an error reply", self._n_faults
                )
                self._session_manager.end_session(received.peer)
        for session, frame in superseded:
            dropped = Dropped(frame.frame_id, "superseded")
            self._frames_of(session).answer(session, frame, dropped)

    def _is_heard(self, received: Received) -> bool:
        """Return whether to handle a message; close connections that send too many."""
        if received.connection is None:
            # Its client is gone, so only a bye still matters.
            if is_bye(received.parts):
                self._session_manager.end_session(received.peer)
            return False
        verdict = received.connection.rates.verdict(time.monotonic())
        if verdict is Verdict.HANDLE:
            return True
        self._n_unheard += 1
        if verdict is Verdict.CLOSE:
            self._connections.close(received.peer.connection, "too many messages")
        return False

    def _take_in(
        self, received: Received, superseded: list[tuple[Session, Frame]]
    ) -> None:
        received_s = time.monotonic()
        peer, parts = received.peer, received.parts
        try:
            if received.n_left_out:
                is_many = received.n_left_out > MAX_PARTS_LEFT_OUT
                if received.connection is not None and is_many:
                    received.connection.rates.exhaust()
                raise BadMessage(
                    f"{len(parts) + received.n_left_out - 1} parts follow the header",
                    field="parts",
                    allowed=f"at most {len(parts) - 1}",
                )
            request = decode_request(parts, self._limits)
            if isinstance(request, Frame):
                session = self._session_manager.session_at(peer)
                frames = self._frames_of(session)
                older = frames.take_in(session, request, received_s)
                superseded += [(session, older)] if older is not None else []
            else:
                self._note_request(received)
                self._handle(peer, request)
        except Exception as error:
            self._refuse(received, error)

    def _note_request(self, received: Received) -> None:
        if received.connection is not None:
            received.connection.rates.note_request()

    def _refuse(self, received: Received, error: Exception) -> None:
        """Answer a message with an error; the service continues."""
        if received.connection is not None:
            received.connection.rates.note_refusal()
        if not isinstance(error, FilterError):
            self._n_faults += 1
            log.error("a message could not be handled", exc_info=error)
            error = FilterError(f"{type(error).__name__}: {error}")
        frame_id, profile_id = peek_ids(received.parts)
        reply = ErrorReply.from_exception(
            error, frame_id=frame_id, profile_id=profile_id
        )
        self._send(received.peer, reply)

    def _handle(self, peer: Peer, request: Message) -> None:
        if isinstance(request, Ping):
            self._send(peer, self._pong(request))
        elif isinstance(request, Hello):
            self._session_manager.greet(peer, request)
        elif isinstance(request, Bye):
            self._session_manager.end_session(peer)
        elif isinstance(request, ProfileRequest):
            self._session_manager.take_profile(
                self._session_manager.session_at(peer), request
            )
        elif isinstance(request, Share):
            shared = self._client_memory.share(
                self._session_manager.session_at(peer), request
            )
            self._send(peer, shared)
        elif isinstance(request, Unshare):
            self._client_memory.unshare(self._session_manager.session_at(peer), request)

    def _disconnect(self, refused: Refused) -> None:
        """End the session of a client whose key was removed."""
        log.warning("a client's key was removed")
        self._session_manager.end_session(refused.peer)
        error = NotAllowed(str(refused))
        self._send(refused.peer, ErrorReply.from_exception(error))

    def _pong(self, ping: Ping) -> Pong:
        states = self._devices.states()
        return Pong(
            t=ping.t,
            server_time_s=time.monotonic(),
            memory_mb=self._memory_mb,
            n_sessions=len(self._sessions.present),
            n_rendered=sum(state.n_rendered for state in states),
            n_dropped=sum(device.frames.n_dropped for device in self._devices),
            is_building=any(state.is_building for state in states),
            is_ready=self._devices.are_ready,
            is_degraded=self._is_degraded,
            n_connections=len(self._connections),
            is_filtering=any(state.is_filtering for state in states),
            render_silent_s=self._devices.silent_s,
            devices=states,
        )

    def _record(self, key: str, record: SessionRecord | None) -> None:
        """Store a session with the supervisor, for the front end after a restart."""
        with suppress(LinkClosed):  # this process then ends
            self._supervisor.send(("session", key, record))

    def _send(self, peer: Peer, reply: Reply) -> Tracker | None:
        """Send a reply; end session and connection of a client that does not read."""
        outcome, tracker = self._router.send(peer, encode(reply))
        if outcome is Outcome.GONE:
            self._session_manager.leave(peer)
        elif outcome is Outcome.STALLED:
            # Every further reply would block, too.
            self._connections.close(peer.connection, "it does not read")
            self._session_manager.end_session(peer, outcome)
        return tracker


def _checked_keys(folder: str) -> KeyRing | None:
    """Return the keys of a folder; None without a folder.

    Raises
    ------
    OSError
        If the folder is not usable.
    """
    if not folder:
        return None
    keys = KeyRing(folder)
    try:
        keys.check()
    except ValueError as error:
        raise OSError(f"keys_dir: {error}") from None
    return keys
