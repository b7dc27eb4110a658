"""Images in memory and textures that clients share with a service on their machine.

A client requests slots (regions of shared memory) when it needs them.  Until they
arrive, or if there are none, it sends images as parts of messages.  Results in a slot
are returned without a copy; the slot is free again when the array is no longer
referenced.  A client exports textures itself, with Vulkan, and sends their descriptors
over a socket that the service names in its welcome message.
"""

from __future__ import annotations

import logging
import os
import socket
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.messages import (
    Share,
    Shared,
    SharedTexture,
    ShareTexture,
    TextureOffer,
    Unshare,
    encode,
)
from filter_service.shared_memory import PAGE_BYTES, Slot, address_of, aligned_starts

SEND_LIMIT_S = 1.0
REPLY_LIMIT_S = 5.0
"""Longest wait for an import; a service run by another user ignores descriptors."""


class SharedTextures:
    """Shared textures of one session."""

    def __init__(self) -> None:
        self.offer: TextureOffer | None = None
        self._next_number = 1
        self._reasons: dict[int, str] = {}  # from the replies, by texture number
        self._reported = ""

    def begin(self, offer: TextureOffer | None) -> None:
        """Forget the textures of the previous connection, which the service freed."""
        self.offer = offer
        self._reasons = {}

    def new_number(self) -> int:
        """Return a number for a new texture."""
        self._next_number += 1
        return self._next_number - 1

    def refusal(self, device_uuid: str | None) -> str:
        """Return why the service cannot import a texture, or an empty string."""
        if self.offer is None:
            return "the service does not offer them to this client"
        if device_uuid is not None and device_uuid not in self.offer.device_uuids:
            devices = ", ".join(self.offer.device_uuids)
            return f"memory of device {device_uuid}; the service uses {devices}"
        return ""

    def send(self, request: ShareTexture, descriptor: int) -> str:
        """Send a descriptor; return why that failed, or an empty string."""
        assert self.offer is not None
        self._reasons.pop(request.texture, None)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(SEND_LIMIT_S)
            try:
                sender.connect(f"\0{self.offer.socket}")
                socket.send_fds(sender, encode(request), [descriptor])
            except OSError as error:  # another machine or network namespace
                return str(error)
        return ""

    def take_in(self, reply: SharedTexture) -> None:
        """Record whether the service has a texture."""
        self._reasons[reply.texture] = reply.reason

    def reply_about(self, number: int) -> SharedTexture | None:
        """Return the service's reply about a texture."""
        reason = self._reasons.get(number)
        return None if reason is None else SharedTexture(number, reason)

    def report(self, reason: str) -> None:
        """Log why textures are not shared, once."""
        if reason != self._reported:
            self._reported = reason
            log.warning("cannot share textures; sending images instead: %s", reason)


KEPT_RATIO = 4
MAX_SLOTS = 12
MAX_ASKED = 2

log = logging.getLogger("ocufilter")


@dataclass(eq=False)
class ClientSlot:
    """A slot and the number of its users, which are frames in flight and results."""

    slot: Slot
    n_users: int = 0

    def release(self) -> None:
        """Decrement the number of users."""
        self.n_users -= 1


class SharedMemory:
    """Shared-memory slots of one session.

    Parameters
    ----------
    say : callable
        Function that sends a message to the service.
    """

    def __init__(self, say: Callable[[Share | Unshare], None]) -> None:
        self._say = say
        self._slots: list[ClientSlot] = []
        self._n_asked = 0
        self.is_offered = False

    def begin(self, *, is_offered: bool) -> None:
        """Discard the slots of the previous connection; arrays in them stay valid."""
        for held in self._slots:
            held.slot.close()
        self._slots, self._n_asked = [], 0
        self.is_offered = is_offered

    def take_in(self, reply: Shared) -> None:
        """Map a slot that the service has created."""
        self._n_asked -= 1
        if reply.slot is None or reply.size_bytes is None:
            log.info("no shared memory: %s", reply.reason)
            self.is_offered = False
            return
        try:
            descriptor = os.open(reply.path, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
            slot = Slot.received(reply.slot, reply.size_bytes, descriptor)
        except (OSError, ValueError) as error:  # another machine, user or container
            log.info("no shared memory: %s", error)
            self.is_offered = False
            return
        self._slots.append(ClientSlot(slot))

    def take(self, size_bytes: int) -> ClientSlot | None:
        """Return a free slot of at least this size; request one if there is none."""
        if not self.is_offered:
            return None
        most = KEPT_RATIO * max(size_bytes, PAGE_BYTES)
        fitting = [
            held
            for held in self._slots
            if not held.n_users and size_bytes <= held.slot.size_bytes <= most
        ]
        if fitting:
            smallest = min(fitting, key=lambda held: held.slot.size_bytes)
            smallest.n_users = 1
            return smallest
        if len(self._slots) >= MAX_SLOTS:
            self._drop_one()
        if self._n_asked < MAX_ASKED and len(self._slots) < MAX_SLOTS:
            self._n_asked += 1
            self._say(Share(size_bytes))
        return None

    def holding(self, images: Sequence[NDArray[Any]]) -> ClientSlot | None:
        """Return the slot that already contains the images at the expected offsets."""
        if not all(image.flags.c_contiguous for image in images):
            return None
        starts, _ = aligned_starts([image.nbytes for image in images])
        addresses = [address_of(image) for image in images]
        for held in self._slots:
            if all(
                address == held.slot.address + start
                for address, start in zip(addresses, starts, strict=True)
            ):
                return held
        return None

    def array(
        self, held: ClientSlot, start: int, shape: tuple[int, ...], dtype: Any
    ) -> NDArray[Any]:
        """Return an array in a slot; while it is referenced, the slot stays in use."""
        array = held.slot.array(start, shape, np.dtype(dtype))
        held.n_users += 1
        # Views of the array keep a reference to its base.
        weakref.finalize(array.base, held.release)
        return array

    def _drop_one(self) -> None:
        """Return the largest free slot to the service: image sizes have changed."""
        free = [held for held in self._slots if not held.n_users]
        if free:
            largest = max(free, key=lambda held: held.slot.size_bytes)
            self._slots.remove(largest)
            self._say(Unshare(largest.slot.number))
            largest.slot.close()
