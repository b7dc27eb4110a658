"""The front end's state of each device: its render client and frame queue.

A session, with its eyes and shared memory, stays on its device until the device is
taken out of service.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from filter_service.messages import DeviceState, Reply
from filter_service.service.connections import DescriptorLimit, Peer
from filter_service.service.frame_queue import FrameQueue
from filter_service.service.process_channel import WorkerMemory
from filter_service.service.render_client import RenderClient
from filter_service.service.router import Tracker
from filter_service.service.session import Session, SessionTable
from filter_service.texture_view import TextureSupport


class ServedDevice:
    """The front end's state of one device.

    Parameters
    ----------
    index : int
        Index in the settings.
    name : str
        Name of the device in the settings.
    max_image_bytes : int
        Memory for the images of its sessions.
    descriptors : DescriptorLimit
        Descriptor limit of this process.
    sessions : SessionTable
        Sessions of all devices.
    send : callable
        See `FrameQueue`.

    Attributes
    ----------
    render : RenderClient
    frames : FrameQueue
        Frames of its sessions.
    server : dict, optional
        Description reported by its render worker; None until then.
    texture_support : TextureSupport, optional
        Textures that its render worker imports; None if it imports none.
    memory : WorkerMemory
    is_building : bool
        State last reported by its render worker.
    is_lost : bool
        Whether it is out of service; then no session is on it.
    """

    def __init__(
        self,
        index: int,
        name: str,
        max_image_bytes: int,
        descriptors: DescriptorLimit,
        sessions: SessionTable,
        send: Callable[[Peer, Reply | list[Any]], Tracker | None],
    ) -> None:
        self.index = index
        self.name = name
        self.render = RenderClient(max_image_bytes, descriptors)
        self.frames = FrameQueue(
            partial(sessions.connected_on, index), self.render, send
        )
        self.server: dict[str, str] | None = None
        self.texture_support: TextureSupport | None = None
        self.memory = WorkerMemory()
        self.is_building = self.is_lost = False

    def mark_lost(self) -> None:
        """Mark the device as out of service."""
        self.is_lost, self.is_building = True, False
        self.memory = WorkerMemory()

    def state(self, sessions: Sequence[Session]) -> DeviceState:
        """Return the device's state for `pong`, given its connected sessions."""
        return DeviceState(
            name=self.name,
            renderer=(self.server or {}).get("renderer", ""),
            n_sessions=len(sessions),
            busy_ratio=self.frames.load.busy_ratio(time.monotonic()),
            n_rendered=self.frames.n_rendered,
            memory_mb=self.memory.resident_mb,
            is_ready=self.render.is_ready,
            is_filtering=bool(self.render.in_flight),
            is_building=self.is_building
            or any(s.has_pending_profile for s in sessions),
            is_lost=self.is_lost,
            render_silent_s=self.render.silent_s,
        )


class ServedDevices:
    """All devices of the service.

    Parameters
    ----------
    names : sequence of str
    max_image_bytes : int
        Image memory of all devices, divided equally among them.
    descriptors, sessions, send
        See `ServedDevice`.
    """

    def __init__(
        self,
        names: Sequence[str],
        max_image_bytes: int,
        descriptors: DescriptorLimit,
        sessions: SessionTable,
        send: Callable[[Peer, Reply | list[Any]], Tracker | None],
    ) -> None:
        self._sessions = sessions
        self._devices = [
            ServedDevice(
                *(index, name, max_image_bytes // len(names)),
                *(descriptors, sessions, send),
            )
            for index, name in enumerate(names)
        ]

    def __iter__(self) -> Iterator[ServedDevice]:
        """Iterate over the devices in order."""
        return iter(self._devices)

    def __len__(self) -> int:
        """Return the number of devices."""
        return len(self._devices)

    def __getitem__(self, index: int) -> ServedDevice:
        """Return a device by its index."""
        return self._devices[index]

    def device_of(self, session: Session) -> ServedDevice:
        """Return the device of a session."""
        return self._devices[session.device]

    def least_busy(self) -> ServedDevice:
        """Return the device for a new session.

        Ready devices come first, then those with the fewest connected sessions, then
        those with the lowest recent load.
        """
        now_s = time.monotonic()
        return min(
            self._available,
            key=lambda device: (
                not device.render.is_ready,
                len(self._sessions.connected_on(device.index)),
                device.frames.load.busy_ratio(now_s),
            ),
        )

    def states(self) -> tuple[DeviceState, ...]:
        """Return the states of all devices for `pong`."""
        return tuple(
            device.state(self._sessions.connected_on(device.index)) for device in self
        )

    @property
    def _available(self) -> list[ServedDevice]:
        """Return the devices that are in service, at least one."""
        return [device for device in self._devices if not device.is_lost]

    @property
    def have_reported(self) -> bool:
        """Return whether the workers of all devices in service have reported."""
        return all(device.server is not None for device in self._available)

    @property
    def are_ready(self) -> bool:
        """Return whether all devices in service can filter frames."""
        return all(device.render.is_ready for device in self._available)

    @property
    def silent_s(self) -> float:
        """Return the longest time since the last heartbeat of a worker."""
        return max(device.render.silent_s for device in self._available)

    @property
    def memory_mb(self) -> float:
        """Return the total resident memory of the render workers, 10^6 bytes."""
        return sum(device.memory.resident_mb for device in self)

    def descriptors(self) -> dict[int, bool]:
        """Return the descriptors to poll, see `Router.watch`."""
        found = {device.render.fileno(): device.render.has_unsent for device in self}
        return {number: has for number, has in found.items() if number is not None}

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until a frame may be submitted; None if none is queued."""
        waits_s = [device.frames.wait_s(now_s) for device in self]
        return min((s for s in waits_s if s is not None), default=None)
