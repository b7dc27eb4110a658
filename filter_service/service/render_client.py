"""Render client: the front end's link to a render worker, with memory and frames.

Messages of the worker come from `receive`.  Messages sent while there is no worker are
lost; the front end sends their content again to the next one.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import OutOfMemory
from filter_service.messages import Frame, Result, SharedPlaces
from filter_service.service.connections import Peer
from filter_service.service.descriptors import DescriptorLimit
from filter_service.service.image_positions import result_sizes
from filter_service.service.process_channel import Link, LinkClosed
from filter_service.service.router import Tracker
from filter_service.service.session import Session, WaitingFrame
from filter_service.shared_memory import Slot, SlotPool, starts_of

MS_PER_S = 1000.0

SMALLER_RATIO = 4
"""Ratio of pixels from which a frame may be filtered during a larger one."""

SESSION_QUOTA = 0.25
"""Share of the image memory that one session may share, or leave unread."""

SHARED_QUOTA = 0.5
"""Share of it that all clients may share; the rest is for frames sent as parts."""

MB = 1e6

Unsent = list[tuple[Tracker, Slot]]


@dataclass(frozen=True)
class Held:
    """A frame that the render worker has."""

    number: int
    session: Session
    peer: Peer | None
    waiting: WaitingFrame
    places: SharedPlaces
    own_slots: tuple[Slot, ...]  # the service's: sent, then returned to the pool
    handed_s: float


class RenderClient:
    """Passes frames, profiles and memory to a render worker.

    Parameters
    ----------
    max_image_bytes : int
        Maximum size of all slots together.
    descriptors : DescriptorLimit

    Attributes
    ----------
    held : dict of Held
        Frames being filtered, by number: one, or a large one and a small one that is
        filtered during it.
    may_rest : bool
        Whether the worker can filter a small frame during a large one.
    is_ready : bool
        Whether the worker has reported its eyes and received the others.
    """

    def __init__(self, max_image_bytes: int, descriptors: DescriptorLimit) -> None:
        self.held: dict[int, Held] = {}
        self.is_ready = False
        self.may_rest = False
        self._link: Link | None = None
        self._slots = SlotPool(
            max_image_bytes, descriptors.max_slots, descriptors.reserve
        )
        self._shared: set[int] = set()  # numbers of the clients' slots
        self._next_number = 1
        self._heard_s = self._excused_s = time.monotonic()

    # The link

    @property
    def is_up(self) -> bool:
        """Return whether there is a render worker."""
        return self._link is not None

    @property
    def silent_s(self) -> float:
        """Return the seconds since the worker's last heartbeat."""
        return time.monotonic() - self._heard_s

    @property
    def stuck_s(self) -> float:
        """Return how long the worker has been silent, or has had a frame."""
        begins_s = [self._heard_s, *(held.handed_s for held in self.held.values())]
        return time.monotonic() - max(min(begins_s), self._excused_s)

    def excuse(self) -> None:
        """Restart the timeout, because the stuck worker is being handled."""
        self._excused_s = self._heard_s = time.monotonic()

    def descriptors(self) -> tuple[set[int], set[int]]:
        """Return the descriptors to poll for reading and for writing."""
        if self._link is None:
            return set(), set()
        found = {self._link.fileno()}
        return found, found if self._link.has_unsent else set()

    def join(self, link: Link) -> None:
        """Connect to a new render worker and send it all slots."""
        self._link = link
        self.is_ready = False
        self.excuse()
        for slot in self._slots:
            self._send_slot(slot)

    def receive(self) -> list[tuple[Any, ...]]:
        """Return messages of the worker.

        Raises
        ------
        LinkClosed
            If the worker is gone; the caller then calls `lose`.
        """
        if self._link is None:
            return []
        self._link.flush()
        messages = [message for message, _ in self._link.receive()]
        if messages:
            self._heard_s = time.monotonic()
        return messages

    def lose(self) -> list[Held]:
        """Close the link; return the frames that are lost with it."""
        if self._link is not None:
            self._link.close()
            self._link = None
        self.is_ready = False
        lost, self.held = list(self.held.values()), {}
        for held in lost:
            self.give_back(*held.own_slots)
        return lost

    def tell(self, *message: Any) -> None:
        """Send a message; ignores a closed link, which `receive` reports."""
        if self._link is not None:
            with contextlib.suppress(LinkClosed):
                self._link.send(message)

    # Memory

    @property
    def session_quota_bytes(self) -> int:
        """Return the memory that one session may hold between its frames, bytes."""
        return int(SESSION_QUOTA * self._slots.max_bytes)

    def share(self, size_bytes: int) -> Slot:
        """Return a slot that no other client has had.

        Raises
        ------
        OutOfMemory
            Also if only the memory reserved for frames sent as parts is left.
        """
        held = [slot for slot in self._slots if slot.number in self._shared]
        most_bytes = int(SHARED_QUOTA * self._slots.max_bytes)
        held_bytes = sum(slot.size_bytes for slot in held)
        if held_bytes + size_bytes > most_bytes:
            raise OutOfMemory(
                f"{size_bytes / MB:.0f} MB more than the {held_bytes / MB:.0f} MB that "
                "clients share are asked for",
                allowed=f"{most_bytes / MB:.0f} MB in all",
            )
        if len(held) >= self._slots.max_count * SHARED_QUOTA:
            raise OutOfMemory(f"{len(held)} blocks of memory are already shared")
        slot = self._slots.create(size_bytes)
        self._shared.add(slot.number)
        self._send_slot(slot)
        return slot

    def drop(self, slot: Slot) -> None:
        """Free a slot permanently."""
        self._shared.discard(slot.number)
        self._slots.drop(slot)
        self.tell("drop_slot", slot.number)

    def give_back(self, *slots: Slot) -> None:
        """Return slots to the pool, for other frames."""
        for slot in slots:
            self._slots.give_back(slot)

    def trim(self) -> None:
        """Free the unused slots of the pool."""
        for slot in self._slots.trim():
            self.tell("drop_slot", slot.number)

    def still_unsent(self, unsent: Unsent) -> Unsent:
        """Return results that libzmq is still reading; free the slots of the others."""
        left = []
        for tracker, slot in unsent:
            if tracker.done:
                self.give_back(slot)
            else:
                left.append((tracker, slot))
        return left

    def _slot_for(self, size_bytes: int) -> Slot:
        slot, is_new = self._slots.take(size_bytes)
        if is_new:
            self._send_slot(slot)
        return slot

    def _send_slot(self, slot: Slot) -> None:
        if self._link is not None:
            try:
                message = ("slot", slot.number, slot.size_bytes)
                self._link.send(message, [slot.descriptor])
            except LinkClosed:
                pass

    # Frames

    def takes(self, session: Session, frame: Frame) -> bool:
        """Return whether the worker can accept a frame now."""
        if not self.is_ready or len(self.held) >= (2 if self.may_rest else 1):
            return False
        return all(
            held.session is not session
            and SMALLER_RATIO * frame.pixel_count <= held.waiting.frame.pixel_count
            for held in self.held.values()
        )

    def submit(self, session: Session, waiting: WaitingFrame) -> None:
        """Send a frame to the worker.

        Raises
        ------
        OutOfMemory
        """
        frame = waiting.frame
        places = frame.memory
        own_slots: tuple[Slot, ...] = ()
        if places is None:
            places, own_slots = self._copied_in(frame)
        number, self._next_number = self._next_number, self._next_number + 1
        self._heard_s = now_s = time.monotonic()
        self.held[number] = Held(
            *(number, session, session.peer, waiting, places, own_slots),
            handed_s=now_s,
        )
        arrays = [array for images in frame.images for array in images.arrays]
        sizes_bytes = [array.nbytes for array in arrays]
        bare = replace(frame, images=(), memory=None)
        self.tell("frame", number, session.key, bare, places, sizes_bytes)

    def _copied_in(self, frame: Frame) -> tuple[SharedPlaces, tuple[Slot, ...]]:
        """Copy the images of a frame to the service's own slots."""
        images = frame.parts()
        starts, n_in = starts_of([image.nbytes for image in images])
        result_starts, n_out = starts_of(result_sizes(frame))
        slot = self._slot_for(n_in)
        try:
            result_slot = self._slot_for(n_out)
        except OutOfMemory:
            self.give_back(slot)
            raise
        slot.put(images, starts)
        places = SharedPlaces(
            slot.number, tuple(starts), result_slot.number, tuple(result_starts)
        )
        return places, (slot, result_slot)

    def take_back(self, number: int) -> Held | None:
        """Return the frame that a reply belongs to, or None if it is not expected."""
        return self.held.pop(number, None)


