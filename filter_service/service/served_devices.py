"""The door's side of the devices: frames, memory and news of each, and all together.

A session lives on one of them, with its eyes and its memory, as long as it is there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from filter_service.messages import DeviceState, Reply
from filter_service.service.connections import Peer
from filter_service.service.descriptors import DescriptorLimit
from filter_service.service.frame_desk import FrameDesk
from filter_service.service.guests import Guests
from filter_service.service.mailbox import Tracker
from filter_service.service.render_end import RenderEnd
from filter_service.service.session import Session


class ServedDevice:
    """One device, as the door knows it.

    Parameters
    ----------
    index : int
    name : str
        As the settings have it.
    max_image_bytes : int
        Of the images of its sessions.
    descriptors : DescriptorLimit
        Of this process.
    guests : Guests
    send : callable
        See `FrameDesk`.

    Attributes
    ----------
    render : RenderEnd
    frames : FrameDesk
        Of its sessions.
    server : dict, optional
        What its process says of itself; None until it has.
    memory_mb, stores_mb, is_building
        As that process told last.
    is_lost : bool
        It was given up; no session is on it.
    """

    def __init__(
        self,
        index: int,
        name: str,
        max_image_bytes: int,
        descriptors: DescriptorLimit,
        guests: Guests,
        send: Callable[[Peer, Reply], Tracker | None],
    ) -> None:
        self.index = index
        self.name = name
        self.render = RenderEnd(max_image_bytes, descriptors)
        self.frames = FrameDesk(partial(guests.present_on, index), self.render, send)
        self.server: dict[str, str] | None = None
        self.memory_mb = self.stores_mb = 0.0
        self.is_building = self.is_lost = False

    def give_up(self) -> None:
        """Note that it will not come again."""
        self.is_lost, self.is_building = True, False
        self.memory_mb = self.stores_mb = 0.0

    def state(self, sessions: Sequence[Session]) -> DeviceState:
        """Return what `pong` says of it; the sessions are those with a client."""
        return DeviceState(
            name=self.name,
            renderer=(self.server or {}).get("renderer", ""),
            n_sessions=len(sessions),
            busy_ratio=self.frames.load.busy_ratio(time.monotonic()),
            n_rendered=self.frames.n_rendered,
            memory_mb=self.memory_mb,
            is_ready=self.render.is_ready,
            is_filtering=bool(self.render.held),
            is_building=self.is_building or any(s.asks for s in sessions),
            is_lost=self.is_lost,
            render_silent_s=self.render.silent_s,
        )


class ServedDevices:
    """All devices of the service.

    Parameters
    ----------
    names : sequence of str
    max_image_bytes : int
        Of all of them; each has an equal part, so that none can use up another's.
    descriptors, guests, send
        See `ServedDevice`.
    """

    def __init__(
        self,
        names: Sequence[str],
        max_image_bytes: int,
        descriptors: DescriptorLimit,
        guests: Guests,
        send: Callable[[Peer, Reply], Tracker | None],
    ) -> None:
        self._guests = guests
        self._devices = [
            ServedDevice(
                *(index, name, max_image_bytes // len(names)),
                *(descriptors, guests, send),
            )
            for index, name in enumerate(names)
        ]

    def __iter__(self) -> Iterator[ServedDevice]:
        """Go through them in their order."""
        return iter(self._devices)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._devices)

    def __getitem__(self, index: int) -> ServedDevice:
        """Return one of them."""
        return self._devices[index]

    def of(self, session: Session) -> ServedDevice:
        """Return the device that a session lives on."""
        return self._devices[session.device]

    def least_busy(self) -> ServedDevice:
        """Return the device for a new session.

        One that is ready before one that is being started; then the one with the fewest
        sessions that have a client; then the one that had least to do of late.
        """
        now_s = time.monotonic()
        return min(
            self._left,
            key=lambda device: (
                not device.render.is_ready,
                len(self._guests.present_on(device.index)),
                device.frames.load.busy_ratio(now_s),
            ),
        )

    def states(self) -> tuple[DeviceState, ...]:
        """Return what `pong` says of each."""
        return tuple(
            device.state(self._guests.present_on(device.index)) for device in self
        )

    @property
    def _left(self) -> list[ServedDevice]:
        """Return those that were not given up: one at least."""
        return [device for device in self._devices if not device.is_lost]

    @property
    def are_known(self) -> bool:
        """Return whether each has said who it is."""
        return all(device.server is not None for device in self._left)

    @property
    def are_ready(self) -> bool:
        """Return whether frames of all sessions can be filtered."""
        return all(device.render.is_ready for device in self._left)

    @property
    def silent_s(self) -> float:
        """Return since when one of them has given no sign of life."""
        return max(device.render.silent_s for device in self._left)

    @property
    def memory_mb(self) -> float:
        """Return the memory of all their processes."""
        return sum(device.memory_mb for device in self)

    def descriptors(self) -> tuple[set[int], set[int]]:
        """Return what to poll for reading, and for writing."""
        pairs = [device.render.descriptors() for device in self]
        return set().union(*(r for r, _ in pairs)), set().union(*(w for _, w in pairs))

    def wait_s(self, now_s: float) -> float | None:
        """Return how soon a frame may be handed over; None where none waits."""
        soon_s = [device.frames.wait_s(now_s) for device in self]
        return min((s for s in soon_s if s is not None), default=None)
