"""All sessions of the service, with or without a connected client."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from filter_service.service.connections import Peer
from filter_service.service.session import Session


class SessionTable:
    """Connected sessions by connection, disconnected ones by key."""

    def __init__(self) -> None:
        self._connected: dict[int, Session] = {}
        self._disconnected: dict[str, Session] = {}
        self._next_id = 1

    def __len__(self) -> int:
        """Return the number of sessions, connected or not."""
        return len(self._connected) + len(self._disconnected)

    def __iter__(self) -> Iterator[Session]:
        """Iterate over all sessions."""
        return iter([*self._connected.values(), *self._disconnected.values()])

    @property
    def connections(self) -> Collection[int]:
        """Return a live view of the numbers of connections that have a session."""
        return self._connected.keys()

    @property
    def connected(self) -> list[Session]:
        """Return the connected sessions."""
        return list(self._connected.values())

    @property
    def disconnected(self) -> list[Session]:
        """Return the disconnected sessions, the first to disconnect first."""
        return sorted(
            self._disconnected.values(), key=lambda s: s.disconnected_since_s or 0.0
        )

    def by_peer(self, peer: Peer) -> Session | None:
        """Return the session of a connected client."""
        return self._connected.get(peer.connection)

    def by_connection(self, number: int) -> Session | None:
        """Return the session whose client uses a connection, or used it last."""
        found = self._connected.get(number)
        if found is not None:
            return found
        return next(
            (s for s in self._disconnected.values() if s.last_connection == number),
            None,
        )

    def by_key(self, key: str) -> Session | None:
        """Return the session with a key."""
        return next((session for session in self if session.key == key), None)

    def connected_on(self, device: int) -> list[Session]:
        """Return the connected sessions on a device."""
        return [s for s in self._connected.values() if s.device == device]

    def create(
        self, peer: Peer, client: str, credit: int, *, device: int = 0
    ) -> Session:
        """Start a new session on a device."""
        session = Session(
            *(self._next_id, peer, client, credit), owner=peer.key, device=device
        )
        self._next_id += 1
        self._connected[peer.connection] = session
        return session

    def restore(self, session: Session) -> None:
        """Add a session that was restored after a restart, disconnected."""
        self._disconnected[session.key] = session
        self._next_id = max(self._next_id, session.session_id + 1)

    def reconnect(self, session: Session, peer: Peer, client: str) -> None:
        """Resume a session for a client."""
        self.remove(session)
        session.reconnect(peer, client)
        self._connected[peer.connection] = session

    def disconnect(self, session: Session, now_s: float) -> None:
        """Mark a session as disconnected."""
        self.remove(session)
        session.disconnect(now_s)
        self._disconnected[session.key] = session

    def remove(self, session: Session) -> None:
        """Remove a session."""
        if session.peer is not None:
            self._connected.pop(session.peer.connection, None)
        self._disconnected.pop(session.key, None)
