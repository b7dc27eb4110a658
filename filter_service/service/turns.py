"""Whose frame is next: clients share time, not numbers of frames."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

Client = TypeVar("Client", bound=Hashable)

PAUSE_S = 1.0
"""Who asks for nothing for longer has no claim on the time that passed meanwhile."""


@dataclass
class _Share:
    used_s: float
    active_s: float  # when it last asked for something, or was answered


class Turns(Generic[Client]):
    """Time used by each client; of those who wait, who has used least is next."""

    def __init__(self) -> None:
        self._shares: dict[Client, _Share] = {}
        self._level_s = 0.0  # what the client served last had used before

    def arrive(self, client: Client, now_s: float) -> None:
        """Note that a client asks for something."""
        share = self._shares.setdefault(client, _Share(self._level_s, now_s))
        if now_s - share.active_s > PAUSE_S:
            share.used_s = max(share.used_s, self._level_s)
        share.active_s = now_s

    def next_of(self, waiting: Iterable[Client]) -> Client | None:
        """Return whose turn it is; all of those who wait have arrived."""
        chosen = min(
            waiting, key=lambda client: self._shares[client].used_s, default=None
        )
        if chosen is not None:
            self._level_s = max(self._level_s, self._shares[chosen].used_s)
        return chosen

    def note(self, client: Client, time_s: float, now_s: float) -> None:
        """Note what a client's frame has taken."""
        share = self._shares.get(client)
        if share is not None:
            share.used_s += time_s
            share.active_s = now_s

    def forget(self, client: Client) -> None:
        """Forget a client that is gone."""
        self._shares.pop(client, None)
