"""Render client: the front end's side of a render worker.

It sends frames and profiles over a link, and allocates the shared memory of images.
Messages that are sent while no worker is running are lost; the front end sends their
content again to the next worker.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from filter_service.errors import BadMessage, OutOfMemory
from filter_service.messages import (
    Frame,
    Result,
    SharedPlaces,
    ViewHeader,
    ViewTextures,
    packed_header,
)
from filter_service.service.connections import DescriptorLimit, Peer
from filter_service.service.process_channel import Link, LinkClosed
from filter_service.service.router import Tracker
from filter_service.service.session import Session, WaitingFrame
from filter_service.shared_memory import Slot, SlotPool, aligned_starts
from filter_service.texture_view import COLOR_FORMATS, DEPTH_FORMATS
from filter_service.wire.images import image_bytes, largest_block_bytes


def check_positions(session: Session, frame: Frame) -> None:
    """Check that a frame's images are in free slots or textures of its session.

    Raises
    ------
    BadMessage
        If a slot or texture is unknown or in use, images overlap or exceed a slot, or
        a texture has another size than its view.
    """
    for view, used in zip(frame.views, frame.textures, strict=False):
        _check_textures(session, view, used)
    positions = frame.memory
    if positions is None:
        return
    for name, number in (
        ("slot", positions.slot),
        ("result_slot", positions.result_slot),
    ):
        if number not in session.shared or number in session.slots_in_use:
            raise BadMessage(
                f"it is {number}",
                field=f"memory.{name}",
                allowed="a slot of this session that no other frame uses",
            )
    if positions.slot == positions.result_slot:
        raise BadMessage(
            f"it is {positions.slot}, too",
            field="memory.result_slot",
            allowed="another than memory.slot",
        )
    sizes = [
        image_bytes(shape, dtype)
        for view in frame.views
        for _, shape, dtype in view.images
    ]
    _check_bounds(session.shared[positions.slot], positions.starts, sizes, "starts")
    slot, sizes = session.shared[positions.result_slot], result_sizes(frame)
    _check_bounds(slot, positions.result_starts, sizes, "result_starts")


def _check_textures(session: Session, view: ViewHeader, used: ViewTextures) -> None:
    """Check that textures of a view exist, are free and have its size."""
    names = ("color", "depth", "result")
    for name, number in zip(names, used.numbers, strict=True):
        texture = session.textures.get(number)
        is_free = number not in session.textures_in_use
        if texture is None or not texture.is_imported or not is_free:
            raise BadMessage(
                f"it is {number}",
                field=f"textures.{name}",
                allowed="a texture of this session that no other frame uses",
            )
        found = texture.request.width_px, texture.request.height_px
        if found != (view.width_px, view.height_px):
            raise BadMessage(
                f"texture {number} has {found[0]} x {found[1]} px",
                field=f"textures.{name}",
                allowed=f"{view.width_px} x {view.height_px} px, the size of the view",
            )
        formats = DEPTH_FORMATS if name == "depth" else COLOR_FORMATS
        if texture.request.format not in formats:
            raise BadMessage(
                f"texture {number} has the format {texture.request.format}",
                field=f"textures.{name}",
                allowed=", ".join(formats),
            )


def result_sizes(frame: Frame) -> list[int]:
    """Return the maximum size of each view's output image in bytes."""
    bytes_per_pixel = frame.output.bytes_per_pixel
    sizes = [view.camera.pixel_count * bytes_per_pixel for view in frame.views]
    if frame.compression == "none":
        return sizes
    return [largest_block_bytes(size) for size in sizes]


def _check_bounds(
    slot: Slot, starts: Sequence[int], sizes: Sequence[int], name: str
) -> None:
    """Check that images neither exceed a slot nor overlap."""
    end = 0
    for start, size in sorted(zip(starts, sizes, strict=True)):
        if start < end or start + size > slot.size_bytes:
            raise BadMessage(
                f"{size} bytes from {start}",
                field=f"memory.{name}",
                allowed=f"images beside each other within {slot.size_bytes} bytes",
            )
        end = start + size


MS_PER_S = 1000.0

MIN_PIXEL_RATIO = 4
"""A frame may be filtered during one with at least this many times its pixels."""

SESSION_QUOTA = 0.25
"""Largest share of the image memory for one session's slots, or its unread results."""

SHARED_QUOTA = 0.5
"""Largest share for the slots of all sessions; the rest is for frames sent as parts."""

MB = 1e6

UnsentResults = list[tuple[Tracker, Slot]]


@dataclass(frozen=True)
class InFlightFrame:
    """A frame that the render worker has not answered yet."""

    number: int
    session: Session
    peer: Peer | None
    waiting: WaitingFrame
    places: SharedPlaces | None  # None for a frame in textures
    pool_slots: tuple[Slot, ...]  # from the pool, for images sent as parts
    submitted_s: float


