"""The door: the process that owns the socket, the sessions and their credit.

It checks every message, answers what it can by itself, and hands frames and profiles
to the render loop over a link, one frame at a time: newest frame of each client,
clients by time used.  Images go through shared memory.  It renders nothing, so that it
answers while a frame is rendered, however long that takes.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from filter_service.errors import (
    BadMessage,
    BuildCancelled,
    FilterError,
    NoSession,
    OutOfMemory,
    RenderFailed,
    TooManySessions,
)
from filter_service.messages import (
    Accepted,
    Alive,
    Bye,
    Closing,
    Dropped,
    ErrorReply,
    Frame,
    Hello,
    Part,
    Ping,
    Pong,
    ProfileRequest,
    Reply,
    Result,
    Share,
    Shared,
    SharedPlaces,
    Unshare,
    Welcome,
    decode_request,
    encode,
    peek_ids,
)
from filter_service.service.config import LOOPBACK_HOSTS, ServiceConfig
from filter_service.service.link import Link, LinkClosed
from filter_service.service.mailbox import Mailbox, Outcome, Tracker
from filter_service.service.process_info import resident_memory_mb
from filter_service.service.session import Session, WaitingFrame
from filter_service.service.turns import Turns
from filter_service.slots import Slot, SlotPool, starts_of
from filter_service.wire.message import Message

MAX_MESSAGES_PER_TURN = 64  # a client that floods must not keep others waiting
MAX_UNSENT_RESULTS = 4  # large replies a client has not taken; bounds memory
MARK_SENT_S = 0.03  # less than most frames take to filter
IDLE_WAIT_S = 1.0
SOON_S = 0.002
TRIM_INTERVAL_S = 10.0
CLOSING_LINGER_MS = 200
RETRY_AFTER_MS = 100.0
"""A first guess of when a preview is there."""

MS_PER_S = 1000.0
MAX_PARTS_PER_VIEW = 4
MAX_SHARED_SLOTS = 16
"""Of one session."""

log = logging.getLogger("ocufilter")


@dataclass(frozen=True)
class _Outstanding:
    """The frame that the render loop has."""

    number: int
    session: Session
    identity: bytes | None
    waiting: WaitingFrame
    places: SharedPlaces
    own_slots: tuple[Slot, ...]  # not the client's: what is sent, and is given back
    handed_s: float


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
        self._render: Link | None = None
        self._server: dict[str, str] | None = None
        self._greetings: list[tuple[bytes, Hello]] = []  # until the renderer is known
        self._sessions: dict[bytes, Session] = {}
        self._away: dict[str, Session] = {}
        self._next_session_id = 1
        self._turns: Turns[str] = Turns()
        self._outstanding: _Outstanding | None = None
        self._next_number = 1
        self._slots = SlotPool(config.max_image_mb * 10**6)
        self._leaving: list[tuple[Tracker, Slot]] = []
        self._n_rendered = self._n_dropped = self._n_faults = 0
        self._render_mb, self._is_building = 0.0, False
        now_s = time.monotonic()
        self._heard_s = now_s
        self._next_alive_s = now_s + config.alive_interval_s
        self._next_trim_s = now_s + TRIM_INTERVAL_S
        self._mailbox = Mailbox(
            config.bind,
            config.max_message_part_bytes,
            1 + MAX_PARTS_PER_VIEW * self._limits.max_views,
        )
        self.endpoint = self._mailbox.endpoint

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
            self._join(Link.from_descriptor(descriptors[0]))
        return bool(message[0] != "stop")

    def _turn(self) -> None:
        readable = {self._keeper.fileno()}
        writable = set()
        if self._keeper.has_unsent:
            writable.add(self._keeper.fileno())
        if self._render is not None:
            readable.add(self._render.fileno())
            if self._render.has_unsent:
                writable.add(self._render.fileno())
        self._mailbox.watch(readable, writable)
        self._mailbox.wait(self._wait_s())
        self._keeper.flush()
        self._listen_to_render()
        self._take_in_messages()
        self._hand_over_one_frame()
        self._tidy()

    def _wait_s(self) -> float:
        now_s = time.monotonic()
        if self._outstanding is None and self._may_hand_over():
            if any(self._is_ready(s, now_s) for s in self._sessions.values()):
                return 0.0
            if any(s.waiting for s in self._sessions.values()):
                return SOON_S
        due_s = min(self._next_alive_s, self._next_trim_s)
        return min(IDLE_WAIT_S, max(0.0, due_s - now_s))

    def _close(self) -> None:
        for identity in list(self._sessions):
            with suppress(Exception):
                self._mailbox.send(identity, encode(Closing()))
        self._mailbox.close(linger_ms=CLOSING_LINGER_MS)

    def _tidy(self) -> None:
        """Do what is due now and then."""
        now_s = time.monotonic()
        self._leaving = self._still_unsent(self._leaving)
        self._probe_clients()
        for session in list(self._away.values()):
            if now_s - (session.away_since_s or 0.0) > self.config.session_keep_s:
                self._forget(session, "its client did not come back")
        if now_s >= self._next_trim_s:
            self._next_trim_s = now_s + TRIM_INTERVAL_S
            self._trim()
        self._watch_render(now_s)

    def _trim(self) -> None:
        if self._outstanding is None and not any(
            session.waiting for session in self._sessions.values()
        ):
            for slot in self._slots.trim():
                self._tell_render(("drop_slot", slot.number))

    # The render loop

    def _join(self, render: Link) -> None:
        """Work with a render loop; one before it is gone."""
        self._lose_render()
        self._render = render
        self._heard_s = time.monotonic()
        for slot in self._slots:
            self._send_slot(slot)

    def _listen_to_render(self) -> None:
        render = self._render
        if render is None:
            return
        try:
            render.flush()
            messages = render.receive()
        except LinkClosed:
            self._lose_render()
            return
        for (kind, *rest), _ in messages:
            self._heard_s = time.monotonic()
            if kind == "answer":
                self._take_answer(*rest)
            elif kind == "tell":
                self._pass_on(*rest)
            elif kind == "state":
                self._render_mb, self._is_building = rest
            elif kind == "here":
                self._begin_with(*rest)

    def _begin_with(self, server: dict[str, str], eyes: list[tuple[Any, ...]]) -> None:
        """Learn which eyes there are; bring both sides to the same sessions."""
        self._server = server
        known = {s.key: s for s in (*self._sessions.values(), *self._away.values())}
        held = {key for key, *_ in eyes}
        for key, session_id, profile_id, generation in eyes:
            if key not in known:  # a door before this one knew its client
                session = Session(
                    session_id, None, "", self.config.credit, key=key,
                    profile_id=profile_id, generation=generation,
                )  # fmt: skip
                session.away_since_s = time.monotonic()
                self._away[key] = session
                self._next_session_id = max(self._next_session_id, session_id + 1)
        for session in known.values():
            if session.key not in held:
                self._open(session)
        for identity, hello in self._greetings:
            self._greet_or_refuse(identity, hello)
        self._greetings = []

    def _open(self, session: Session) -> None:
        """Have the render loop hold an eye for a session, with its profile if any."""
        first_generation = session.generation + 1
        message = ("open", session.key, session.session_id, first_generation)
        self._tell_render(message)
        profile = session.asked_profile or session.profile
        if profile is not None:
            session.asked_profile = profile
            self._tell_render(("profile", session.key, profile))

    def _lose_render(self) -> None:
        """Answer the frame that is lost with a render loop."""
        if self._render is not None:
            self._render.close()
            self._render = None
        lost, self._outstanding = self._outstanding, None
        if lost is None:
            return
        self._give_back(lost)
        error = RenderFailed("the process that filters frames ended; it starts again")
        reply = ErrorReply.from_exception(error, frame_id=lost.waiting.frame.frame_id)
        self._answer_held(lost, reply)

    def _watch_render(self, now_s: float) -> None:
        """Have a render loop ended that hangs."""
        if self._render is None:
            return
        held = self._outstanding
        limit_s = self.config.frame_limit_s
        since_s = max(self._heard_s, held.handed_s if held else self._heard_s)
        if now_s - since_s > limit_s:
            log.error("the process that filters frames says nothing for %g s", limit_s)
            self._heard_s = now_s
            self._keeper.send(("hung",))

    def _tell_render(self, message: tuple[Any, ...]) -> None:
        if self._render is None:
            return
        try:
            self._render.send(message)
        except LinkClosed:
            self._lose_render()

    def _send_slot(self, slot: Slot) -> None:
        if self._render is None:
            return
        try:
            message = ("slot", slot.number, slot.size_bytes)
            self._render.send(message, [slot.descriptor])
        except LinkClosed:
            self._lose_render()

    def _pass_on(self, key: str, reply: Reply) -> None:
        """Tell a session what the render loop says of its profile."""
        session = self._session_of(key)
        if session is None:
            return
        asked = session.asked_profile
        if asked is not None and isinstance(reply, Accepted | ErrorReply):
            if isinstance(reply, Accepted):
                session.profile, session.profile_id = asked, reply.profile_id
                session.generation = reply.generation
            if reply.profile_id == asked.profile_id:
                session.asked_profile = None
                self._ask_next_profile(session)
        if session.identity is not None:
            self._send(session.identity, reply)

    def _session_of(self, key: str) -> Session | None:
        away = self._away.get(key)
        if away is not None:
            return away
        return next((s for s in self._sessions.values() if s.key == key), None)

    # Messages

    def _take_in_messages(self) -> None:
        """Handle what waits.

        Answers to frames are sent only afterwards: a client that keeps to its credit
        then never seems to exceed it, however fast it reacts to an answer.
        """
        answers: list[tuple[Session, Frame, Dropped | ErrorReply]] = []
        for _ in range(MAX_MESSAGES_PER_TURN):
            received = self._mailbox.receive()
            if received is None:
                break
            try:
                self._take_in(*received, answers)
            except Exception:  # whatever it is, other clients shall not notice
                self._n_faults += 1
                log.exception("fault %d: a refusal failed", self._n_faults)
                self._end_session(received[0])
        for session, frame, answer in answers:
            self._answer_frame(session, frame, answer)

    def _take_in(
        self,
        identity: bytes,
        parts: list[memoryview],
        n_left_out: int,
        answers: list[tuple[Session, Frame, Dropped | ErrorReply]],
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
            self._handle(identity, request, received_s, answers)
        except Exception as error:
            self._refuse(identity, parts, error)

    def _refuse(self, identity: bytes, parts: Sequence[Part], error: Exception) -> None:
        """Tell a client what is wrong with its message; the service lives on."""
        if not isinstance(error, FilterError):
            self._n_faults += 1
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
        answers: list[tuple[Session, Frame, Dropped | ErrorReply]],
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
        elif isinstance(request, Share):
            self._send(identity, self._share(self._sessions[identity], request))
        elif isinstance(request, Unshare):
            self._unshare(self._sessions[identity], request)
        elif isinstance(request, Frame):
            session = self._sessions[identity]
            check_memory(session, request)
            waiting = WaitingFrame(request, received_s, time.monotonic())
            superseded = session.take_in(waiting)
            self._turns.arrive(session.key, waiting.decoded_s)
            session.lend(request)
            if superseded is not None:
                reply = Dropped(superseded.frame.frame_id, "superseded")
                answers.append((session, superseded.frame, reply))

    # Sessions

    def _greet_or_refuse(self, identity: bytes, hello: Hello) -> None:
        try:
            self._greet(identity, hello)
        except FilterError as error:
            self._send(identity, ErrorReply.from_exception(error))

    def _greet(self, identity: bytes, hello: Hello) -> None:
        if self._server is None:  # it is about to say who it is
            self._greetings.append((identity, hello))
            return
        session = self._sessions.get(identity)
        resumed = None
        if session is None:
            resumed = self._resumed(identity, hello)
            session = resumed or self._new_session(identity, hello)
        transports = [self.endpoint.split("://", 1)[0]]
        if self._may_share:
            transports.append("shm")
        self._send(
            identity,
            Welcome(
                session.session_id,
                self._server,
                self._limits,
                session.credit,
                tuple(transports),
                session_key=session.key,
                session_keep_s=self.config.session_keep_s,
                is_resumed=resumed is not None,
                profile_id=None if resumed is None else resumed.profile_id,
            ),
        )

    def _resumed(self, identity: bytes, hello: Hello) -> Session | None:
        """Return the session that a client comes back to."""
        key = hello.session_key
        session = self._session_of(key) if key else None
        if session is None:
            return None
        if session.identity is not None:  # the old connection is not known to be gone
            del self._sessions[session.identity]
            self._end_sharing(session)
        self._away.pop(key, None)
        session.come_back(identity, hello.client)
        self._sessions[identity] = session
        log.info("session %d goes on (%r)", session.session_id, hello.client)
        return session

    def _new_session(self, identity: bytes, hello: Hello) -> Session:
        if self._n_held >= self.config.max_sessions:
            self._probe_clients(is_due=True)
        while self._n_held >= self.config.max_sessions and self._away:
            oldest = min(self._away.values(), key=lambda s: s.away_since_s or 0.0)
            self._forget(oldest, "its place is needed")
        if self._n_held >= self.config.max_sessions:
            raise TooManySessions(
                f"{len(self._sessions)} clients are being served",
                allowed=f"{self.config.max_sessions} clients",
            )
        session = Session(
            self._next_session_id, identity, hello.client, self.config.credit
        )
        self._next_session_id += 1
        self._sessions[identity] = session
        self._open(session)
        log.info("session %d begins (%r)", session.session_id, hello.client)
        return session

    @property
    def _n_held(self) -> int:
        return len(self._sessions) + len(self._away)

    def _take_profile(self, session: Session, request: ProfileRequest) -> None:
        """Ask for a profile; of several that wait for their turn the newest counts."""
        replaced, session.next_profile = session.next_profile, request
        if replaced is not None and session.identity is not None:
            error = BuildCancelled(
                f"profile {request.profile_id} took the place of profile "
                f"{replaced.profile_id}"
            )
            reply = ErrorReply.from_exception(error, profile_id=replaced.profile_id)
            self._send(session.identity, reply)
        if session.asked_profile is None:
            self._ask_next_profile(session)

    def _ask_next_profile(self, session: Session) -> None:
        request, session.next_profile = session.next_profile, None
        if request is not None:
            session.asked_profile = request
            self._tell_render(("profile", session.key, request))

    # Shared memory

    def _share(self, session: Session, request: Share) -> Shared:
        """Give a client memory for its images, or say why not."""
        if not self._may_share:
            return Shared(reason="this service shares no memory over this transport")
        if len(session.shared) >= MAX_SHARED_SLOTS:
            return Shared(reason=f"{MAX_SHARED_SLOTS} slots are in use")
        if request.size_bytes > MAX_PARTS_PER_VIEW * self._limits.max_views * (
            self._limits.max_part_bytes
        ):
            return Shared(
                reason=f"{request.size_bytes} bytes are more than a frame has"
            )
        try:
            # A new one: in another's lie another client's images.
            slot = self._slots.create(request.size_bytes)
        except OutOfMemory as error:
            return Shared(reason=str(error))
        session.shared[slot.number] = slot
        self._send_slot(slot)
        return Shared(slot.number, slot.size_bytes, slot.path)

    @property
    def _may_share(self) -> bool:
        is_local = self.endpoint.startswith("ipc://") or any(
            self.endpoint.startswith(f"tcp://{host}:") for host in LOOPBACK_HOSTS
        )
        return self.config.shared_memory and is_local

    def _unshare(self, session: Session, request: Unshare) -> None:
        if request.slot not in session.shared or request.slot in session.lent:
            raise BadMessage(
                f"it is {request.slot}",
                field="slot",
                allowed="a slot of this session that no frame uses",
            )
        self._drop_slot(session.shared.pop(request.slot))

    def _drop_slot(self, slot: Slot) -> None:
        self._slots.drop(slot)
        self._tell_render(("drop_slot", slot.number))

    def _end_sharing(self, session: Session) -> None:
        """Give up the memory of a client that is gone."""
        for slot in session.shared.values():
            self._drop_slot(slot)
        session.shared, session.lent = {}, set()

    def _pong(self, ping: Ping) -> Pong:
        now_s = time.monotonic()
        return Pong(
            t=ping.t,
            server_time_s=now_s,
            memory_mb=resident_memory_mb() + self._render_mb,
            n_sessions=len(self._sessions),
            n_rendered=self._n_rendered,
            n_dropped=self._n_dropped,
            is_building=self._is_building
            or any(s.asked_profile for s in self._sessions.values()),
            is_filtering=self._outstanding is not None,
            render_silent_s=now_s - self._heard_s,
        )

    def _send(self, identity: bytes, reply: Reply) -> Tracker | None:
        """Send a reply; a client that does not read loses its session."""
        outcome, tracker = self._mailbox.send(identity, encode(reply))
        if outcome is Outcome.GONE:
            self._leave(identity)
        elif outcome is Outcome.STALLED:
            self._end_session(identity, outcome)
        return tracker

    def _probe_clients(self, *, is_due: bool = False) -> None:
        """Send every client a sign of life; who is gone is found out by that."""
        now_s = time.monotonic()
        if is_due or now_s >= self._next_alive_s:
            self._next_alive_s = now_s + self.config.alive_interval_s
            for identity in list(self._sessions):
                self._send(identity, Alive())

    def _leave(self, identity: bytes) -> None:
        """Keep the session of a client that is gone for a while."""
        session = self._sessions.pop(identity, None)
        if session is None:
            return
        session.leave(time.monotonic())
        self._end_sharing(session)
        self._leaving += session.unsent
        session.unsent = []
        self._away[session.key] = session
        log.info("session %d: its client is gone", session.session_id)

    def _end_session(self, identity: bytes, outcome: Outcome | None = None) -> None:
        session = self._sessions.pop(identity, None)
        if session is not None:
            why = "" if outcome is None else f"the client is {outcome.value}"
            self._forget(session, why)

    def _forget(self, session: Session, why: str) -> None:
        self._away.pop(session.key, None)
        self._turns.forget(session.key)
        session.identity = None
        self._end_sharing(session)
        self._leaving += session.unsent
        session.unsent = []
        self._tell_render(("close", session.key))
        log.info("session %d ends%s", session.session_id, f": {why}" if why else "")

    # Frames

    def _answer_frame(
        self, session: Session, frame: Frame, answer: Result | Dropped | ErrorReply
    ) -> Tracker | None:
        """Answer a frame that counts against the credit."""
        if session.identity is None:
            return None  # its client is away
        session.n_unanswered = max(0, session.n_unanswered - 1)
        session.get_back(frame)
        if isinstance(answer, Result):
            self._n_rendered += 1
        else:
            self._n_dropped += 1
        return self._send(session.identity, answer)

    def _answer_held(
        self, held: _Outstanding, answer: Result | Dropped | ErrorReply
    ) -> Tracker | None:
        """Answer a frame, if its client is where it was: else it counts it as lost."""
        if held.identity is None or held.session.identity != held.identity:
            return None
        return self._answer_frame(held.session, held.waiting.frame, answer)

    def _may_hand_over(self) -> bool:
        return self._render is not None and self._server is not None

    def _is_ready(self, session: Session, now_s: float) -> bool:
        """Return whether a session's frame may be handed over, or be given up.

        A thread of pyzmq's marks results as sent; it gets a moment before a client is
        said not to read.
        """
        if session.waiting is None:
            return False
        session.unsent = self._still_unsent(session.unsent)
        if len(session.unsent) < MAX_UNSENT_RESULTS:
            session.behind_since_s = None
            return True
        if session.behind_since_s is None:
            session.behind_since_s = now_s
        return now_s - session.behind_since_s > MARK_SENT_S

    def _still_unsent(
        self, unsent: list[tuple[Tracker, Slot]]
    ) -> list[tuple[Tracker, Slot]]:
        """Return those of which libzmq still reads; the slots of others are free."""
        left = []
        for tracker, slot in unsent:
            if tracker.done:
                self._slots.give_back(slot)
            else:
                left.append((tracker, slot))
        return left

    def _hand_over_one_frame(self) -> None:
        if self._outstanding is not None or not self._may_hand_over():
            return
        now_s = time.monotonic()
        ready = {s.key: s for s in self._sessions.values() if self._is_ready(s, now_s)}
        key = self._turns.next_of(ready)
        if key is None:
            return
        session = ready[key]
        waiting, session.waiting = session.waiting, None
        if waiting is None:
            return
        frame_id = waiting.frame.frame_id
        if len(session.unsent) >= MAX_UNSENT_RESULTS:
            reply = Dropped(frame_id, "slow_consumer")
            self._answer_frame(session, waiting.frame, reply)
            return
        try:
            self._hand_over(session, waiting)
        except OutOfMemory as error:
            failed = ErrorReply.from_exception(error, frame_id=frame_id)
            self._answer_frame(session, waiting.frame, failed)

    def _hand_over(self, session: Session, waiting: WaitingFrame) -> None:
        frame = waiting.frame
        own_slots: tuple[Slot, ...] = ()
        places = frame.memory
        if places is None:
            places, own_slots = self._copied_in(frame)
        self._outstanding = _Outstanding(
            *(self._next_number, session, session.identity, waiting),
            *(places, own_slots, time.monotonic()),
        )
        self._next_number += 1
        bare = replace(frame, images=(), memory=None)
        message = ("frame", self._outstanding.number, session.key, bare, places)
        self._tell_render(message)

    def _copied_in(self, frame: Frame) -> tuple[SharedPlaces, tuple[Slot, Slot]]:
        """Copy the images of a frame to slots of the service."""
        images = [
            image
            for view, found in zip(frame.views, frame.images, strict=True)
            for image in found.parts(view)
        ]
        starts, n_in = starts_of([image.nbytes for image in images])
        result_starts, n_out = starts_of(
            [v.camera.pixel_count * frame.output.bytes_per_pixel for v in frame.views]
        )
        slot = self._slot_for(n_in)
        try:
            result_slot = self._slot_for(n_out)
        except OutOfMemory:
            self._slots.give_back(slot)
            raise
        slot.put(images, starts)
        places = SharedPlaces(
            slot.number, tuple(starts), result_slot.number, tuple(result_starts)
        )
        return places, (slot, result_slot)

    def _slot_for(self, size_bytes: int) -> Slot:
        slot, is_new = self._slots.take(size_bytes)
        if is_new:
            self._send_slot(slot)
        return slot

    def _give_back(self, held: _Outstanding) -> None:
        for slot in held.own_slots:
            self._slots.give_back(slot)

    def _take_answer(
        self,
        number: int,
        reply: Result | Dropped | ErrorReply,
        started_s: float,
        ended_s: float,
    ) -> None:
        held = self._outstanding
        if held is None or held.number != number:
            return
        self._outstanding = None
        self._turns.note(held.session.key, ended_s - started_s, ended_s)
        if isinstance(reply, Dropped):
            reply = replace(reply, retry_after_ms=RETRY_AFTER_MS)
        if not isinstance(reply, Result) or not held.own_slots:
            if isinstance(reply, Result):
                reply = _timed(replace(reply, in_memory=True), held.waiting, started_s)
            self._give_back(held)
            self._answer_held(held, reply)
            return
        slot, result_slot = held.own_slots
        self._slots.give_back(slot)
        places = zip(held.places.result_starts, reply.views, strict=True)
        colors = tuple(
            result_slot.array(
                start,
                (view.height_px, view.width_px, 3),
                np.dtype(view.color.dtype),
            )
            for start, view in places
        )
        result = _timed(replace(reply, colors=colors), held.waiting, started_s)
        tracker = self._answer_held(held, result)
        if tracker is None:
            self._slots.give_back(result_slot)
        elif held.session.identity is None:
            self._leaving.append((tracker, result_slot))
        else:
            held.session.unsent.append((tracker, result_slot))


def _timed(result: Result, waiting: WaitingFrame, started_s: float) -> Result:
    """Return a result with the times that the door knows."""
    stages_ms = {
        "decode_ms": MS_PER_S * (waiting.decoded_s - waiting.received_s),
        "queue_ms": MS_PER_S * (started_s - waiting.decoded_s),
        **result.stage_times_ms,
    }
    total_ms = MS_PER_S * (time.monotonic() - waiting.received_s)
    stages_ms["other_ms"] = total_ms - sum(stages_ms.values())
    return replace(result, total_ms=total_ms, stage_times_ms=stages_ms)


def check_memory(session: Session, frame: Frame) -> None:
    """Refuse a frame whose images do not lie in free slots of its session.

    Raises
    ------
    BadMessage
    """
    places = frame.memory
    if places is None:
        return
    for name, number in (("slot", places.slot), ("result_slot", places.result_slot)):
        if number not in session.shared or number in session.lent:
            raise BadMessage(
                f"it is {number}",
                field=f"memory.{name}",
                allowed="a slot of this session that no other frame uses",
            )
    if places.slot == places.result_slot:
        raise BadMessage(
            f"it is {places.slot}, too",
            field="memory.result_slot",
            allowed="another than memory.slot",
        )
    sizes = [
        int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        for view in frame.views
        for _, shape, dtype in view.images
    ]
    _check_room(session.shared[places.slot], places.starts, sizes, "starts")
    sizes = [v.camera.pixel_count * frame.output.bytes_per_pixel for v in frame.views]
    slot = session.shared[places.result_slot]
    _check_room(slot, places.result_starts, sizes, "result_starts")


def _check_room(
    slot: Slot, starts: Sequence[int], sizes: Sequence[int], name: str
) -> None:
    """Refuse images that reach beyond a slot or into each other."""
    end = 0
    for start, size in sorted(zip(starts, sizes, strict=True)):
        if start < end or start + size > slot.size_bytes:
            raise BadMessage(
                f"{size} bytes from {start}",
                field=f"memory.{name}",
                allowed=f"images beside each other within {slot.size_bytes} bytes",
            )
        end = start + size
