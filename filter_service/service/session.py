"""One client's session: its waiting frame, its credit, the profiles of its eyes.

State only: no sockets.  `door` acts on what it says.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from typing import Self

from filter_service.errors import CreditExceeded
from filter_service.messages import EyeName, Frame, ProfileRequest
from filter_service.service.connections import Peer
from filter_service.service.mailbox import Tracker
from filter_service.slots import Slot

KEY_BYTES = 16
MAX_RECORDED_BYTES = 65_536
"""Of a profile's body, as JSON: 100 measurements of 28 coefficients take 60,000.  The
client of a larger one sends it again where the service has lost it."""


@dataclass(frozen=True)
class WaitingFrame:
    """A frame with the times that its stages need."""

    frame: Frame
    received_s: float
    decoded_s: float


def new_key() -> str:
    """Return a key that nobody guesses."""
    return secrets.token_hex(KEY_BYTES)


@dataclass
class EyeProfiles:
    """The profiles of one eye: the last that was accepted, and those to come."""

    profile: ProfileRequest | None = None  # the last that was accepted
    asked_profile: ProfileRequest | None = None  # on its way
    next_profile: ProfileRequest | None = None  # waits for the one on its way
    profile_id: int | None = None
    generation: int = 0
    next_ask_s: float = 0.0  # no sooner is another one asked for

    def record(self) -> EyeProfiles:
        """Return the accepted profile alone, without its body where that is large."""
        profile = self.profile
        if profile is not None and len(profile.parts()[0]) > MAX_RECORDED_BYTES:
            profile = None
        return EyeProfiles(
            profile, profile_id=self.profile_id, generation=self.generation
        )


@dataclass(frozen=True)
class SessionRecord:
    """A session as the supervisor keeps it, in case the front end ends."""

    session_id: int
    key: str
    owner: str
    client: str
    credit: int
    device: int
    eyes: dict[EyeName, EyeProfiles]


@dataclass(eq=False)
class Session:
    """What the service knows of one client.

    Parameters
    ----------
    session_id : int
    peer : Peer, optional
        The client's connection; None while it is away.
    client : str
        What it calls itself.
    credit : int
        Frames it may have unanswered.
    key : str
        With which it may come back.
    owner : str
        The CURVE key of the client that began it, which alone may come back; empty
        where the service has no keys.
    device : int
        Index of the device that its eyes are on.
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
    behind_since_s: float | None = None  # too many of them
    shared: dict[int, Slot] = field(default_factory=dict)  # memory of the client
    lent: set[int] = field(default_factory=set)  # of those, in use by frames
    away_since_s: float | None = None
    last_connection: int = 0
    eyes: dict[EyeName, EyeProfiles] = field(default_factory=dict)

    def eye(self, name: EyeName) -> EyeProfiles:
        """Return the profiles of an eye."""
        return self.eyes.setdefault(name, EyeProfiles())

    def record(self) -> SessionRecord:
        """Return what is kept of the session while this process is started again."""
        return SessionRecord(
            *(self.session_id, self.key, self.owner, self.client, self.credit),
            *(self.device, {name: eye.record() for name, eye in self.eyes.items()}),
        )

    @classmethod
    def restored(cls, record: SessionRecord, now_s: float) -> Self:
        """Return a session as it was; its client is away."""
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
        """Return the last accepted profile of each eye."""
        return {
            name: eye.profile_id
            for name, eye in self.eyes.items()
            if eye.profile_id is not None
        }

    @property
    def asks(self) -> bool:
        """Return whether a profile is on its way."""
        return any(eye.asked_profile is not None for eye in self.eyes.values())

    def take_in(self, waiting: WaitingFrame) -> WaitingFrame | None:
        """Keep a frame as the newest; return the one that it supersedes.

        Raises
        ------
        CreditExceeded
            The client has too many unanswered frames; this one is not kept.
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
        """Note that a frame uses memory of the client."""
        if frame.memory is not None:
            self.lent |= {frame.memory.slot, frame.memory.result_slot}

    def get_back(self, frame: Frame) -> None:
        """Note that it does not any more."""
        if frame.memory is not None:
            self.lent -= {frame.memory.slot, frame.memory.result_slot}

    def leave(self, now_s: float) -> None:
        """Note that the client is away; what it waited for it does not wait for."""
        if self.peer is not None:
            self.last_connection = self.peer.connection
        self.peer = None
        self.away_since_s = now_s
        self.waiting = None
        self.n_unanswered = 0

    def come_back(self, peer: Peer, client: str) -> None:
        """Note that the client is there again, or from somewhere else."""
        self.peer, self.client = peer, client
        self.away_since_s = None
        self.waiting = None
        self.n_unanswered = 0