class RenderClient:
    """Passes frames, profiles and memory to a render worker.

    Parameters
    ----------
    max_image_bytes : int
        Maximum size of all slots together.
    descriptors : DescriptorLimit

    Attributes
    ----------
    in_flight : dict of InFlightFrame
        Frames in the worker, by number: one, or a large one and a small one that is
        filtered during it.
    can_interrupt : bool
        Whether the worker can filter a small frame during a large one.
    is_ready : bool
        Whether the worker has reported its eyes and received the missing ones.
    """

    def __init__(self, max_image_bytes: int, descriptors: DescriptorLimit) -> None:
        self.in_flight: dict[int, InFlightFrame] = {}
        self.is_ready = False
        self.can_interrupt = False
        self._link: Link | None = None
        self._slots = SlotPool(
            max_image_bytes, descriptors.max_slots, descriptors.reserve
        )
        self._shared: set[int] = set()  # numbers of slots that clients use
        self._next_number = 1
        self._last_heard_s = self._timeout_from_s = time.monotonic()

    # The link

    @property
    def is_up(self) -> bool:
        """Return whether a render worker is connected."""
        return self._link is not None

    @property
    def silent_s(self) -> float:
        """Return the seconds since the worker's last heartbeat."""
        return time.monotonic() - self._last_heard_s

    @property
    def unresponsive_s(self) -> float:
        """Return how long the worker has been silent, or busy with one frame."""
        begins_s = [
            self._last_heard_s,
            *(frame.submitted_s for frame in self.in_flight.values()),
        ]
        return time.monotonic() - max(min(begins_s), self._timeout_from_s)

    def restart_timeout(self) -> None:
        """Restart the timeout while a hung worker is being restarted."""
        self._timeout_from_s = self._last_heard_s = time.monotonic()

    def fileno(self) -> int | None:
        """Return the descriptor to poll; None if no worker is connected."""
        return None if self._link is None else self._link.fileno()

    @property
    def has_unsent(self) -> bool:
        """Return whether messages wait until the descriptor is writable."""
        return self._link is not None and self._link.has_unsent

    def connect(self, link: Link) -> None:
        """Connect to a new render worker and send it all slots."""
        self._link = link
        self.is_ready = False
        self.restart_timeout()
        for slot in self._slots:
            self._send_slot(slot)

    def receive(self) -> list[tuple[Any, ...]]:
        """Return messages of the worker.

        Raises
        ------
        LinkClosed
            If the worker has exited; the caller then calls `disconnect`.
        """
        if self._link is None:
            return []
        self._link.flush()
        messages = [message for message, _ in self._link.receive()]
        if messages:
            self._last_heard_s = time.monotonic()
        return messages

    def disconnect(self) -> list[InFlightFrame]:
        """Close the link; return the frames that are lost with it."""
        if self._link is not None:
            self._link.close()
            self._link = None
        self.is_ready = False
        lost, self.in_flight = list(self.in_flight.values()), {}
        for frame in lost:
            self.release(*frame.pool_slots)
        return lost

    def send(self, *message: Any, descriptors: Sequence[int] = ()) -> None:
        """Send a message; ignore a closed link, which `receive` reports."""
        if self._link is not None:
            with contextlib.suppress(LinkClosed):
                self._link.send(message, descriptors)

    # Memory

    @property
    def session_quota_bytes(self) -> int:
        """Return the size limit of one session's slots, or of its unread results."""
        return int(SESSION_QUOTA * self._slots.max_bytes)

    @property
    def shared_quota_bytes(self) -> int:
        """Return the total limit of shared memory over all sessions, in bytes."""
        return int(SHARED_QUOTA * self._slots.max_bytes)

    def share(self, size_bytes: int) -> Slot:
        """Return a new slot for a client; memory is never passed between clients.

        Raises
        ------
        OutOfMemory
            If the limit of shared memory is reached, or the system has none left.
        """
        shared = [slot for slot in self._slots if slot.number in self._shared]
        most_bytes = self.shared_quota_bytes
        shared_bytes = sum(slot.size_bytes for slot in shared)
        if shared_bytes + size_bytes > most_bytes:
            raise OutOfMemory(
                f"{size_bytes / MB:.0f} MB requested in addition to "
                f"{shared_bytes / MB:.0f} MB that clients share",
                allowed=f"{most_bytes / MB:.0f} MB in total",
            )
        if len(shared) >= self._slots.max_count * SHARED_QUOTA:
            raise OutOfMemory(f"all {len(shared)} slots of shared memory are in use")
        slot = self._slots.create(size_bytes)
        self._shared.add(slot.number)
        self._send_slot(slot)
        return slot

    def drop(self, slot: Slot) -> None:
        """Free a slot permanently."""
        self._shared.discard(slot.number)
        self._slots.drop(slot)
        self.send("drop_slot", slot.number)

    def release(self, *slots: Slot) -> None:
        """Return slots to the pool, for other frames."""
        for slot in slots:
            self._slots.release(slot)

    def trim(self) -> None:
        """Free the unused slots of the pool."""
        for slot in self._slots.trim():
            self.send("drop_slot", slot.number)

    def release_sent(self, unsent: UnsentResults) -> UnsentResults:
        """Release the slots of results that were sent; return the other results."""
        left = []
        for tracker, slot in unsent:
            if tracker.done:
                self.release(slot)
            else:
                left.append((tracker, slot))
        return left

    def _slot_for(self, size_bytes: int) -> Slot:
        slot, is_new = self._slots.acquire(size_bytes)
        if is_new:
            self._send_slot(slot)
        return slot

    def _send_slot(self, slot: Slot) -> None:
        descriptors = [slot.descriptor]
        self.send("slot", slot.number, slot.size_bytes, descriptors=descriptors)

    # Frames

    def can_accept(self, session: Session, frame: Frame) -> bool:
        """Return whether the worker can accept a frame now."""
        if not self.is_ready or len(self.in_flight) >= (2 if self.can_interrupt else 1):
            return False
        return all(
            other.session is not session
            and MIN_PIXEL_RATIO * frame.pixel_count <= other.waiting.frame.pixel_count
            for other in self.in_flight.values()
        )

    def submit(self, session: Session, waiting: WaitingFrame) -> None:
        """Send a frame to the worker.

        Raises
        ------
        OutOfMemory
            If no slot for its images can be allocated.
        """
        frame = waiting.frame
        places = frame.memory
        pool_slots: tuple[Slot, ...] = ()
        if places is None and not frame.textures:
            places, pool_slots = self._copy_images(frame)
        number, self._next_number = self._next_number, self._next_number + 1
        self._last_heard_s = now_s = time.monotonic()
        self.in_flight[number] = InFlightFrame(
            *(number, session, session.peer, waiting, places, pool_slots),
            submitted_s=now_s,
        )
        arrays = [array for images in frame.images for array in images.arrays]
        sizes_bytes = [array.nbytes for array in arrays]
        own = None if places is frame.memory else places  # the header has the others
        self.send("frame", number, session.key, waiting.header, own, sizes_bytes)

    def _copy_images(self, frame: Frame) -> tuple[SharedPlaces, tuple[Slot, ...]]:
        """Copy the images of a frame to slots of the pool."""
        images = frame.parts()
        starts, n_in = aligned_starts([image.nbytes for image in images])
        result_starts, n_out = aligned_starts(result_sizes(frame))
        slot = self._slot_for(n_in)
        try:
            result_slot = self._slot_for(n_out)
        except OutOfMemory:
            self.release(slot)
            raise
        slot.put(images, starts)
        places = SharedPlaces(
            slot.number, tuple(starts), result_slot.number, tuple(result_starts)
        )
        return places, (slot, result_slot)

    def pop_frame(self, number: int) -> InFlightFrame | None:
        """Return the frame of a reply; None if it was given up meanwhile."""
        return self.in_flight.pop(number, None)