def completed(
    result: Result, held: Held, started_s: float, blocks_bytes: Sequence[int]
) -> Result:
    """Return a result with its pictures and the times known to the front end."""
    if held.own_slots:
        _, slot = held.own_slots
        result = replace(
            result, colors=_pictures(result, slot, held.places, blocks_bytes)
        )
    else:
        result = replace(result, in_memory=True)
    waiting = held.waiting
    stages_ms = {
        "decode_ms": MS_PER_S * (waiting.decoded_s - waiting.received_s),
        "queue_ms": MS_PER_S * (started_s - waiting.decoded_s),
        **result.stage_times_ms,
    }
    total_ms = MS_PER_S * (time.monotonic() - waiting.received_s)
    stages_ms["other_ms"] = total_ms - sum(stages_ms.values())
    return replace(result, total_ms=total_ms, stage_times_ms=stages_ms)


def _pictures(
    result: Result, slot: Slot, places: SharedPlaces, blocks_bytes: Sequence[int]
) -> tuple[NDArray[Any], ...]:
    if result.compression != "none":
        return tuple(
            slot.array(start, (size,), np.dtype(np.uint8))
            for start, size in zip(places.result_starts, blocks_bytes, strict=True)
        )
    return tuple(
        slot.array(
            start, (view.height_px, view.width_px, 3), np.dtype(view.color.dtype)
        )
        for start, view in zip(places.result_starts, result.views, strict=True)
    )
