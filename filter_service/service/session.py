"""State of one client's session: waiting frame, credit and profiles of its eyes.

This module uses no sockets; `front_end` acts on the state.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from typing import Self

from filter_service.errors import CreditExceeded
from filter_service.messages import EyeName, Frame, ProfileRequest
from filter_service.service.connections import Peer
from filter_service.service.router import Tracker
from filter_service.shared_memory import Slot

KEY_BYTES = 16
MAX_RECORDED_BYTES = 65_536
"""Largest JSON body of a profile that is recorded: 100 measurements of 28 coefficients
take 60,000 bytes.  A client sends a larger one again if the service has lost it."""


@dataclass(frozen=True)
class WaitingFrame:
    """A frame with the times needed for its stage times."""

    frame: Frame
    received_s: float
    decoded_s: float


def new_key() -> str:
    """Return a random key."""
    return secrets.token_hex(KEY_BYTES)


@dataclass
class EyeProfiles:
    """The profiles of one eye: the last accepted one, and those in progress."""

    profile: ProfileRequest | None = None  # last accepted
    asked_profile: ProfileRequest | None = None  # sent to the render worker
    next_profile: ProfileRequest | None = None  # waits for the one sent
    profile_id: int | None = None
    generation: int = 0
    next_ask_s: float = 0.0  # earliest time to send another

    def record(self) -> EyeProfiles:
        """Return a record of the accepted profile; only the numbers of a large one."""
        profile = self.profile
        if profile is not None and len(profile.parts()[0]) > MAX_RECORDED_BYTES:
            profile = None
        return EyeProfiles(
            profile, profile_id=self.profile_id, generation=self.generation
        )


@dataclass(frozen=True)
class SessionRecord:
    """State of a session that the supervisor keeps in case the front end ends."""

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
        The client's connection; None while it is away.
    client : str
        Name that the client gives itself.
    credit : int
        Maximum number of unanswered frames.
    key : str
        Session key, which resumes the session.
    owner : str
        CURVE key of the client that started the session and that alone may resume it;
        empty if the service has no keys.
    device : int
        Index of the device that has its eyes.
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
    unsent: list[tuple[Tracker, Slot]] = field(default_factory=list)  # large replies
    behind_since_s: float | None = None  # since there have been too many of them
    shared: dict[int, Slot] = field(default_factory=dict)  # slots of the client
    lent: set[int] = field(default_factory=set)  # slots in use by frames
    away_since_s: float | None = None
    last_connection: int = 0
    eyes: dict[EyeName, EyeProfiles] = field(default_factory=dict)

    def eye(self, name: EyeName) -> EyeProfiles:
        """Return the profiles of an eye."""
        return self.eyes.setdefault(name, EyeProfiles())

    def record(self) -> SessionRecord:
        """Return the state that survives a restart of this process."""
        return SessionRecord(
            *(self.session_id, self.key, self.owner, self.client, self.credit),
            *(self.device, {name: eye.record() for name, eye in self.eyes.items()}),
        )

    @classmethod
    def restored(cls, record: SessionRecord, now_s: float) -> Self:
        """Return a session from its record; its client is away."""
        session = cls(
            *(record.session_id, None, record.client, record.credit),
            key=record.key,
            owner=record.owner,
            device=record.device,
            eyes=dict(record.eyes),
        )
        session.leave(now_s)
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
    def asks(self) -> bool:
        """Return whether the render worker has yet to accept a profile."""
        return any(eye.asked_profile is not None for eye in self.eyes.values())

    def take_in(self, waiting: WaitingFrame) -> WaitingFrame | None:
        """Store a frame as the newest; return the one that it supersedes.

        Raises
        ------
        CreditExceeded
            If the client has too many unanswered frames; this one is then discarded.
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

    def lend(self, frame: Frame) -> None:
        """Mark the client's slots that a frame uses."""
        if frame.memory is not None:
            self.lent |= {frame.memory.slot, frame.memory.result_slot}

    def get_back(self, frame: Frame) -> None:
        """Unmark the client's slots that a frame has used."""
        if frame.memory is not None:
            self.lent -= {frame.memory.slot, frame.memory.result_slot}

    def leave(self, now_s: float) -> None:
        """Mark the client as away; discard its waiting frame and reset its credit."""
        if self.peer is not None:
            self.last_connection = self.peer.connection
        self.peer = None
        self.away_since_s = now_s
        self.waiting = None
        self.n_unanswered = 0

    def reconnect(self, peer: Peer, client: str) -> None:
        """Attach a reconnected client, or one that takes the session over."""
        self.peer, self.client = peer, client
        self.away_since_s = None
        self.waiting = None
        self.n_unanswered = 0
