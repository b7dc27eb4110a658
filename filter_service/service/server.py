"""The service: one loop that owns the socket and the GL context.

Each turn: wait, take in all messages (control at once; of frames the newest of each
client), filter at most one frame (clients take turns), look at the worker.  PROTOCOL.md
says what the messages mean.
"""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.errors import FilterError, NoSession, TooManySessions
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.filtered import BuildingEye, EyeEvent, EyeReady
from filter_service.filtering.workshop import Workshop
from filter_service.messages import (
    Accepted,
    Alive,
    Bye,
    Dropped,
    ErrorReply,
    Frame,
    Hello,
    Part,
    Ping,
    Pong,
    ProfileRequest,
    Progress,
    Ready,
    Reply,
    Result,
    Welcome,
    decode_request,
    encode,
    peek_ids,
)
from filter_service.service.config import ServiceConfig
from filter_service.service.frame_reply import frame_reply
from filter_service.service.mailbox import Mailbox, Outcome
from filter_service.service.process_info import package_version, resident_memory_mb
from filter_service.service.session import Session, WaitingFrame
from filter_service.wire.message import Message

MAX_MESSAGES_PER_TURN = 64  # a client that floods must not keep the loop from rendering
MAX_UNSENT_RESULTS = 4  # large replies a client has not taken; bounds memory
MARK_SENT_S = 0.03  # less than most frames take to filter
IDLE_WAIT_S = 1.0
ATTENTION_WAIT_S = 0.1

log = logging.getLogger("ocufilter")


