"""State of one client's session: queued frame, credit and profiles of its eyes.

This module contains no I/O; the front end acts on the state.
"""

from __future__ import annotations

import secrets
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Self

from filter_service.errors import CreditExceeded
from filter_service.messages import (
    EyeName,
    Frame,
    ProfileRequest,
    ShareTexture,
    used_textures,
)
from filter_service.service.connections import Peer
from filter_service.service.router import Tracker
from filter_service.shared_memory import Slot

KEY_BYTES = 16
MAX_RECORDED_BYTES = 65_536
"""Largest JSON body of a profile that survives a restart of the front end: 100
measurements of 28 coefficients take 60,000 bytes.  A client sends a larger one again if
the service has lost it."""


@dataclass(frozen=True)
class WaitingFrame:
    """A queued frame, its header, and the times of its receipt and decoding."""

    frame: Frame
    header: bytes
    received_s: float
    decoded_s: float


@dataclass
class ClientTexture:
    """A texture that a client has shared.

    Attributes
    ----------
    request : ShareTexture
    is_imported : bool
        Whether the render worker has imported it.
    """

    request: ShareTexture
    is_imported: bool = False


def new_key() -> str:
    """Return a random session key."""
    return secrets.token_hex(KEY_BYTES)


@dataclass
class EyeProfiles:
    """The profiles of one eye.

    Attributes
    ----------
    profile : ProfileRequest, optional
        Last one that the render worker accepted.
    sent_profile : ProfileRequest, optional
        Sent to the render worker, which has not accepted it yet.
    queued_profile : ProfileRequest, optional
        Newest one, to be sent next.
    profile_id, generation : int
        Numbers of the last accepted profile.
    next_send_s : float
        Earliest time to send the queued profile.
    """

    profile: ProfileRequest | None = None
    sent_profile: ProfileRequest | None = None
    queued_profile: ProfileRequest | None = None
    profile_id: int | None = None
    generation: int = 0
    next_send_s: float = 0.0

    def record(self) -> EyeProfiles:
        """Return a copy with the accepted profile only; without it if it is large."""
        profile = self.profile
        if profile is not None and len(profile.parts()[0]) > MAX_RECORDED_BYTES:
            profile = None
        return EyeProfiles(
            profile, profile_id=self.profile_id, generation=self.generation
        )


@dataclass(frozen=True)
class SessionRecord:
    """State of a session that the supervisor stores for a restart of the front end."""

    session_id: int
    key: str
    owner: str
    client: str
    credit: int
    device: int
    eyes: dict[EyeName, EyeProfiles]


@dataclass(eq=False)
class Session:
    """State of one client.

    Parameters
    ----------
    session_id : int
    peer : Peer, optional
        The client's connection; None while it is disconnected.
    client : str
        Name of the client, from hello.
    credit : int
        Maximum number of unanswered frames.
    key : str
        Session key, which resumes the session.
    owner : str
        CURVE key of the client that started the session; only a client with this key
        may resume it.  Empty if the service has no keys.
    device : int
        Index of its device.
    """

    session_id: int
    peer: Peer | None
    client: str
    credit: int
    key: str = field(default_factory=new_key)
    owner: str = ""
    device: int = 0
    n_unanswered: int = 0
    waiting: WaitingFrame | None = None
    unsent: list[tuple[Tracker, Slot]] = field(default_factory=list)  # being sent
    slow_since_s: float | None = None  # since when too many are unsent
    shared: dict[int, Slot] = field(default_factory=dict)  # by number
    slots_in_use: set[int] = field(default_factory=set)  # numbers; used by frames
    textures: dict[int, ClientTexture] = field(default_factory=dict)  # by number
    textures_in_use: set[int] = field(default_factory=set)
    disconnected_since_s: float | None = None
    last_connection: int = 0
    eyes: dict[EyeName, EyeProfiles] = field(default_factory=dict)
    next_profile_s: float = 0.0  # earliest time of its next profile

    def eye(self, name: EyeName) -> EyeProfiles:
        """Return the profiles of an eye."""
        return self.eyes.setdefault(name, EyeProfiles())

    def record(self) -> SessionRecord:
        """Return the state that survives a restart of the front end."""
        return SessionRecord(
            *(self.session_id, self.key, self.owner, self.client, self.credit),
            *(self.device, {name: eye.record() for name, eye in self.eyes.items()}),
        )

    @classmethod
    def restored(cls, record: SessionRecord, now_s: float) -> Self:
        """Return a session from its record, disconnected."""
        session = cls(
            *(record.session_id, None, record.client, record.credit),
            key=record.key,
            owner=record.owner,
            device=record.device,
            eyes=dict(record.eyes),
        )
        session.disconnect(now_s)
        return session

    @property
    def profile_ids(self) -> dict[EyeName, int]:
        """Return the id of the last accepted profile of each eye."""
        return {
            name: eye.profile_id
            for name, eye in self.eyes.items()
            if eye.profile_id is not None
        }

    @property
    def has_pending_profile(self) -> bool:
        """Return whether the render worker has yet to accept a profile."""
        return any(eye.sent_profile is not None for eye in self.eyes.values())

    def enqueue(self, waiting: WaitingFrame) -> WaitingFrame | None:
        """Queue a frame; return the older one that it supersedes.

        Raises
        ------
        CreditExceeded
            If the client has too many unanswered frames; the frame is then discarded.
        """
        if self.n_unanswered >= self.credit:
            raise CreditExceeded(
                f"{self.n_unanswered} frames are unanswered",
                field="frame_id",
                allowed=f"{self.credit} unanswered frames",
            )
        self.n_unanswered += 1
        superseded, self.waiting = self.waiting, waiting
        return superseded

    def mark_in_use(self, frame: Frame) -> None:
        """Mark the slots and textures of a frame as in use."""
        self.textures_in_use |= used_textures(frame.textures)
        if frame.memory is not None:
            self.slots_in_use |= {frame.memory.slot, frame.memory.result_slot}

    def mark_free(self, frame: Frame) -> None:
        """Mark the slots and textures of a frame as free."""
        self.textures_in_use -= used_textures(frame.textures)
        if frame.memory is not None:
            self.slots_in_use -= {frame.memory.slot, frame.memory.result_slot}

    def disconnect(self, now_s: float) -> None:
        """Detach the client; discard its queued frame and reset its credit."""
        if self.peer is not None:
            self.last_connection = self.peer.connection
        self.peer = None
        self.disconnected_since_s = now_s
        self.waiting = None
        self.n_unanswered = 0

    def reconnect(self, peer: Peer, client: str) -> None:
        """Attach a client that resumes the session."""
        self.peer, self.client = peer, client
        self.disconnected_since_s = None
        self.waiting = None
        self.n_unanswered = 0


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
