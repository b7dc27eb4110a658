"""One client's session: its filter, its waiting frame, its credit.

State only: no sockets.  `server` acts on what it says.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from filter_service.errors import CreditExceeded
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.messages import Frame
from filter_service.service.mailbox import Tracker


@dataclass(frozen=True)
class WaitingFrame:
    """A frame with the times that its stages need."""

    frame: Frame
    received_s: float
    decoded_s: float


@dataclass(eq=False)
class Session:
    """What the service knows of one client.

    Parameters
    ----------
    session_id : int
    identity : bytes
        The client's routing id.
    client : str
        What it calls itself.
    credit : int
        Frames it may have unanswered.
    eye_filter : EyeFilter
    """

    session_id: int
    identity: bytes
    client: str
    credit: int
    eye_filter: EyeFilter
    n_unanswered: int = 0
    waiting: WaitingFrame | None = None
    unsent: list[Tracker] = field(default_factory=list)  # large replies

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
