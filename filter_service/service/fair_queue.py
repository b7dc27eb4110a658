"""Fair queuing of frames: sessions share processor time, not numbers of frames."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

Client = TypeVar("Client", bound=Hashable)

MAX_CLAIM_S = 0.5
"""Time that an idle session may catch up on: enough for the round trip between two
frames, and little enough that a heavy client waits only a second or two when many light
ones pause."""

MAX_DEBT_S = 20.0
"""Maximum time that one frame counts for its session; otherwise a frame that hung for a
minute would make the session wait that long for each other session."""


@dataclass
class _Share:
    used_s: float
    is_waiting: bool = False


class FairQueue(Generic[Client]):
    """Fair queuing: among waiting sessions, the one that has used the least is next.

    A session that starts to wait counts as having used as much as the one served last,
    less at most `MAX_CLAIM_S`.  So no session owes more than its own last frame, and
    none can accumulate claims.
    """

    def __init__(self) -> None:
        self._shares: dict[Client, _Share] = {}
        self._level_s = 0.0  # time used by the session served last, before
        self._free_since_s = 0.0  # end of the last frame

    def arrive(self, client: Client) -> None:
        """Record that a session has a waiting frame."""
        share = self._shares.setdefault(client, _Share(self._level_s))
        if not share.is_waiting:
            share.used_s = max(share.used_s, self._level_s - MAX_CLAIM_S)
            share.is_waiting = True

    def next_of(self, waiting: Iterable[Client]) -> Client | None:
        """Return the session to serve next; all that wait must have arrived."""
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
        """Record the time that a session's frame took, including the gap before it.

        From the end of one frame to the start of the next, no session is served.  For
        frames of 160x90 that take 5 ms, this gap is 4 ms.  While it was not counted, a
        large frame beside them waited 1.8 times what equal shares allow.
        """
        idle_s = max(0.0, started_s - max(self._free_since_s, here_since_s))
        self._free_since_s = max(self._free_since_s, ended_s)
        share = self._shares.get(client)
        if share is not None:
            share.used_s += min(used_s + idle_s, MAX_DEBT_S)

    def forget(self, client: Client) -> None:
        """Forget a session that has ended."""
        self._shares.pop(client, None)
