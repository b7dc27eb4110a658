"""Fair queuing of frames by the time that they take, not by their number."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

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