def result_parts(
    fields: dict[str, Any],
    frame: InFlightFrame,
    started_s: float,
    blocks_bytes: Sequence[int],
) -> list[Any]:
    """Return the parts of a result message.

    Parameters
    ----------
    fields : dict
        Header fields from the render worker; the front end adds times that it knows.
    frame : InFlightFrame
    started_s : float
        Time at which the worker started the frame.
    blocks_bytes : sequence of int
        Sizes of the images in bytes.
    """
    waiting = frame.waiting
    stages_ms = {
        "decode_ms": MS_PER_S * (waiting.decoded_s - waiting.received_s),
        "queue_ms": MS_PER_S * (started_s - waiting.decoded_s),
        **fields["stage_times_ms"],
    }
    total_ms = MS_PER_S * (time.monotonic() - waiting.received_s)
    stages_ms["other_ms"] = total_ms - sum(stages_ms.values())
    times = {"total_ms": total_ms, "stage_times_ms": stages_ms}
    fields = fields | times | {"in_memory": not frame.pool_slots}
    header = packed_header(Result.type_name, fields)
    if not frame.pool_slots or frame.places is None:
        return [header]
    _, slot = frame.pool_slots
    starts = frame.places.result_starts
    return [header, *map(slot.part, starts, blocks_bytes)]
