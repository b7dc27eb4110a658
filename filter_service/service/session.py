"""One client's session: its waiting frame, its credit, the profiles of its eyes.

State only: no sockets.  `door` acts on what it says.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field

from filter_service.errors import CreditExceeded
from filter_service.messages import EyeName, Frame, ProfileRequest
from filter_service.service.mailbox import Tracker
from filter_service.slots import Slot

KEY_BYTES = 16


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


@dataclass(eq=False)
class Session:
    """What the service knows of one client.

    Parameters
    ----------
    session_id : int
    identity : bytes, optional
        The client's routing id; None while it is away.
    client : str
        What it calls itself.
    credit : int
        Frames it may have unanswered.
    key : str
        With which it may come back.
    device : int
        Index of the device that its eyes are on.
    """

    session_id: int
    identity: bytes | None
    client: str
    credit: int
    key: str = field(default_factory=new_key)
    device: int = 0
    n_unanswered: int = 0
    waiting: WaitingFrame | None = None
    unsent: list[tuple[Tracker, Slot]] = field(default_factory=list)  # large replies
    behind_since_s: float | None = None  # too many of them
    shared: dict[int, Slot] = field(default_factory=dict)  # memory of the client
    lent: set[int] = field(default_factory=set)  # of those, in use by frames
    away_since_s: float | None = None
    eyes: dict[EyeName, EyeProfiles] = field(default_factory=dict)

    def eye(self, name: EyeName) -> EyeProfiles:
        """Return the profiles of an eye."""
        return self.eyes.setdefault(name, EyeProfiles())

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
        self.identity = None
        self.away_since_s = now_s
        self.waiting = None
        self.n_unanswered = 0

    def come_back(self, identity: bytes, client: str) -> None:
        """Note that the client is there again, or from somewhere else."""
        self.identity, self.client = identity, client
        self.away_since_s = None
        self.waiting = None
        self.n_unanswered = 0
