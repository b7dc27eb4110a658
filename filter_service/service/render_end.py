"""The door's end of the render loop: a link that may break, memory, frames.

What the loop has to say comes from `receive`; whatever is sent while there is no loop
is lost, and the door says it again to the next one.
"""

from __future__ import annotations

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
from filter_service.service.link import Link, LinkClosed
from filter_service.service.mailbox import Tracker
from filter_service.service.places import result_sizes
from filter_service.service.session import Session, WaitingFrame
from filter_service.slots import Slot, SlotPool, starts_of

MS_PER_S = 1000.0

SMALLER_RATIO = 4
"""A frame may come between the parts of one that has so many times its pixels."""

SESSION_QUOTA = 0.25
"""Of the memory for images: what one session may share, or leave unread."""

SHARED_QUOTA = 0.5
"""What all clients may share; the rest is for frames that travel as parts."""

MB = 1e6

Unsent = list[tuple[Tracker, Slot]]


@dataclass(frozen=True)
class Held:
    """A frame that the render loop has."""

    number: int
    session: Session
    peer: Peer | None
    waiting: WaitingFrame
    places: SharedPlaces
    own_slots: tuple[Slot, ...]  # not the client's: what is sent, and is given back
    handed_s: float


class RenderEnd:
    """Where frames, profiles and memory are handed over.

    Parameters
    ----------
    max_image_bytes : int
        Of all slots.
    descriptors : DescriptorLimit

    Attributes
    ----------
    held : dict of Held
        The frames that are being filtered, by number: one, or a large one and a small
        one that comes between its parts.
    may_rest : bool
        The loop can do that.
    is_ready : bool
        The loop has said which eyes it has, and was told of the others.
    """

    def __init__(self, max_image_bytes: int, descriptors: DescriptorLimit) -> None:
        self.held: dict[int, Held] = {}
        self.is_ready = False
        self.may_rest = False
        self._link: Link | None = None
        self._slots = SlotPool(
            max_image_bytes, descriptors.max_slots, descriptors.reserve
        )
        self._shared: set[int] = set()  # numbers of the slots of clients
        self._next_number = 1
        self._heard_s = self._excused_s = time.monotonic()

    # The link

    @property
    def is_up(self) -> bool:
        """Return whether there is a render loop."""
        return self._link is not None

    @property
    def silent_s(self) -> float:
        """Return since when the loop has given no sign of life."""
        return time.monotonic() - self._heard_s

    @property
    def stuck_s(self) -> float:
        """Return for how long it has said nothing, or has had a frame."""
        begins_s = [self._heard_s, *(held.handed_s for held in self.held.values())]
        return time.monotonic() - max(min(begins_s), self._excused_s)

    def excuse(self) -> None:
        """Count the time anew: what was to be done about it is being done."""
        self._excused_s = self._heard_s = time.monotonic()

    def descriptors(self) -> tuple[set[int], set[int]]:
        """Return what to poll for reading, and for writing."""
        if self._link is None:
            return set(), set()
        found = {self._link.fileno()}
        return found, found if self._link.has_unsent else set()

    def join(self, link: Link) -> None:
        """Work with a new render loop, which is told of all memory."""
        self._link = link
        self.is_ready = False
        self.excuse()
        for slot in self._slots:
            self._send_slot(slot)

    def receive(self) -> list[tuple[Any, ...]]:
        """Return what the loop says.

        Raises
        ------
        LinkClosed
            It is gone; `lose` is to be called.
        """
        if self._link is None:
            return []
        self._link.flush()
        messages = [message for message, _ in self._link.receive()]
        if messages:
            self._heard_s = time.monotonic()
        return messages

    def lose(self) -> list[Held]:
        """Give up the link; return the frames that are lost with it."""
        if self._link is not None:
            self._link.close()
            self._link = None
        self.is_ready = False
        lost, self.held = list(self.held.values()), {}
        for held in lost:
            self.give_back(*held.own_slots)
        return lost

    def tell(self, *message: Any) -> None:
        """Send a message; one that does not arrive is found out by `receive`."""
        if self._link is not None:
            try:
                self._link.send(message)
            except LinkClosed:
                pass

    # Memory

    @property
    def session_quota_bytes(self) -> int:
        """Return the memory that one session may hold between its frames."""
        return int(SESSION_QUOTA * self._slots.max_bytes)

    def share(self, size_bytes: int) -> Slot:
        """Return memory that no other client has had.

        Raises
        ------
        OutOfMemory
            Also where only what is reserved for ordinary frames is left.
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
            raise OutOfMemory(f"{len(held)} pieces of memory are shared already")
        slot = self._slots.create(size_bytes)
        self._shared.add(slot.number)
        self._send_slot(slot)
        return slot

    def drop(self, slot: Slot) -> None:
        """Give up memory for good."""
        self._shared.discard(slot.number)
        self._slots.drop(slot)
        self.tell("drop_slot", slot.number)

    def give_back(self, *slots: Slot) -> None:
        """Take memory back, for other frames."""
        for slot in slots:
            self._slots.give_back(slot)

    def trim(self) -> None:
        """Give up the memory that is free."""
        for slot in self._slots.trim():
            self.tell("drop_slot", slot.number)

    def still_unsent(self, unsent: Unsent) -> Unsent:
        """Return those of which libzmq still reads; the slots of others are free."""
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
        """Return whether a frame may be handed over now."""
        if not self.is_ready or len(self.held) >= (2 if self.may_rest else 1):
            return False
        return all(
            held.session is not session
            and SMALLER_RATIO * frame.pixel_count <= held.waiting.frame.pixel_count
            for held in self.held.values()
        )

    def hand_over(self, session: Session, waiting: WaitingFrame) -> None:
        """Have a frame filtered.

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
        """Copy the images of a frame to slots of the service."""
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
        """Return the frame that an answer is to, if it is one that is awaited."""
        return self.held.pop(number, None)


def completed(
    result: Result, held: Held, started_s: float, blocks_bytes: Sequence[int]
) -> Result:
    """Return a result with its pictures and with the times that the door knows."""
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
