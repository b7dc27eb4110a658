"""The front end: the process that owns the socket, the sessions and their credit.

It validates every message, and forwards frames and profiles to the render worker of the
session's device.  A worker filters one frame at a time, or a small one during a large
one; the front end submits the newest frame of each client, scheduled by the time that
clients have used.  Images are in shared memory.  The front end renders nothing, so it
responds while a frame is rendered, however long that takes.
"""

from __future__ import annotations

import logging
import pickle
import resource
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import estimator.bounded_files  # noqa: F401  (later, no descriptor may be free to read it)
from filter_service.errors import (
    BadMessage,
    BuildCancelled,
    FilterError,
    NotAllowed,
)
from filter_service.heap import resident_memory_mb, trim_heap
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
    ShareTexture,
    Unshare,
    UnshareTexture,
    decode_request,
    encode,
    is_bye,
    peek_ids,
)
from filter_service.service.client_memory import (
    MAX_PARTS_PER_VIEW,
    ClientMemory,
    ClientTextures,
    TextureSocket,
)
from filter_service.service.config import ServiceConfig
from filter_service.service.connections import (
    Connections,
    DescriptorLimit,
    Peer,
    Verdict,
    socket_family,
)
from filter_service.service.frame_queue import FrameQueue
from filter_service.service.metrics import MetricsUnavailable, serve_metrics
from filter_service.service.process_channel import (
    Link,
    LinkClosed,
    start_process,
)
from filter_service.service.render_client import RenderClient
from filter_service.service.router import (
    KeyRemoved,
    Outcome,
    Received,
    Router,
    Tracker,
)
from filter_service.service.served_devices import ServedDevice, ServedDevices
from filter_service.service.session import Session, SessionRecord, SessionTable
from filter_service.service.session_manager import SessionManager
from filter_service.texture_view import TextureSupport
from filter_service.wire.message import Message

