"""Client side of the protocol: handshake, frames in flight and events.

`filter_client` is the public interface to this module.  There are no threads: all work
happens in `ServiceLink.pump`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from numpy.typing import NDArray

from clients.connection import Connection, SendBuffer
from clients.shared_memory import ClientSlot, SharedMemory, SharedTextures
from filter_service.errors import (
    AuthenticationFailed,
    FilterError,
    NoSession,
    NotAllowed,
    ServiceTimeout,
)
from filter_service.keys import ClientKey
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
    Ping,
    Pong,
    ProfileRequest,
    Progress,
    Ready,
    Result,
    Shared,
    SharedTexture,
    Welcome,
    decode_reply,
    encode,
)
from filter_service.waiting import Wait

MAX_KEPT_PROGRESS = 1000
EXTENDING_S = 0.03
"""Delay before a frame is sent again whose state is being prepared."""

RETRY_SEND_S = 0.002  # the socket accepts messages only shortly after the connect event

_Found = TypeVar("_Found")


@dataclass(frozen=True, kw_only=True)
class FilteredFrame(Result):
    """A filtered frame: the reply of the service, and how long it took.

    Attributes
    ----------
    frame_id : int
        Id that `FilterClient.submit` returned.
    colors : tuple of (height, width, 3) arrays
        One image per view; none for frames in textures.
    age_ms : float
        Time since `FilterClient.submit`.
    round_trip_ms : float
        Time since the frame was sent.
    """

    age_ms: float = 0.0
    round_trip_ms: float = 0.0

    @property
    def color(self) -> NDArray[Any]:
        """Return the image of the first view, (height, width, 3)."""
        return self.colors[0]


Event = FilteredFrame | Dropped | ErrorReply | Ready | Progress | Accepted


@dataclass
class Outgoing:
    """A serialized frame waiting to be sent or in flight."""

    frame_id: int
    parts: list[Any]
    buffers: list[SendBuffer]
    submitted_s: float
    frame: Frame
    slots: list[ClientSlot] = field(default_factory=list)  # input, result
    sent_s: float = 0.0

    def release(self) -> None:
        """Return the buffers to the pool after the send."""
        for buffer in self.buffers:
            buffer.is_held = False
        self.parts, self.buffers = [], []

    def end(self) -> None:
        """Release all resources, after a reply or a lost connection."""
        self.release()
        for slot in self.slots:
            slot.release()
        self.slots = []


class ServiceLink:
    """Client session with the service.

    Parameters
    ----------
    endpoint : str
        Address that the service listens on.
    max_in_flight : int
        Maximum number of frames in flight, which the service's credit may limit
        further.
    client_name : str
        Name sent with hello.
    shared_memory : bool
        Whether to use shared memory if the service offers it.
    key : ClientKey, optional
        Key of the client, for a service that requires one.
    """

    def __init__(
        self,
        endpoint: str,
        max_in_flight: int,
        client_name: str,
        *,
        shared_memory: bool = True,
        key: ClientKey | None = None,
    ) -> None:
        self.welcome: Welcome | None = None
        self.profiles: dict[EyeName, ProfileRequest] = {}
        self._n_ready_missing: dict[int, int] = {}  # of profiles, by id
        self.pending: Outgoing | None = None
        self.in_flight: dict[int, Outgoing] = {}
        self.pongs: list[Pong] = []
        self.n_superseded = 0
        self.n_advances = 0  # of profiles' preparation: it changes as they advance
        self._progress: tuple[float | None, str] = None, ""
        self._furthest: dict[tuple[int, int, str], float] = {}
        self._max_in_flight = max_in_flight
        self._client_name = client_name
        self._connection = Connection(endpoint, key)
        self._session_key = ""
        self._wants_memory = shared_memory
        self.memory = SharedMemory(lambda message: self.queue_message(encode(message)))
        self.textures = SharedTextures()
        self._outbox: list[list[Any]] = []
        self._events: list[Event] = []
        self._refusal: FilterError | None = None

    def close(self) -> None:
        """Send bye if connected, then close the socket."""
        if self._connection.is_up:
            self._connection.send(encode(Bye()))
        self._connection.close()

    def queue_message(self, parts: list[Any]) -> None:
        """Queue a control message; the queue is sent in order."""
        self._outbox.append(parts)

    def submit(self, outgoing: Outgoing) -> None:
        """Queue a frame to send next, replacing any frame still queued."""
        if self.pending is not None:
            self.n_superseded += 1
            self._drop(self.pending, "superseded")
        self.pending = outgoing
        self._send_waiting()  # before messages that may have arrived
        self.pump(0.0)

    @property
    def n_bytes(self) -> tuple[int, int]:
        """Return the total size in bytes of messages sent and received."""
        return self._connection.n_bytes_sent, self._connection.n_bytes_received

    def take_events(self) -> list[Event]:
        """Remove and return all events, oldest first."""
        taken, self._events = self._events, []
        return taken

    def take_event(self, is_wanted: Callable[[Event], bool]) -> Event | None:
        """Remove and return the oldest event that matches, if any."""
        wanted = next((event for event in self._events if is_wanted(event)), None)
        self._events = [event for event in self._events if event is not wanted]
        return wanted

    @property
    def has_events(self) -> bool:
        """Return whether there are events."""
        return bool(self._events)

    def wait_until(
        self, find: Callable[[], _Found | None], timeout_s: float, what: str
    ) -> _Found:
        """Pump until ``find`` returns a true value, and return that value.

        Raises
        ------
        ServiceTimeout
            After ``timeout_s`` without progress; the message includes ``what``.
        """
        self.pump(0.0)
        with Wait("Waiting for the service", timeout_s) as wait:
            while not (found := find()):
                self.pump_during(wait, what)
        return found

    def await_profile(
        self,
        profile_id: int,
        wait: bool | str,
        on_progress: Callable[[Progress], None] | None,
        timeout_s: float,
    ) -> Ready | Accepted:
        """Wait for a profile as the parameters of `FilterClient.set_profile` say.

        Raises
        ------
        FilterError
            The reply to the profile, or `ServiceTimeout`.
        """
        n_awaited = n_ready = 0
        is_shown = on_progress is None
        with Wait("Preparing the eye", timeout_s, is_shown=is_shown) as waiting:
            while True:
                # One at a time, because later events are left for the caller.
                event = self.take_event(
                    lambda e: getattr(e, "profile_id", None) == profile_id
                )
                if event is None:
                    self.pump_during(waiting, f"profile {profile_id} to become ready")
                if isinstance(event, ErrorReply):
                    raise event.exception()
                if isinstance(event, Progress) and on_progress is not None:
                    on_progress(event)
                if isinstance(event, Accepted):
                    # Again after a lost connection: the profile was sent again.
                    n_awaited, n_ready = event.n_cameras, 0
                    if not (wait and event.is_building):
                        return event
                if isinstance(event, Ready):
                    n_ready += 1
                    if n_ready >= n_awaited or wait == "first":
                        return event

    def await_filtered(
        self, frame_id: int, submit: Callable[[], int], timeout_s: float
    ) -> FilteredFrame:
        """Wait for a frame, submit it again until it is filtered, and return it.

        Raises
        ------
        FilterError
            The reply to the frame, or `ServiceTimeout`.
        """
        n_extended = n_most_extended = 0
        with Wait("Filtering", timeout_s) as wait:
            while True:
                answer = self._await_frame(frame_id, wait)
                if isinstance(answer, FilteredFrame):
                    return answer
                if isinstance(answer, ErrorReply):
                    raise answer.exception()
                if answer.reason == "preparing":
                    self._await_ready(wait)
                elif answer.reason == "extending":
                    n_extended += 1
                    if n_extended > n_most_extended:  # the service has computed PSFs
                        n_most_extended = n_extended
                        wait.advance()
                    self.pump(EXTENDING_S)
                elif answer.reason == "connection_lost":
                    n_extended = 0  # their PSFs are lost, too
                if wait.remaining_s <= 0.0:
                    raise ServiceTimeout(
                        "timed out waiting for a frame; the service dropped it "
                        f"({answer.reason})"
                    )
                frame_id = submit()

    def _await_frame(
        self, frame_id: int, wait: Wait
    ) -> FilteredFrame | Dropped | ErrorReply:
        while True:
            answer = self.take_event(lambda e: getattr(e, "frame_id", None) == frame_id)
            if isinstance(answer, FilteredFrame | Dropped | ErrorReply):
                return answer
            self.pump_during(wait, f"a reply to frame {frame_id}")

    def _await_ready(self, wait: Wait) -> None:
        """Wait for an eye that is being prepared; raise if its preparation fails.

        Return also after a lost connection, with which `Ready` may be lost.
        """
        profile_ids = {p.profile_id for p in self.profiles.values()}
        welcome = self.welcome
        while self.welcome is welcome:
            event = self.take_event(
                lambda e: (
                    isinstance(e, Ready | ErrorReply) and e.profile_id in profile_ids
                )
            )
            if isinstance(event, ErrorReply):
                raise event.exception()
            if event is not None:
                return
            self.pump_during(wait, "the eye to be prepared for this camera")

    def ping(self, timeout_s: float) -> tuple[float, Pong]:
        """Return the round trip in ms, and the reply."""
        self.pongs.clear()
        start_s, asked = time.monotonic(), None
        with Wait("Waiting for the service", timeout_s) as wait:
            while not self.pongs:
                if self.welcome is not asked and self.welcome is not None:
                    # Also after a lost connection, with which the reply was lost.
                    asked, start_s = self.welcome, time.monotonic()
                    self.queue_message(encode(Ping(start_s)))
                    self.pump(0.0)
                else:
                    self.pump_during(wait, "a reply to ping")
        return 1000 * (time.monotonic() - start_s), self.pongs[-1]

    def pump_during(self, wait: Wait, what: str) -> None:
        """Pump once; raise at the time limit or if the service rejected hello."""
        self.pump(min(max(wait.remaining_s, 0.0), 0.5))
        wait.update(self.n_advances, *self._progress)
        if wait.is_over():
            raise ServiceTimeout(
                f"timed out waiting for {what}: {self._connection.endpoint} is "
                f"{self._connection.describe()}. Is the service running there? Start "
                f"it with `ocufilter serve --bind {self._connection.endpoint}`"
            )
        if self._connection.has_failed_handshake:
            raise AuthenticationFailed(
                f"key exchange with {self._connection.endpoint} failed; expected a "
                "key file created with `ocufilter keys add NAME`"
            )
        if self._refusal is not None:
            refusal, self._refusal = self._refusal, None
            raise refusal

    def pump(self, timeout_s: float) -> None:
        """Wait for messages and connection changes, handle them, and send the queue."""
        is_due = bool(self._outbox) and self._connection.is_up
        self._connection.wait(min(timeout_s, RETRY_SEND_S) if is_due else timeout_s)
        for is_up in self._connection.changes():
            if is_up:
                self.send_hello()
            else:
                self._lose_connection()
        while (parts := self._connection.receive()) is not None:
            self._handle(decode_reply([part.buffer for part in parts]))
        self._send_waiting()

    def send_hello(self) -> None:
        """Send hello, on every new connection.

        The session key resumes the client's session.  `_begin` then sends the profiles
        that the session lacks.
        """
        self.welcome = None
        self._refusal = None
        self._outbox = [encode(Hello(self._client_name, self._session_key))]

    def _lose_connection(self) -> None:
        self.welcome = None
        self._outbox = []
        for outgoing in self.in_flight.values():
            self._drop(outgoing, "connection_lost")
        self.in_flight.clear()
        pending = self.pending
        if pending is not None and (pending.frame.memory or pending.frame.textures):
            self._drop(pending, "connection_lost")  # its memory is lost, too
            self.pending = None
        self.memory.begin(is_offered=False)
        self.textures.begin(None)

    def _drop(self, outgoing: Outgoing, reason: str) -> None:
        outgoing.end()
        self._events.append(Dropped(outgoing.frame_id, reason))

    def _send_waiting(self) -> None:
        if not self._connection.is_up:
            return
        while self._outbox:
            if not self._connection.send(self._outbox[0]):
                return
            self._outbox.pop(0)
        if self.pending is None or self.welcome is None:
            return
        if len(self.in_flight) >= min(self._max_in_flight, self.welcome.credit):
            return
        outgoing = self.pending
        outgoing.sent_s = time.monotonic()
        if self._connection.send(outgoing.parts, outgoing.buffers):
            self.pending = None
            self.in_flight[outgoing.frame_id] = outgoing
            outgoing.release()

    def _handle(self, reply: Any) -> None:
        if isinstance(reply, Result | Dropped):
            self._finish_frame(reply)
        elif isinstance(reply, ErrorReply):
            self._handle_error(reply)
        elif isinstance(reply, Welcome):
            self._begin(reply)
        elif isinstance(reply, Pong):
            self.pongs.append(reply)
        elif isinstance(reply, Shared):
            self.memory.take_in(reply)
        elif isinstance(reply, SharedTexture):
            self.textures.take_in(reply)
        elif not isinstance(reply, Alive | Closing):
            if isinstance(reply, Accepted):
                current = {profile.profile_id for profile in self.profiles.values()}
                self._n_ready_missing = {
                    number: count
                    for number, count in self._n_ready_missing.items()
                    if number in current
                } | {reply.profile_id: reply.n_cameras}
                self._furthest = {
                    key: f for key, f in self._furthest.items() if key[0] in current
                }
            elif isinstance(reply, Progress):
                self._note_progress(reply)
            elif isinstance(reply, Ready):
                self._progress = None, ""
                self.n_advances += 1
                missing = self._n_ready_missing.get(reply.profile_id, 0)
                if missing:
                    self._n_ready_missing[reply.profile_id] = missing - 1
            self._events.append(reply)
            self._bound_progress()

    def _note_progress(self, reply: Progress) -> None:
        """Count progress as an advance, unless a restarted service repeats it."""
        self._progress = reply.fraction, reply.stage
        n_missing = self._n_ready_missing.get(reply.profile_id, 0)
        key = reply.profile_id, n_missing, reply.stage
        if reply.fraction > self._furthest.get(key, -1.0):
            self._furthest[key] = reply.fraction
            self.n_advances += 1

    def _begin(self, welcome: Welcome) -> None:
        """Start or resume a session, and send the profiles that it lacks."""
        self.welcome = welcome
        self._session_key = welcome.session_key
        self.textures.begin(welcome.textures)
        if not self.in_flight:
            is_offered = self._wants_memory and "shm" in welcome.transports
            self.memory.begin(is_offered=is_offered)
        known: dict[EyeName, int | None] = {"both": welcome.profile_id}
        known |= welcome.profile_ids
        for eye, profile in self.profiles.items():
            # A reply about a profile may have been lost with the connection.
            is_ready = self._n_ready_missing.get(profile.profile_id) == 0
            if known.get(eye) != profile.profile_id or not is_ready:
                self.queue_message(encode(profile))

    def _bound_progress(self) -> None:
        """Discard the oldest progress event if the program does not poll."""
        if len(self._events) > MAX_KEPT_PROGRESS:
            progress = (e for e in self._events if isinstance(e, Progress))
            oldest = next(progress, None)
            if oldest is not None:
                self._events.remove(oldest)

    def _finish_frame(self, reply: Result | Dropped) -> None:
        outgoing = self.in_flight.pop(reply.frame_id, None)
        if outgoing is None:
            return  # already reported as lost with the previous connection
        if isinstance(reply, Dropped):
            outgoing.end()
            self._events.append(reply)
            return
        now_s = time.monotonic()
        colors = self._colors_in_memory(outgoing) if reply.in_memory else reply.colors
        outgoing.end()
        times_ms = {
            "age_ms": 1000 * (now_s - outgoing.submitted_s),
            "round_trip_ms": 1000 * (now_s - outgoing.sent_s),
        }
        self._events.append(FilteredFrame.changed(reply, colors=colors, **times_ms))

    def _colors_in_memory(self, outgoing: Outgoing) -> tuple[NDArray[Any], ...]:
        """Return the images that the service wrote to a slot; none for textures."""
        if outgoing.frame.textures:
            return ()
        frame, (_, slot) = outgoing.frame, outgoing.slots
        assert frame.memory is not None
        return tuple(
            self.memory.array(
                slot,
                start,
                (view.height_px, view.width_px, 3),
                frame.output.dtype,
            )
            for view, start in zip(frame.views, frame.memory.result_starts, strict=True)
        )

    def _handle_error(self, reply: ErrorReply) -> None:
        if reply.code == NoSession.code:
            self._restart_session(reply)
            return
        if reply.code == NotAllowed.code:
            self._refusal = reply.exception()
            return
        if reply.frame_id is not None:
            outgoing = self.in_flight.pop(reply.frame_id, None)
            if outgoing is not None:
                outgoing.end()
        elif reply.profile_id is not None:
            self._n_ready_missing[reply.profile_id] = 0  # an outcome as well
        elif self.welcome is None:
            self._refusal = reply.exception()
        self._events.append(reply)

    def _restart_session(self, reply: ErrorReply) -> None:
        """Send hello again: the service ended the session on a live connection."""
        frame_id = reply.frame_id
        if frame_id is not None and frame_id in self.in_flight:
            self._drop(self.in_flight.pop(frame_id), "connection_lost")
        if self.welcome is not None:
            self.send_hello()
