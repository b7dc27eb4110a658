"""All sessions of the service, with or without a connected client."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from filter_service.service.connections import Peer
from filter_service.service.session import Session


class SessionTable:
    """Sessions, by connection while their client is connected and by key while not."""

    def __init__(self) -> None:
        self._present: dict[int, Session] = {}
        self._away: dict[str, Session] = {}
        self._next_id = 1

    def __len__(self) -> int:
        """Return the number of sessions, with or without a client."""
        return len(self._present) + len(self._away)

    def __iter__(self) -> Iterator[Session]:
        """Iterate over all sessions."""
        return iter([*self._present.values(), *self._away.values()])

    @property
    def connections(self) -> Collection[int]:
        """Return a live view of the connections that have a session."""
        return self._present.keys()

    @property
    def present(self) -> list[Session]:
        """Return the sessions that have a client."""
        return list(self._present.values())

    @property
    def away(self) -> list[Session]:
        """Return the sessions without a client, longest away first."""
        return sorted(self._away.values(), key=lambda s: s.away_since_s or 0.0)

    def at(self, peer: Peer) -> Session | None:
        """Return the session of a client."""
        return self._present.get(peer.connection)

    def on_connection(self, number: int) -> Session | None:
        """Return the session whose client uses a connection, or used it last."""
        found = self._present.get(number)
        if found is not None:
            return found
        return next(
            (s for s in self._away.values() if s.last_connection == number), None
        )

    def by_key(self, key: str) -> Session | None:
        """Return the session with a key."""
        return next((session for session in self if session.key == key), None)

    def present_on(self, device: int) -> list[Session]:
        """Return the sessions on a device that have a client."""
        return [s for s in self._present.values() if s.device == device]

    def begin(
        self, peer: Peer, client: str, credit: int, *, device: int = 0
    ) -> Session:
        """Start a new session on a device."""
        session = Session(
            *(self._next_id, peer, client, credit), owner=peer.key, device=device
        )
        self._next_id += 1
        self._present[peer.connection] = session
        return session

    def remember(self, session: Session) -> None:
        """Add a session restored after a restart; its client is away."""
        self._away[session.key] = session
        self._next_id = max(self._next_id, session.session_id + 1)

    def reconnect(self, session: Session, peer: Peer, client: str) -> None:
        """Resume a session for a client that knows its key."""
        self.remove(session)
        session.reconnect(peer, client)
        self._present[peer.connection] = session

    def leave(self, session: Session, now_s: float) -> None:
        """Keep the session of a client that has gone."""
        self.remove(session)
        session.leave(now_s)
        self._away[session.key] = session

    def remove(self, session: Session) -> None:
        """Remove a session."""
        if session.peer is not None:
            self._present.pop(session.peer.connection, None)
        self._away.pop(session.key, None)
