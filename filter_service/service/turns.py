"""Whose frame is next: sessions share processor time, not numbers of frames."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

Client = TypeVar("Client", bound=Hashable)

MAX_CLAIM_S = 0.5
"""Of the time that others used while a session asked for nothing, it may catch up so
much: enough for the round trip between two frames, and no more than makes a heavy
client wait for a second or two where many light ones pause."""

MAX_DEBT_S = 20.0
"""What one frame may cost its session in turns; a frame that hung for a minute would
otherwise keep it waiting for that long beside each other session."""


@dataclass
class _Share:
    used_s: float
    is_waiting: bool = False


class Turns(Generic[Client]):
    """Fair queuing: of the sessions that wait, the one that has used least is next.

    A session that begins to wait has used as much as the one served last, less
    `MAX_CLAIM_S` at most.  So nobody owes more than its own last frame, and nobody can
    save up claims.
    """

    def __init__(self) -> None:
        self._shares: dict[Client, _Share] = {}
        self._level_s = 0.0  # what the session served last had used before
        self._free_since_s = 0.0  # when the last frame ended

    def arrive(self, client: Client) -> None:
        """Note that a session has a frame waiting."""
        share = self._shares.setdefault(client, _Share(self._level_s))
        if not share.is_waiting:
            share.used_s = max(share.used_s, self._level_s - MAX_CLAIM_S)
            share.is_waiting = True

    def next_of(self, waiting: Iterable[Client]) -> Client | None:
        """Return whose turn it is; all of those who wait have arrived."""
        chosen = min(
            waiting, key=lambda client: self._shares[client].used_s, default=None
        )
        if chosen is not None:
            share = self._shares[chosen]
            self._level_s = max(self._level_s, share.used_s)
            share.is_waiting = False
        return chosen

    def note(
        self,
        client: Client,
        used_s: float,
        here_since_s: float,
        started_s: float,
        ended_s: float,
    ) -> None:
        """Note what a session's frame has taken, and what it took to begin it.

        From the end of one frame to the start of the next, nobody is served.  Frames of
        160x90 that take 5 ms have 4 ms of that: uncounted, they left a large frame
        beside them waiting for 1.8 times what equal shares allow.
        """
        idle_s = max(0.0, started_s - max(self._free_since_s, here_since_s))
        self._free_since_s = max(self._free_since_s, ended_s)
        share = self._shares.get(client)
        if share is not None:
            share.used_s += min(used_s + idle_s, MAX_DEBT_S)

    def forget(self, client: Client) -> None:
        """Forget a session that has ended."""
        self._shares.pop(client, None)