MAX_MESSAGES_PER_TURN = 64  # a flooding client must not delay the others
MAX_ACCIDENTAL_PARTS = 1000  # a client that sends more surplus parts is hostile
IDLE_WAIT_S = 1.0
TRIM_INTERVAL_S = 10.0
CLOSING_LINGER_MS = 200
UNREAD_SHARE = 0.125
"""Share of the front end's memory for large messages of clients without a session: by
default 250 MB, two frames of 4096x4096."""

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
            max_unread_bytes=int(UNREAD_SHARE * config.max_socket_mb * MB),
        )
        self._n_ignored = 0
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
            keys=_load_keys(config.keys_dir),
        )
        self.endpoint = self._router.endpoint
        self._client_memory = ClientMemory(
            config, self.endpoint, self._render_client_of
        )
        is_local = self._client_memory.is_offered
        self._texture_socket = (
            TextureSocket(self._descriptors.reserve) if is_local else None
        )
        self._client_textures = ClientTextures(
            self._texture_socket, self._sessions, self._devices, self._send
        )
        self._session_manager = SessionManager(
            config,
            self.endpoint,
            self._sessions,
            self._devices,
            self._client_memory,
            self._client_textures,
            self._send,
            self._record,
        )
        if config.metrics_port:
            serve_metrics(config.metrics_port, self.metrics)

    def metrics(self) -> dict[str, float]:
        """Return the values of `METRICS`; called from another thread."""
        queues = [device.frames for device in self._devices]
        memory = [device.memory for device in self._devices]
        return {
            "ocufilter_ready": float(self._devices.are_ready),
            "ocufilter_degraded": float(self._is_degraded),
            "ocufilter_connections": len(self._connections),
            "ocufilter_connections_evicted_total": self._connections.n_evicted,
            "ocufilter_sessions": len(self._sessions.connected),
            "ocufilter_sessions_away": len(self._sessions.disconnected),
            "ocufilter_frames_filtered_total": sum(d.n_rendered for d in queues),
            "ocufilter_frames_dropped_total": sum(d.n_dropped for d in queues),
            "ocufilter_filter_seconds_total": sum(d.filtered_s for d in queues),
            "ocufilter_messages_unheard_total": self._n_ignored,
            "ocufilter_faults_total": self._n_faults,
            "ocufilter_memory_bytes": MB * self._memory_mb,
            "ocufilter_psfs_bytes": MB * sum(m.stores_mb for m in memory),
            "ocufilter_psf_tables_bytes": MB * sum(m.tables_mb for m in memory),
            "ocufilter_frame_buffers_bytes": MB * sum(m.buffers_mb for m in memory),
            "ocufilter_render_silent_seconds": self._devices.silent_s,
        }

    @property
    def _memory_mb(self) -> float:
        return resident_memory_mb() + self._devices.memory_mb

    def _render_client_of(self, session: Session) -> RenderClient:
        return self._devices.device_of(session).render

    def _frames_of(self, session: Session) -> FrameQueue:
        return self._devices.device_of(session).frames

    # Event loop

    def run(self, received: Iterable[tuple[Any, list[int]]] = ()) -> None:
        """Serve until the supervisor sends stop or exits.

        Parameters
        ----------
        received : iterable of (message, descriptors)
            Messages of the supervisor that arrived during the start.
        """
        try:
            is_running = self._handle_all(received)
            while is_running:
                is_running = self._run_once()
        except LinkClosed:
            log.error("the supervisor exited")
        finally:
            self._close()

    def _receive_from_supervisor(self) -> bool:
        """Handle the supervisor's messages; return whether to continue."""
        with self._descriptors.reserve():  # for links to new processes
            messages = self._supervisor.receive()
        return self._handle_all(messages)

    def _handle_all(self, messages: Iterable[tuple[Any, list[int]]]) -> bool:
        # A list: every message is handled, whatever the first ones return.
        return all([self.handle_control(*message) for message in messages])  # noqa: C419

    def handle_control(self, message: tuple[Any, ...], descriptors: list[int]) -> bool:
        """Handle a message of the supervisor; return whether to continue."""
        if message[0] == "link":
            device = self._devices[message[1]]
            self._fail_work(device)
            device.render.connect(Link.from_descriptor(descriptors[0]))
        elif message[0] == "sessions":
            self._session_manager.restore([pickle.loads(r) for r in message[1]])
        elif message[0] == "lost":
            self._give_up_device(self._devices[message[1]])
        elif message[0] == "recovered":
            self._devices[message[1]].is_lost = False
        elif message[0] == "degraded":
            self._is_degraded = message[1]
        elif message[0] == "config":
            self.config = self._session_manager.config = message[1]
            self._limits = self.config.limits
        return bool(message[0] != "stop")

    def _run_once(self) -> bool:
        """Run one iteration of the event loop; return whether to continue."""
        watched = self._devices.descriptors()
        watched[self._supervisor.fileno()] = self._supervisor.has_unsent
        if self._texture_socket is not None:
            watched[self._texture_socket.fileno()] = False
        self._router.watch(watched)
        found = self._router.wait(self._wait_s())
        # Before clients, so that replies reflect the supervisor's latest messages.
        if self._supervisor.fileno() in found:
            self._supervisor.flush()
            if not self._receive_from_supervisor():
                return False
        for device in self._devices:
            if device.render.fileno() in found:
                self._receive_from(device)
        for number in self._router.pop_ended():
            self._session_manager.disconnect(number)
        self._handle_messages()
        if self._texture_socket is not None and self._texture_socket.fileno() in found:
            self._client_textures.receive(self._limits)
        for device in self._devices:
            device.frames.submit_next()
        self._run_periodic_tasks()
        return True

    def _wait_s(self) -> float:
        now_s = time.monotonic()
        if self._router.is_dropping:
            return 0.0
        wait_s = self._devices.wait_s(now_s)
        if wait_s is not None:
            return wait_s
        due_s = min(
            *(self._session_manager.due_s, self._next_trim_s, self._connections.due_s)
        )
        return min(IDLE_WAIT_S, max(0.0, due_s - now_s))

    def _close(self) -> None:
        for session in self._sessions.connected:
            with suppress(Exception):
                if session.peer is not None:
                    self._router.send(session.peer, encode(Closing()))
        self._router.close(linger_ms=CLOSING_LINGER_MS)
        self._client_textures.close()

    def _run_periodic_tasks(self) -> None:
        """Run periodic tasks."""
        now_s = time.monotonic()
        self._connections.check_unread(now_s)
        for device in self._devices:
            device.frames.reclaim_sent()
        self._session_manager.run_periodic_tasks()
        if now_s >= self._next_trim_s:
            self._next_trim_s = now_s + TRIM_INTERVAL_S
            for device in self._devices:
                if device.frames.is_idle:
                    device.render.trim()
            if all(device.frames.is_idle for device in self._devices):
                trim_heap()  # of messages with images
        for device in self._devices:
            self._report_if_hung(device)

    def _report_if_hung(self, device: ServedDevice) -> None:
        limit_s = self.config.frame_limit_s
        if device.render.is_up and device.render.unresponsive_s > limit_s:
            log.error(
                "the render worker has not responded for %g s; restarting it", limit_s
            )
            device.render.restart_timeout()
            self._supervisor.send(("hung", device.index))

    # Render workers

    def _receive_from(self, device: ServedDevice) -> None:
        try:
            for kind, *rest in device.render.receive():
                if kind == "frame_reply":
                    device.frames.accept_result(*rest)
                elif kind == "profile_reply":
                    self._forward_reply(*rest)
                elif kind == "profile_used":
                    self._session_manager.charge_profile(*rest)
                elif kind == "state":
                    device.memory, device.is_building = rest
                elif kind == "texture_reply":
                    self._client_textures.accept_import(*rest)
                elif kind == "started":
                    self._attach_worker(device, *rest)
        except LinkClosed:
            self._fail_work(device)

    def _fail_work(self, device: ServedDevice) -> None:
        """Report to clients the frames and profiles lost with a render worker."""
        device.frames.fail_in_flight()
        self._client_textures.report_lost(device)

    def _forward_reply(self, key: str, eye: EyeName, reply: Reply) -> None:
        """Forward a worker's reply about a profile; count it if it is a refusal."""
        session = self._sessions.by_key(key)
        if session is not None and session.peer is not None:
            if isinstance(reply, ErrorReply) and reply.code != BuildCancelled.code:
                self._connections.count_refusal(session.peer.connection)
        self._session_manager.forward_reply(key, eye, reply)

    def _attach_worker(
        self,
        device: ServedDevice,
        server: dict[str, str],
        eyes: list[tuple[Any, ...]],
        can_interrupt: bool,
        texture_support: TextureSupport | None,
    ) -> None:
        """Synchronize the sessions with a new render worker."""
        device.texture_support = texture_support
        device.server, device.render.can_interrupt = server, can_interrupt
        self._session_manager.attach_device(device, eyes)
        device.render.is_ready = True
        self._supervisor.send(("connected", device.index))
        self._session_manager.answer_pending_hellos()

    def _give_up_device(self, device: ServedDevice) -> None:
        """Take a device out of service and end its sessions."""
        device.mark_lost()
        device.frames.fail_in_flight()
        self._session_manager.end_sessions_on(device)

    # Messages

    def _handle_messages(self) -> None:
        """Handle pending messages.

        Replies to superseded frames follow at the end.  A client within its credit then
        never appears to exceed it, however fast it reacts to a reply.
        """
        superseded: list[tuple[Session, Frame]] = []
        for _ in range(MAX_MESSAGES_PER_TURN):
            try:
                received = self._router.receive()
            except KeyRemoved as error:
                self._reject_removed_key(error)
                continue
            if received is None:
                break
            if not self._passes_rate_limit(received):
                continue
            try:
                self._handle_message(received, superseded)
            except Exception:  # must not affect other clients
                self._n_faults += 1
                log.exception(
                    "internal error %d: could not send an error reply", self._n_faults
                )
                self._session_manager.end_session(received.peer)
        for session, frame in superseded:
            dropped = Dropped(frame.frame_id, "superseded")
            self._frames_of(session).reply(session, frame, dropped)

    def _passes_rate_limit(self, received: Received) -> bool:
        """Return whether to handle a message; close connections that send too many."""
        if received.connection is None:
            # Its client has disconnected, so only bye still matters.
            if is_bye(received.parts):
                self._session_manager.end_session(received.peer)
            return False
        verdict = received.connection.rates.verdict(time.monotonic())
        if verdict is Verdict.HANDLE:
            return True
        self._n_ignored += 1
        if verdict is Verdict.CLOSE:
            self._connections.close(received.peer.connection, "too many messages")
        return False

    def _handle_message(
        self, received: Received, superseded: list[tuple[Session, Frame]]
    ) -> None:
        received_s = time.monotonic()
        peer, parts = received.peer, received.parts
        try:
            if received.n_dropped_parts:
                is_many = received.n_dropped_parts > MAX_ACCIDENTAL_PARTS
                if received.connection is not None and is_many:
                    received.connection.rates.exhaust()
                    self._connections.distrust(received.connection, received_s)
                n_parts = len(parts) - 1 + received.n_dropped_parts
                raise BadMessage(
                    f"{n_parts} parts follow the header",
                    field="parts",
                    allowed=f"at most {len(parts) - 1}",
                )
            # A render worker unpacks profiles, the newest one of each eye only.
            request = decode_request(parts, self._limits, unpacks_profiles=False)
            if isinstance(request, Frame):
                session = self._session_manager.session_of(peer)
                frames = self._frames_of(session)
                older = frames.enqueue(session, request, bytes(parts[0]), received_s)
                superseded += [(session, older)] if older is not None else []
            else:
                self._count_request(received)
                self._dispatch(peer, request)
        except Exception as error:
            self._reply_with_error(received, error)

    def _count_request(self, received: Received) -> None:
        if received.connection is not None:
            received.connection.rates.count_request()

    def _reply_with_error(self, received: Received, error: Exception) -> None:
        """Reply to an invalid message with an error."""
        if received.connection is not None:
            received.connection.rates.count_refusal()
        if not isinstance(error, FilterError):
            self._n_faults += 1
            log.error("a message could not be handled", exc_info=error)
            error = FilterError(f"{type(error).__name__}: {error}")
        frame_id, profile_id = peek_ids(received.parts)
        reply = ErrorReply.from_exception(
            error, frame_id=frame_id, profile_id=profile_id
        )
        self._send(received.peer, reply)

    def _dispatch(self, peer: Peer, request: Message) -> None:
        if isinstance(request, Ping):
            self._send(peer, self._pong(request))
        elif isinstance(request, Hello):
            self._session_manager.answer_hello(peer, request)
        elif isinstance(request, Bye):
            self._session_manager.end_session(peer)
        elif isinstance(request, ProfileRequest):
            self._session_manager.request_profile(
                self._session_manager.session_of(peer), request
            )
        elif isinstance(request, Share):
            shared = self._client_memory.share(
                self._session_manager.session_of(peer), request
            )
            self._send(peer, shared)
        elif isinstance(request, Unshare):
            self._client_memory.unshare(self._session_manager.session_of(peer), request)
        elif isinstance(request, UnshareTexture):
            self._client_textures.unshare(
                self._session_manager.session_of(peer), request
            )
        elif isinstance(request, ShareTexture):
            raise BadMessage(
                "it came without a descriptor",
                field="type",
                allowed="share_texture over the socket of welcome.textures",
            )

    def _reject_removed_key(self, removed: KeyRemoved) -> None:
        """End the session of a client whose key was removed."""
        log.warning("a client's key was removed")
        self._session_manager.end_session(removed.peer)
        error = NotAllowed(str(removed))
        self._send(removed.peer, ErrorReply.from_exception(error))

    def _pong(self, ping: Ping) -> Pong:
        states = self._devices.states()
        return Pong(
            t=ping.t,
            server_time_s=time.monotonic(),
            memory_mb=self._memory_mb,
            n_sessions=len(self._sessions.connected),
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
        """Store a session with the supervisor, for the front end after a restart.

        The supervisor gets bytes: reading them would load NumPy and libzmq there.
        """
        stored = None if record is None else pickle.dumps(record)
        with suppress(LinkClosed):  # this process then ends
            self._supervisor.send(("session", key, stored))

    def _send(self, peer: Peer, reply: Reply | list[Any]) -> Tracker | None:
        """Send a reply or its parts; disconnect a client that does not read replies."""
        parts = reply if isinstance(reply, list) else encode(reply)
        outcome, tracker = self._router.send(peer, parts)
        if outcome is Outcome.GONE:
            self._session_manager.disconnect(peer.connection)
        elif outcome is Outcome.STALLED:
            # Further replies would not fit either.
            self._connections.close(peer.connection, "it does not read replies")
            self._session_manager.end_session(peer, outcome)
        return tracker


def _load_keys(folder: str) -> KeyRing | None:
    """Return the keys in a folder; None without a folder.

    Raises
    ------
    OSError
        If the folder or one of its keys is unusable.
    """
    if not folder:
        return None
    keys = KeyRing(folder)
    try:
        keys.check()
    except ValueError as error:
        raise OSError(f"keys_dir: {error}") from None
    return keys


def main() -> None:
    """Serve clients until the supervisor sends stop."""
    supervisor, config, others = start_process("front-end")
    # libzmq does not report the size of incomplete messages.  Beyond the limit it
    # aborts the process, which frees the memory; sessions survive.
    limit = config.max_socket_mb * MB
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    except (OSError, ValueError) as error:
        log.warning("max_socket_mb has no effect on this system: %s", error)
    try:
        front_end = FrontEnd(config, supervisor)
    except (OSError, MetricsUnavailable) as error:
        supervisor.send(("failed", str(error)))
        raise SystemExit(1) from None
    supervisor.send(("ready", front_end.endpoint))
    front_end.run(others)


if __name__ == "__main__":
    main()