class FilterServer:
    """Sessions, frames and builds behind one ROUTER socket.

    Parameters
    ----------
    config : ServiceConfig
    workshop : Workshop
        Where all sessions' eyes are made; the server closes it.
    read_profile : callable
        ``read_profile(body)`` gives what the workshop takes, or raises a FilterError.
    """

    def __init__(
        self,
        config: ServiceConfig,
        *,
        workshop: Workshop,
        read_profile: Callable[[dict[str, Any]], EyeProfile],
    ) -> None:
        self.config = config
        self._limits = config.limits
        self._workshop = workshop
        self._read_profile = read_profile
        self._sessions: dict[bytes, Session] = {}
        self._next_session_id = 1
        self._n_rendered = 0
        self._n_dropped = 0
        self._next_alive_s = time.monotonic() + config.alive_interval_s
        self._is_stopping = False
        self._mailbox = Mailbox(config.bind, config.max_message_part_bytes)
        self.endpoint = self._mailbox.endpoint
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_writer.setblocking(False)
        self._wake_reader.setblocking(False)

    # The loop

    def run(self) -> None:
        """Serve until `stop`; everything is closed at the end."""
        try:
            self._workshop.worker.start()
            while not self._is_stopping:
                self._turn()
        finally:
            self._close()

    def stop(self) -> None:
        """Let `run` return; may be called from a signal handler or another thread."""
        self._is_stopping = True
        try:
            self._wake_writer.send(b"\0")
        except OSError:
            pass  # the loop has ended, or is being woken already

    @property
    def wake_file_descriptor(self) -> int:
        """Return where a byte written ends the wait of the loop."""
        return self._wake_writer.fileno()

    def _turn(self) -> None:
        watched = {self._wake_reader.fileno()}
        if self._workshop.worker.file_descriptor is not None:
            watched.add(self._workshop.worker.file_descriptor)
        self._mailbox.watch(watched)
        self._mailbox.wait(self._wait_s())
        self._take_in_messages()
        self._filter_one_frame()
        self._workshop.advance()
        self._probe_clients()

    def _wait_s(self) -> float:
        if self._workshop.is_loading:
            return 0.0
        if any(session.waiting for session in self._sessions.values()):
            return 0.0
        if self._workshop.worker.needs_attention_soon:
            return ATTENTION_WAIT_S
        return min(IDLE_WAIT_S, max(0.0, self._next_alive_s - time.monotonic()))

    def _close(self) -> None:
        for identity in list(self._sessions):
            self._end_session(identity)
        self._workshop.close()
        self._mailbox.close()
        self._wake_reader.close()
        self._wake_writer.close()

    # Messages

    def _take_in_messages(self) -> None:
        """Handle what waits.

        Answers to frames are sent only afterwards: a client that keeps to its credit
        then never seems to exceed it, however fast it reacts to an answer.
        """
        answers: list[tuple[Session, Dropped | ErrorReply]] = []
        for _ in range(MAX_MESSAGES_PER_TURN):
            received = self._mailbox.receive()
            if received is None:
                break
            identity, parts = received
            received_s = time.monotonic()
            try:
                request = decode_request(parts, self._limits)
                self._handle(identity, request, received_s, answers)
            except Exception as error:
                self._refuse(identity, parts, error)
        for session, answer in answers:
            self._answer_frame(session, answer)

    def _refuse(self, identity: bytes, parts: Sequence[Part], error: Exception) -> None:
        """Tell a client what is wrong with its message; the service lives on."""
        if not isinstance(error, FilterError):
            log.error("a message could not be handled", exc_info=error)
            error = FilterError(f"{type(error).__name__}: {error}")
        frame_id, profile_id = peek_ids(parts)
        reply = ErrorReply.from_exception(
            error, frame_id=frame_id, profile_id=profile_id
        )
        self._send(identity, reply)

    def _handle(
        self,
        identity: bytes,
        request: Message,
        received_s: float,
        answers: list[tuple[Session, Dropped | ErrorReply]],
    ) -> None:
        if isinstance(request, Ping):
            self._send(identity, self._pong(request))
        elif isinstance(request, Hello):
            self._greet(identity, request)
        elif isinstance(request, Bye):
            self._end_session(identity)
        elif identity not in self._sessions:
            raise NoSession("hello was not said", allowed="hello before anything else")
        elif isinstance(request, ProfileRequest):
            self._take_profile(self._sessions[identity], request)
        elif isinstance(request, Frame):
            session = self._sessions[identity]
            waiting = WaitingFrame(request, received_s, time.monotonic())
            superseded = session.take_in(waiting)
            if superseded is not None:
                reply = Dropped(superseded.frame.frame_id, "superseded")
                answers.append((session, reply))

    def _greet(self, identity: bytes, hello: Hello) -> None:
        session = self._sessions.get(identity)
        if session is None:
            if len(self._sessions) >= self.config.max_sessions:
                self._probe_clients(is_due=True)
            if len(self._sessions) >= self.config.max_sessions:
                raise TooManySessions(
                    f"{len(self._sessions)} clients are being served",
                    allowed=f"{self.config.max_sessions} clients",
                )
            session = Session(
                session_id=self._next_session_id,
                identity=identity,
                client=hello.client,
                credit=self.config.credit,
                eye_filter=EyeFilter(
                    workshop=self._workshop,
                    max_cameras=self.config.max_cameras,
                    on_event=partial(self._tell, identity),
                ),
            )
            self._next_session_id += 1
            self._sessions[identity] = session
            log.info("session %d begins (%r)", session.session_id, hello.client)
        server = {
            "name": "ocufilter",
            "version": package_version(),
            "engine": self._workshop.engine_name,
            "renderer": self._workshop.engine.name,
            "gl_renderer": self._workshop.engine.name,  # what it was called before
        }
        transport = self.endpoint.split("://", 1)[0]
        self._send(
            identity,
            Welcome(
                session.session_id, server, self._limits, session.credit, (transport,)
            ),
        )

    def _take_profile(self, session: Session, request: ProfileRequest) -> None:
        """Accept a profile; what becomes of it is told as events."""
        eye = session.eye_filter.set_profile(
            self._read_profile(request.body),
            settings=request.settings,
            cameras=request.views,
            profile_id=request.profile_id,
        )
        accepted = Accepted(
            request.profile_id,
            eye.generation,
            is_building=bool(eye.wanted),
            n_cameras=len(eye.wanted),
        )
        self._send(session.identity, accepted)

    def _tell(self, identity: bytes, event: EyeEvent) -> None:
        """Tell a client what happens to its profile."""
        profile_id, generation = event.eye.profile_id, event.eye.generation
        reply: Reply
        if isinstance(event, BuildingEye):
            reply = Progress(profile_id, generation, event.stage, event.fraction)
        elif isinstance(event, EyeReady):
            reply = Ready(
                profile_id,
                generation,
                build_ms=event.build_ms,
                psf_count=event.psf_count,
                memory_mb=event.memory_mb,
                pixel_pitch_mrad=event.camera.pixel_pitch_mrad,
                notes=event.notes,
                is_complete=event.is_complete,
            )
        else:
            reply = ErrorReply.from_exception(event.error, profile_id=profile_id)
        self._send(identity, reply)

    def _pong(self, ping: Ping) -> Pong:
        return Pong(
            t=ping.t,
            server_time_s=time.monotonic(),
            memory_mb=resident_memory_mb(),
            n_sessions=len(self._sessions),
            n_rendered=self._n_rendered,
            n_dropped=self._n_dropped,
            is_building=self._workshop.worker.is_busy,
        )

    def _send(self, identity: bytes, reply: Reply) -> None:
        """Send a reply; a client that is gone or does not read loses its session."""
        outcome, tracker = self._mailbox.send(identity, encode(reply))
        if outcome is not Outcome.SENT:
            self._end_session(identity, outcome)
        elif tracker is not None and identity in self._sessions:
            self._sessions[identity].unsent.append(tracker)

    def _probe_clients(self, *, is_due: bool = False) -> None:
        """Send every client a sign of life; who is gone is found out by that."""
        now_s = time.monotonic()
        if is_due or now_s >= self._next_alive_s:
            self._next_alive_s = now_s + self.config.alive_interval_s
            for identity in list(self._sessions):
                self._send(identity, Alive())

    def _end_session(self, identity: bytes, outcome: Outcome | None = None) -> None:
        session = self._sessions.pop(identity, None)
        if session is None:
            return
        session.eye_filter.close()
        why = "" if outcome is None else f": the client is {outcome.value}"
        log.info("session %d ends%s", session.session_id, why)

    # Frames

    def _answer_frame(
        self, session: Session, answer: Result | Dropped | ErrorReply
    ) -> None:
        """Answer a frame that counts against the credit."""
        session.n_unanswered -= 1
        if isinstance(answer, Result):
            self._n_rendered += 1
        else:
            self._n_dropped += 1
        self._send(session.identity, answer)

    def _filter_one_frame(self) -> None:
        """Filter the frame of the client that has been served least recently."""
        session = next((s for s in self._sessions.values() if s.waiting), None)
        if session is None or session.waiting is None:
            return
        self._sessions[session.identity] = self._sessions.pop(session.identity)
        waiting, session.waiting = session.waiting, None
        frame_id = waiting.frame.frame_id
        if self._is_slow_consumer(session):
            self._answer_frame(session, Dropped(frame_id, "slow_consumer"))
            return
        self._answer_frame(session, frame_reply(session.eye_filter, waiting))

    def _is_slow_consumer(self, session: Session) -> bool:
        """Return whether a client has left too many large replies with the service.

        A thread of pyzmq's marks them as sent, and it waits for the interpreter lock,
        which OpenGL calls hold; so it gets a moment before a client is accused.
        """
        session.unsent = [tracker for tracker in session.unsent if not tracker.done]
        end_s = time.monotonic() + MARK_SENT_S
        while len(session.unsent) >= MAX_UNSENT_RESULTS and time.monotonic() < end_s:
            time.sleep(0.001)
            session.unsent = [item for item in session.unsent if not item.done]
        return len(session.unsent) >= MAX_UNSENT_RESULTS
