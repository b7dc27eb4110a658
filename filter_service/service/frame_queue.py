"""Queue of frames to one render worker, and their replies.

Every frame gets one reply.  The order depends on the time that each client has used.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from filter_service.errors import OutOfMemory, RenderFailed
from filter_service.messages import Dropped, ErrorReply, Frame, Reply
from filter_service.service.connections import Peer
from filter_service.service.render_client import (
    InFlightFrame,
    RenderClient,
    UnsentResults,
    check_positions,
    result_parts,
)
from filter_service.service.router import Tracker
from filter_service.service.session import Session, WaitingFrame

Client = TypeVar("Client", bound=Hashable)

MAX_CATCH_UP_S = 0.5
"""Maximum time that a session gains while it is idle: enough for the round trip between
two frames, and little enough that a heavy client waits only a second or two when many
light ones pause."""

MAX_CHARGE_S = 20.0
"""Maximum time that one frame is charged; otherwise a frame that hung for a minute
would make its session wait that long for each other session."""


@dataclass
class _Share:
    """Time used by one session, and whether it has a frame in the queue."""

    used_s: float
    is_waiting: bool = False


class FairQueue(Generic[Client]):
    """Select the waiting session that has used the least time.

    A session that starts to wait counts as having used as much as the one served last,
    less at most `MAX_CATCH_UP_S`.  An idle session therefore cannot accumulate time.
    """

    def __init__(self) -> None:
        self._shares: dict[Client, _Share] = {}
        self._level_s = 0.0  # time that the session served last had used
        self._free_since_s = 0.0  # end of the last frame

    def mark_waiting(self, client: Client) -> None:
        """Record that a session has a waiting frame."""
        share = self._shares.setdefault(client, _Share(self._level_s))
        if not share.is_waiting:
            share.used_s = max(share.used_s, self._level_s - MAX_CATCH_UP_S)
            share.is_waiting = True

    def pop_next(self, waiting: Iterable[Client]) -> Client | None:
        """Return the session to serve next, of those marked as waiting."""
        chosen = min(
            waiting, key=lambda client: self._shares[client].used_s, default=None
        )
        if chosen is not None:
            share = self._shares[chosen]
            self._level_s = max(self._level_s, share.used_s)
            share.is_waiting = False
        return chosen

    def record_frame(
        self,
        client: Client,
        used_s: float,
        queued_since_s: float,
        started_s: float,
        ended_s: float,
    ) -> None:
        """Charge a session for its frame, including the idle gap before it.

        No session is served between the end of one frame and the start of the next.
        For frames of 160x90 that take 5 ms, this gap is 4 ms.  When it was not charged,
        a large frame of another session waited 1.8 times its fair share.

        Parameters
        ----------
        client : hashable
        used_s : float
            Time spent on the frame.
        queued_since_s, started_s, ended_s : float
            Times of `time.monotonic` at which the frame was queued, started and ended.
        """
        idle_s = max(0.0, started_s - max(self._free_since_s, queued_since_s))
        self._free_since_s = max(self._free_since_s, ended_s)
        if client in self._shares:  # otherwise it has ended
            self.charge(client, used_s + idle_s)

    def charge(self, client: Client, used_s: float) -> None:
        """Charge a session for time that was spent for it."""
        share = self._shares.setdefault(client, _Share(self._level_s))
        share.used_s += min(used_s, MAX_CHARGE_S)

    def forget(self, client: Client) -> None:
        """Forget a session that has ended."""
        self._shares.pop(client, None)


LOAD_WINDOW_S = 10.0


class Load:
    """Exponentially decaying sum of the time that a device was busy."""

    def __init__(self) -> None:
        self._busy_s = 0.0
        self._at_s = 0.0

    def add(self, busy_s: float, now_s: float) -> None:
        """Add busy time that ended now."""
        self._busy_s = self._decayed_s(now_s) + busy_s
        self._at_s = now_s

    def busy_ratio(self, now_s: float) -> float:
        """Return the busy share of about the last `LOAD_WINDOW_S`, 0 to 1."""
        return min(1.0, self._decayed_s(now_s) / LOAD_WINDOW_S)

    def _decayed_s(self, now_s: float) -> float:
        return self._busy_s * math.exp(min(0.0, self._at_s - now_s) / LOAD_WINDOW_S)


MAX_UNSENT_RESULTS = 4  # results that a client has not read; limits memory
SENT_GRACE_S = 0.03
"""Time in which pyzmq's thread may mark results as sent before their client counts as a
slow consumer; most frames take longer to filter."""

RECHECK_INTERVAL_S = 0.002
RETRY_AFTER_MS = 100.0
"""Delay after which a client may retry a dropped frame."""

FrameReply = Dropped | ErrorReply | list[Any]
"""Reply to a frame; a result is given as the parts of its message."""


class FrameQueue:
    """Queues frames of one device, passes them to its worker and returns the replies.

    Parameters
    ----------
    sessions : callable
        Returns the sessions on this device with a connected client.
    render : RenderClient
    send : callable
        ``send(peer, reply)`` sends a reply or the parts of one, and returns a tracker
        if it is large.

    Attributes
    ----------
    n_rendered, n_dropped : int
    filtered_s : float
        Total time spent filtering.
    load : Load
        Recent filtering time.
    """

    def __init__(
        self,
        sessions: Callable[[], Sequence[Session]],
        render: RenderClient,
        send: Callable[[Peer, Reply | list[Any]], Tracker | None],
    ) -> None:
        self.n_rendered = self.n_dropped = 0
        self.filtered_s = 0.0
        self.load = Load()
        self._sessions = sessions
        self._render = render
        self._send = send
        self._queue: FairQueue[str] = FairQueue()
        self._orphaned: UnsentResults = []  # being sent to vanished clients

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until a frame may be submitted; None if none is queued."""
        ready_for_worker = [s for s in self._sessions() if self._can_submit(s)]
        if any(self._is_ready(session, now_s) for session in ready_for_worker):
            return 0.0
        return RECHECK_INTERVAL_S if ready_for_worker else None

    @property
    def is_idle(self) -> bool:
        """Return whether no frame is queued or being filtered."""
        waits = any(session.waiting for session in self._sessions())
        return not waits and not self._render.in_flight

    def reclaim_sent(self) -> None:
        """Reclaim the memory of results that have been sent."""
        self._orphaned = self._render.release_sent(self._orphaned)

    def disconnect(self, session: Session) -> None:
        """Keep results for a vanished client until libzmq has released them."""
        self._orphaned += session.unsent
        session.unsent = []

    def charge(self, session: Session, used_s: float) -> None:
        """Charge a session for work other than its frames."""
        self._queue.charge(session.key, used_s)

    def forget(self, session: Session) -> None:
        """Forget the time that a session has used."""
        self._queue.forget(session.key)

    def enqueue(
        self, session: Session, frame: Frame, header: bytes, received_s: float
    ) -> Frame | None:
        """Queue a frame as its client's newest; return the frame that it supersedes.

        Raises
        ------
        BadMessage
            If its positions in shared memory are invalid.
        CreditExceeded
            If the client has too many unanswered frames.
        """
        check_positions(session, frame)
        waiting = WaitingFrame(frame, header, received_s, time.monotonic())
        superseded = session.enqueue(waiting)
        session.mark_in_use(frame)
        self._queue.mark_waiting(session.key)
        return None if superseded is None else superseded.frame

    def _can_submit(self, session: Session) -> bool:
        waiting = session.waiting
        return waiting is not None and self._render.can_accept(session, waiting.frame)

    def _is_ready(self, session: Session, now_s: float) -> bool:
        """Return whether to submit or drop a session's frame now."""
        session.unsent = self._render.release_sent(session.unsent)
        if not self._is_slow_consumer(session):
            session.slow_since_s = None
            return True
        if session.slow_since_s is None:
            session.slow_since_s = now_s
        return now_s - session.slow_since_s > SENT_GRACE_S

    def _is_slow_consumer(self, session: Session) -> bool:
        """Return whether a client has too many unread results."""
        n_bytes = sum(slot.size_bytes for _, slot in session.unsent)
        return (
            len(session.unsent) >= MAX_UNSENT_RESULTS
            or n_bytes > self._render.session_quota_bytes
        )

    def submit_next(self) -> None:
        """Submit the next frame to the worker, or drop it, if one is ready."""
        now_s = time.monotonic()
        ready = {
            s.key: s
            for s in self._sessions()
            if self._can_submit(s) and self._is_ready(s, now_s)
        }
        key = self._queue.pop_next(ready)
        if key is None:
            return
        session = ready[key]
        waiting, session.waiting = session.waiting, None
        if waiting is None:
            return
        frame = waiting.frame
        if self._is_slow_consumer(session):
            dropped = Dropped(frame.frame_id, "slow_consumer")
            self.reply(session, frame, dropped)
            return
        try:
            self._render.submit(session, waiting)
        except OutOfMemory as error:
            failed = ErrorReply.from_exception(error, frame_id=frame.frame_id)
            self.reply(session, frame, failed)

    def accept_result(
        self,
        number: int,
        reply: dict[str, Any] | Dropped | ErrorReply,
        started_s: float,
        ended_s: float,
        used_s: float,
        blocks_bytes: Sequence[int],
    ) -> None:
        """Forward a reply of the render worker to its client; see `result_parts`."""
        submitted = self._render.pop_frame(number)
        if submitted is None:
            return
        # A frame that is filtered during another one delays no client.
        queued_since_s = (
            started_s if self._render.in_flight else submitted.waiting.decoded_s
        )
        self._queue.record_frame(
            submitted.session.key, used_s, queued_since_s, started_s, ended_s
        )
        self.filtered_s += used_s
        self.load.add(used_s, ended_s)
        sent: FrameReply
        if isinstance(reply, dict):
            sent = result_parts(reply, submitted, started_s, blocks_bytes)
        elif isinstance(reply, Dropped):
            sent = replace(reply, retry_after_ms=RETRY_AFTER_MS)
        else:
            sent = reply
        tracker = self._reply_in_flight(submitted, sent)
        if not submitted.pool_slots:
            return
        slot, result_slot = submitted.pool_slots
        self._render.release(slot)
        if tracker is None:
            self._render.release(result_slot)
        elif submitted.session.peer is None:
            self._orphaned.append((tracker, result_slot))
        else:
            submitted.session.unsent.append((tracker, result_slot))

    def _reply_in_flight(
        self, submitted: InFlightFrame, reply: FrameReply
    ) -> Tracker | None:
        """Reply to a submitted frame if its client is still on the same connection."""
        if submitted.peer is None or submitted.session.peer != submitted.peer:
            return None
        return self.reply(submitted.session, submitted.waiting.frame, reply)

    def reply(
        self, session: Session, frame: Frame, reply: FrameReply
    ) -> Tracker | None:
        """Reply to a frame, and return its credit to the client."""
        if session.peer is None:
            return None  # its client has disconnected
        session.n_unanswered = max(0, session.n_unanswered - 1)
        session.mark_free(frame)
        if isinstance(reply, list):
            self.n_rendered += 1
        else:
            self.n_dropped += 1
        return self._send(session.peer, reply)

    def fail_waiting(self, session: Session) -> None:
        """Reply to a session's queued frame with an error: its device has failed."""
        waiting, session.waiting = session.waiting, None
        if waiting is not None:
            error = RenderFailed("the device of this session failed")
            frame = waiting.frame
            failed = ErrorReply.from_exception(error, frame_id=frame.frame_id)
            self.reply(session, frame, failed)

    def fail_in_flight(self) -> None:
        """Reply with an error to the frames that were lost with a render worker."""
        for lost in self._render.disconnect():
            error = RenderFailed("the render worker exited and is being restarted")
            frame_id = lost.waiting.frame.frame_id
            self._reply_in_flight(
                lost, ErrorReply.from_exception(error, frame_id=frame_id)
            )
