"""The door: the process that owns the socket, the sessions and their credit.

It checks every message, answers what it can by itself, and hands frames and profiles
to the render loop over a link, one at a time, or a small one beside a large one: the
newest frame of each client, clients by time used.  Images go through shared memory.  It
renders nothing, so that it answers while a frame is rendered, however long that takes.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from filter_service.errors import (
    BadMessage,
    BuildCancelled,
    FilterError,
    NoSession,
    NotAllowed,
    TooManySessions,
)
from filter_service.keys import KeyRing
from filter_service.messages import (
    Accepted,
    Alive,
    Bye,
    Closing,
    Dropped,
    ErrorReply,
    EyeName,
    Frame,
    Hello,
    Part,
    Ping,
    Pong,
    ProfileRequest,
    Reply,
    Share,
    Unshare,
    Welcome,
    decode_request,
    encode,
    peek_ids,
)
from filter_service.service.config import ServiceConfig
from filter_service.service.frame_desk import FrameDesk
from filter_service.service.guests import Guests
from filter_service.service.link import Link, LinkClosed
from filter_service.service.mailbox import Mailbox, Outcome, Refused, Tracker
from filter_service.service.metrics import serve_metrics
from filter_service.service.patience import Patience
from filter_service.service.process_info import resident_memory_mb
from filter_service.service.render_end import RenderEnd
from filter_service.service.session import EyeProfiles, Session
from filter_service.service.sharing import MAX_PARTS_PER_VIEW, Sharing
from filter_service.wire.message import Message

MAX_MESSAGES_PER_TURN = 64  # a client that floods must not keep others waiting
IDLE_WAIT_S = 1.0
TRIM_INTERVAL_S = 10.0
CLOSING_LINGER_MS = 200
MB = 10**6
log = logging.getLogger("ocufilter")


class Door:
    """Sessions behind one ROUTER socket.

    Parameters
    ----------
    config : ServiceConfig
    keeper : Link
        To the process that started this one.
    """

    def __init__(self, config: ServiceConfig, keeper: Link) -> None:
        self.config = config
        self._limits = config.limits
        self._keeper = keeper
        self._render = RenderEnd(config.max_image_mb * MB)
        self._render_mb = self._stores_mb = 0.0
        self._is_building = False
        self._server: dict[str, str] | None = None
        self._greetings: list[tuple[bytes, Hello]] = []  # until the renderer is known
        self._guests = Guests()
        self._patience = Patience()
        self._frames = FrameDesk(self._guests, self._render, self._send)
        self._n_faults = 0
        now_s = time.monotonic()
        self._next_alive_s = now_s + config.alive_interval_s
        self._next_trim_s = now_s + TRIM_INTERVAL_S
        self._mailbox = Mailbox(
            config.bind,
            config.max_message_part_bytes,
            1 + MAX_PARTS_PER_VIEW * self._limits.max_views,
            keys=KeyRing(config.keys_dir) if config.keys_dir else None,
        )
        self.endpoint = self._mailbox.endpoint
        self._sharing = Sharing(config, self.endpoint, self._render)
        if config.metrics_port:
            serve_metrics(config.metrics_port, self.metrics)

    def metrics(self) -> dict[str, float]:
        """Return the values of `METRICS`; another thread asks."""
        return {
            "ocufilter_ready": float(self._render.is_ready),
            "ocufilter_sessions": len(self._guests.present),
            "ocufilter_sessions_away": len(self._guests.away),
            "ocufilter_frames_filtered_total": self._frames.n_rendered,
            "ocufilter_frames_dropped_total": self._frames.n_dropped,
            "ocufilter_filter_seconds_total": self._frames.filtered_s,
            "ocufilter_messages_unheard_total": self._patience.n_unheard,
            "ocufilter_faults_total": self._n_faults,
            "ocufilter_memory_bytes": MB * (resident_memory_mb() + self._render_mb),
            "ocufilter_psfs_bytes": MB * self._stores_mb,
            "ocufilter_render_silent_seconds": self._render.silent_s,
        }

    # The loop

    def run(self) -> None:
        """Serve until the keeper says so, or is gone."""
        try:
            while all([self.take_control(*said) for said in self._keeper.receive()]):
                self._turn()
        except LinkClosed:
            log.error("the process that owns this one is gone")
        finally:
            self._close()

    def take_control(self, message: tuple[Any, ...], descriptors: list[int]) -> bool:
        """Do what the keeper says; return whether to go on."""
        if message[0] == "link":
            self._frames.lose_held()
            self._render.join(Link.from_descriptor(descriptors[0]))
        elif message[0] == "config":
            self.config = message[1]
            self._limits = self.config.limits
        return bool(message[0] != "stop")

    def _turn(self) -> None:
        readable, writable = self._render.descriptors()
        readable = readable | {self._keeper.fileno()}
        if self._keeper.has_unsent:
            writable = writable | {self._keeper.fileno()}
        self._mailbox.watch(readable, writable)
        self._mailbox.wait(self._wait_s())
        self._keeper.flush()
        self._listen_to_render()
        self._take_in_messages()
        self._frames.hand_over_one()
        self._tidy()

    def _wait_s(self) -> float:
        now_s = time.monotonic()
        soon_s = self._frames.wait_s(now_s)
        if soon_s is not None:
            return soon_s
        due_s = min(self._next_alive_s, self._next_trim_s)
        return min(IDLE_WAIT_S, max(0.0, due_s - now_s))

    def _close(self) -> None:
        for session in self._guests.present:
            with suppress(Exception):
                self._mailbox.send(session.identity or b"", encode(Closing()))
        self._mailbox.close(linger_ms=CLOSING_LINGER_MS)

    def _tidy(self) -> None:
        """Do what is due now and then."""
        now_s = time.monotonic()
        self._frames.tidy()
        self._probe_clients()
        for session in self._guests.away:
            if now_s - (session.away_since_s or 0.0) > self.config.session_keep_s:
                self._forget(session, "its client did not come back")
        if now_s >= self._next_trim_s:
            self._next_trim_s = now_s + TRIM_INTERVAL_S
            if self._frames.is_idle:
                self._render.trim()
        if self._render.is_up and self._render.stuck_s > self.config.frame_limit_s:
            limit_s = self.config.frame_limit_s
            log.error("the process that filters frames is stuck for %g s", limit_s)
            self._render.excuse()
            self._keeper.send(("hung",))

    # The render loop

    def _listen_to_render(self) -> None:
        try:
            for kind, *rest in self._render.receive():
                if kind == "answer":
                    self._frames.take_answer(*rest)
                elif kind == "tell":
                    self._pass_on(*rest)
                elif kind == "state":
                    self._render_mb, self._stores_mb, self._is_building = rest
                elif kind == "here":
                    self._begin_with(*rest)
        except LinkClosed:
            self._frames.lose_held()

    def _begin_with(
        self, server: dict[str, str], eyes: list[tuple[Any, ...]], may_rest: bool
    ) -> None:
        """Learn which eyes there are; bring both sides to the same sessions."""
        self._server, self._render.may_rest = server, may_rest
        known, held = {s.key for s in self._guests}, {key for key, *_ in eyes}
        for session in self._guests:
            if session.key not in held:
                self._open(session)
        for key, session_id, profiles in eyes:
            if key not in known:  # a door before this one knew its client
                session = Session(session_id, None, "", self.config.credit, key=key)
                for name, (profile_id, generation) in profiles.items():
                    eye = session.eye(name)
                    eye.profile_id, eye.generation = profile_id, generation
                session.leave(time.monotonic())
                self._guests.remember(session)
        self._render.is_ready = True
        for identity, hello in self._greetings:
            try:
                self._greet(identity, hello)
            except FilterError as error:
                self._send(identity, ErrorReply.from_exception(error))
        self._greetings = []

    def _open(self, session: Session) -> None:
        """Have the render loop hold the eyes of a session, with their profiles."""
        generations = {name: eye.generation for name, eye in session.eyes.items()}
        self._render.tell("open", session.key, session.session_id, generations)
        for eye in session.eyes.values():
            profile = eye.asked_profile or eye.profile
            if profile is not None:
                eye.asked_profile = profile
                self._render.tell("profile", session.key, profile)

    def _pass_on(self, key: str, name: EyeName, reply: Reply) -> None:
        """Tell a session what the render loop says of the profile of an eye."""
        session = self._guests.by_key(key)
        if session is None:
            return
        eye = session.eye(name)
        asked = eye.asked_profile
        if asked is not None and isinstance(reply, Accepted | ErrorReply):
            if isinstance(reply, Accepted):
                eye.profile, eye.profile_id = asked, reply.profile_id
                eye.generation = reply.generation
            if reply.profile_id == asked.profile_id:
                eye.asked_profile = None
                self._ask_next_profile(session, eye)
        if session.identity is not None:
            self._send(session.identity, reply)

    # Messages

    def _take_in_messages(self) -> None:
        """Handle what waits.

        Answers to frames are sent only afterwards: a client that keeps to its credit
        then never seems to exceed it, however fast it reacts to an answer.
        """
        superseded: list[tuple[Session, Frame]] = []
        for _ in range(MAX_MESSAGES_PER_TURN):
            try:
                received = self._mailbox.receive()
            except Refused as refused:
                self._turn_out(refused)
                continue
            if received is None:
                break
            if self._patience.is_over(received[0], time.monotonic()):
                continue
            try:
                self._take_in(*received, superseded)
            except Exception:  # whatever it is, other clients shall not notice
                self._n_faults += 1
                log.exception("fault %d: a refusal failed", self._n_faults)
                self._end_session(received[0])
        for session, frame in superseded:
            self._frames.answer(session, frame, Dropped(frame.frame_id, "superseded"))

    def _take_in(
        self,
        identity: bytes,
        parts: list[memoryview],
        n_left_out: int,
        superseded: list[tuple[Session, Frame]],
    ) -> None:
        received_s = time.monotonic()
        try:
            if n_left_out:
                raise BadMessage(
                    f"{len(parts) + n_left_out - 1} parts follow the header",
                    field="parts",
                    allowed=f"at most {len(parts) - 1}",
                )
            request = decode_request(parts, self._limits)
            if isinstance(request, Frame):
                session = self._session_at(identity)
                older = self._frames.take_in(session, request, received_s)
                superseded += [(session, older)] if older is not None else []
            else:
                self._handle(identity, request)
        except Exception as error:
            self._refuse(identity, parts, error)

    def _refuse(self, identity: bytes, parts: Sequence[Part], error: Exception) -> None:
        """Tell a client what is wrong with its message; the service lives on."""
        self._patience.note(identity)
        if not isinstance(error, FilterError):
            self._n_faults += 1
            log.error("a message could not be handled", exc_info=error)
            error = FilterError(f"{type(error).__name__}: {error}")
        frame_id, profile_id = peek_ids(parts)
        reply = ErrorReply.from_exception(
            error, frame_id=frame_id, profile_id=profile_id
        )
        self._send(identity, reply)

    def _handle(self, identity: bytes, request: Message) -> None:
        if isinstance(request, Ping):
            self._send(identity, self._pong(request))
        elif isinstance(request, Hello):
            self._greet(identity, request)
        elif isinstance(request, Bye):
            self._end_session(identity)
        elif isinstance(request, ProfileRequest):
            self._take_profile(self._session_at(identity), request)
        elif isinstance(request, Share):
            shared = self._sharing.share(self._session_at(identity), request)
            self._send(identity, shared)
        elif isinstance(request, Unshare):
            self._sharing.unshare(self._session_at(identity), request)

    def _turn_out(self, refused: Refused) -> None:
        """End the session of a client whose key was taken from the list."""
        log.warning("a client's key is not allowed any more")
        self._end_session(refused.identity)
        error = NotAllowed(str(refused))
        self._send(refused.identity, ErrorReply.from_exception(error))

    def _session_at(self, identity: bytes) -> Session:
        session = self._guests.at(identity)
        if session is None:
            raise NoSession("hello was not said", allowed="hello before anything else")
        return session

    def _pong(self, ping: Ping) -> Pong:
        asked = any(session.asks for session in self._guests.present)
        return Pong(
            t=ping.t,
            server_time_s=time.monotonic(),
            memory_mb=resident_memory_mb() + self._render_mb,
            n_sessions=len(self._guests.present),
            n_rendered=self._frames.n_rendered,
            n_dropped=self._frames.n_dropped,
            is_building=self._is_building or asked,
            is_ready=self._render.is_ready,
            is_filtering=bool(self._render.held),
            render_silent_s=self._render.silent_s,
        )

    def _send(self, identity: bytes, reply: Reply) -> Tracker | None:
        """Send a reply; a client that does not read loses its session."""
        outcome, tracker = self._mailbox.send(identity, encode(reply))
        if outcome is Outcome.GONE:
            self._leave(identity)
        elif outcome is Outcome.STALLED:
            self._end_session(identity, outcome)
        return tracker

    # Sessions

    def _greet(self, identity: bytes, hello: Hello) -> None:
        if self._server is None:  # it is about to say who it is
            self._greetings.append((identity, hello))
            return
        session, is_resumed = self._guests.at(identity), False
        if session is None:
            session = self._guests.by_key(hello.session_key)
            is_resumed = session is not None
            if session is None:
                session = self._new_session(identity, hello)
            else:
                self._end_sharing(session)
                self._guests.come_back(session, identity, hello.client)
                log.info("session %d goes on (%r)", session.session_id, hello.client)
        transports = [self.endpoint.split("://", 1)[0]]
        if self._sharing.is_offered:
            transports.append("shm")
        welcome = Welcome(
            session.session_id,
            self._server,
            self._limits,
            session.credit,
            tuple(transports),
            session_key=session.key,
            session_keep_s=self.config.session_keep_s,
            is_resumed=is_resumed,
            profile_id=session.profile_ids.get("both") if is_resumed else None,
            profile_ids=session.profile_ids if is_resumed else {},
        )
        self._send(identity, welcome)

    def _new_session(self, identity: bytes, hello: Hello) -> Session:
        most = self.config.max_sessions
        if len(self._guests) >= most:
            self._probe_clients(is_due=True)
        while len(self._guests) >= most and self._guests.away:
            self._forget(self._guests.away[0], "its place is needed")
        if len(self._guests) >= most:
            raise TooManySessions(
                f"{len(self._guests)} clients are being served",
                allowed=f"{most} clients",
            )
        session = self._guests.begin(identity, hello.client, self.config.credit)
        self._open(session)
        log.info("session %d begins (%r)", session.session_id, hello.client)
        return session

    def _take_profile(self, session: Session, request: ProfileRequest) -> None:
        """Ask for a profile; of several that wait for their turn the newest counts."""
        eye = session.eye(request.eye)
        replaced, eye.next_profile = eye.next_profile, request
        if replaced is not None and session.identity is not None:
            error = BuildCancelled(
                f"profile {request.profile_id} took the place of profile "
                f"{replaced.profile_id}"
            )
            reply = ErrorReply.from_exception(error, profile_id=replaced.profile_id)
            self._send(session.identity, reply)
        if eye.asked_profile is None:
            self._ask_next_profile(session, eye)

    def _ask_next_profile(self, session: Session, eye: EyeProfiles) -> None:
        request, eye.next_profile = eye.next_profile, None
        if request is not None:
            eye.asked_profile = request
            self._render.tell("profile", session.key, request)

    def _probe_clients(self, *, is_due: bool = False) -> None:
        """Send every client a sign of life; who is gone is found out by that."""
        now_s = time.monotonic()
        if is_due or now_s >= self._next_alive_s:
            self._next_alive_s = now_s + self.config.alive_interval_s
            for session in self._guests.present:
                if session.identity is not None:
                    self._send(session.identity, Alive())

    def _leave(self, identity: bytes) -> None:
        """Keep the session of a client that is gone for a while."""
        session = self._guests.at(identity)
        if session is not None:
            self._end_sharing(session)
            self._guests.leave(session, time.monotonic())
            log.info("session %d: its client is gone", session.session_id)

    def _end_session(self, identity: bytes, outcome: Outcome | None = None) -> None:
        session = self._guests.at(identity)
        if session is not None:
            why = "" if outcome is None else f"the client is {outcome.value}"
            self._forget(session, why)

    def _forget(self, session: Session, why: str) -> None:
        self._guests.remove(session)
        self._end_sharing(session)
        session.identity = None
        self._frames.forget(session)
        self._render.tell("close", session.key)
        log.info("session %d ends%s", session.session_id, f": {why}" if why else "")

    def _end_sharing(self, session: Session) -> None:
        """Give up the memory of a client that is gone."""
        self._sharing.end(session)
        self._frames.leave(session)
