"""Queue of frames: from the clients to the render worker, and the replies back.

Every frame is answered once.  The order depends on the time that each client has used.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from filter_service.errors import OutOfMemory, RenderFailed
from filter_service.messages import Dropped, ErrorReply, Frame, Reply, Result
from filter_service.service.connections import Peer
from filter_service.service.fair_queue import FairQueue
from filter_service.service.image_positions import check_positions
from filter_service.service.load import Load
from filter_service.service.render_client import Held, RenderClient, Unsent, completed
from filter_service.service.router import Tracker
from filter_service.service.session import Session, WaitingFrame

MAX_UNSENT_RESULTS = 4  # large replies that a client has not read; bounds memory
MARK_SENT_S = 0.03  # less than most frames take to filter
SOON_S = 0.002
RETRY_AFTER_MS = 100.0
"""Delay after which a client may retry a dropped frame."""

Answer = Result | Dropped | ErrorReply


class FrameQueue:
    """Queues frames of one device, passes them to its worker and returns the replies.

    Parameters
    ----------
    sessions : callable
        Returns the sessions on this device that have a client.
    render : RenderClient
    send : callable
        ``send(peer, reply)`` returns the tracker of a large reply.

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
        send: Callable[[Peer, Reply], Tracker | None],
    ) -> None:
        self.n_rendered = self.n_dropped = 0
        self.filtered_s = 0.0
        self.load = Load()
        self._sessions = sessions
        self._render = render
        self._send = send
        self._queue: FairQueue[str] = FairQueue()
        self._leaving: Unsent = []  # results sent to clients that are gone

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until a frame may be handed over; None if no frame waits."""
        takeable = [s for s in self._sessions() if self._is_takeable(s)]
        if any(self._is_ready(session, now_s) for session in takeable):
            return 0.0
        return SOON_S if takeable else None

    @property
    def is_idle(self) -> bool:
        """Return whether no frame waits or is being filtered."""
        waits = any(session.waiting for session in self._sessions())
        return not waits and not self._render.held

    def tidy(self) -> None:
        """Reclaim the memory of results that have been sent."""
        self._leaving = self._render.still_unsent(self._leaving)

    def leave(self, session: Session) -> None:
        """Handle a vanished client, which may never read the results being sent."""
        self._leaving += session.unsent
        session.unsent = []

    def forget(self, session: Session) -> None:
        """Forget the time that a session has used."""
        self._queue.forget(session.key)

    def take_in(
        self, session: Session, frame: Frame, received_s: float
    ) -> Frame | None:
        """Queue a frame as its client's newest; return the frame that it supersedes."""
        check_positions(session, frame)
        waiting = WaitingFrame(frame, received_s, time.monotonic())
        superseded = session.take_in(waiting)
        session.lend(frame)
        self._queue.arrive(session.key)
        return None if superseded is None else superseded.frame

    def _is_takeable(self, session: Session) -> bool:
        waiting = session.waiting
        return waiting is not None and self._render.takes(session, waiting.frame)

    def _is_ready(self, session: Session, now_s: float) -> bool:
        """Return whether to hand a session's frame over, or to drop it.

        A pyzmq thread marks results as sent.  It is given a moment before the client
        counts as a slow consumer.
        """
        session.unsent = self._render.still_unsent(session.unsent)
        if not self._is_behind(session):
            session.behind_since_s = None
            return True
        if session.behind_since_s is None:
            session.behind_since_s = now_s
        return now_s - session.behind_since_s > MARK_SENT_S

    def _is_behind(self, session: Session) -> bool:
        """Return whether a client has too many unread results to get another."""
        n_bytes = sum(slot.size_bytes for _, slot in session.unsent)
        return (
            len(session.unsent) >= MAX_UNSENT_RESULTS
            or n_bytes > self._render.session_quota_bytes
        )

    def submit_one(self) -> None:
        """Hand over the next frame by fair queuing, if any may be handed over."""
        now_s = time.monotonic()
        ready = {
            s.key: s
            for s in self._sessions()
            if self._is_takeable(s) and self._is_ready(s, now_s)
        }
        key = self._queue.next_of(ready)
        if key is None:
            return
        session = ready[key]
        waiting, session.waiting = session.waiting, None
        if waiting is None:
            return
        frame = waiting.frame
        if self._is_behind(session):
            dropped = Dropped(frame.frame_id, "slow_consumer")
            self.answer(session, frame, dropped)
            return
        try:
            self._render.submit(session, waiting)
        except OutOfMemory as error:
            failed = ErrorReply.from_exception(error, frame_id=frame.frame_id)
            self.answer(session, frame, failed)

    def accept_result(
        self,
        number: int,
        reply: Answer,
        started_s: float,
        ended_s: float,
        used_s: float,
        blocks_bytes: Sequence[int],
    ) -> None:
        """Pass a reply of the render worker on to its client."""
        held = self._render.take_back(number)
        if held is None:
            return
        # A frame filtered during another one delayed nobody.
        here_s = started_s if self._render.held else held.waiting.decoded_s
        self._queue.note(held.session.key, used_s, here_s, started_s, ended_s)
        self.filtered_s += used_s
        self.load.note(used_s, ended_s)
        if isinstance(reply, Result):
            reply = completed(reply, held, started_s, blocks_bytes)
        elif isinstance(reply, Dropped):
            reply = replace(reply, retry_after_ms=RETRY_AFTER_MS)
        tracker = self._answer_held(held, reply)
        if not held.own_slots:
            return
        slot, result_slot = held.own_slots
        self._render.give_back(slot)
        if tracker is None:
            self._render.give_back(result_slot)
        elif held.session.peer is None:
            self._leaving.append((tracker, result_slot))
        else:
            held.session.unsent.append((tracker, result_slot))

    def _answer_held(self, held: Held, answer: Answer) -> Tracker | None:
        """Answer a frame if its client is still on the same connection."""
        if held.peer is None or held.session.peer != held.peer:
            return None
        return self.answer(held.session, held.waiting.frame, answer)

    def answer(self, session: Session, frame: Frame, answer: Answer) -> Tracker | None:
        """Answer a frame that counts against the credit."""
        if session.peer is None:
            return None  # its client is away
        session.n_unanswered = max(0, session.n_unanswered - 1)
        session.get_back(frame)
        if isinstance(answer, Result):
            self.n_rendered += 1
        else:
            self.n_dropped += 1
        return self._send(session.peer, answer)

    def lose_waiting(self, session: Session) -> None:
        """Answer a session's waiting frame with an error: its device is gone."""
        waiting, session.waiting = session.waiting, None
        if waiting is not None:
            error = RenderFailed("the device that filtered these frames failed")
            frame = waiting.frame
            failed = ErrorReply.from_exception(error, frame_id=frame.frame_id)
            self.answer(session, frame, failed)

    def lose_held(self) -> None:
        """Answer the frames that were lost with a render worker."""
        for lost in self._render.lose():
            error = RenderFailed("the render worker ended and is being restarted")
            frame_id = lost.waiting.frame.frame_id
            self._answer_held(lost, ErrorReply.from_exception(error, frame_id=frame_id))
