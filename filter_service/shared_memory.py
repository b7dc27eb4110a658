"""Shared memory for images between two processes.

A *slot* is an anonymous file in memory.  Its pages are allocated at creation and its
size is sealed, so that neither low memory nor the other process can cause a bus error.
The system frees it when no process has it open.
"""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import OutOfMemory

PAGE_BYTES = mmap.PAGESIZE
MAX_REUSE_RATIO = 4
"""Maximum ratio of a reused slot's size to the requested one."""

ALIGNMENT_BYTES = 64
"""Alignment of each image in a slot."""


def aligned_starts(sizes: Sequence[int]) -> tuple[list[int], int]:
    """Return the aligned start of each image, and the total size, in bytes."""
    starts, end = [], 0
    for size in sizes:
        starts.append(end)
        end += -(-size // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
    return starts, end


def address_of(array: NDArray[Any]) -> int:
    """Return the address of an array's first element, faster than `ndarray.ctypes`."""
    return int(array.__array_interface__["data"][0])


class Slot:
    """Shared memory of a fixed size.

    Attributes
    ----------
    number : int
        Identifier that both processes use.
    size_bytes : int
    descriptor : int
        File descriptor.
    address : int
        Address of the memory in this process.
    """

    def __init__(self, number: int, size_bytes: int, descriptor: int) -> None:
        self.number = number
        self.size_bytes = size_bytes
        self.descriptor = descriptor
        self._memory = memoryview(mmap.mmap(descriptor, size_bytes))
        self.address = address_of(np.frombuffer(self._memory, np.uint8))

    @classmethod
    def create(cls, number: int, size_bytes: int) -> Slot:
        """Return a new slot.

        Raises
        ------
        OutOfMemory
            If the system cannot allocate that much.
        """
        import fcntl  # Unix only, like slots; other functions of this module are not

        size_bytes = -(-max(size_bytes, 1) // PAGE_BYTES) * PAGE_BYTES
        flags = os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
        descriptor = -1
        try:
            descriptor = os.memfd_create("ocufilter-slot", flags)
            os.posix_fallocate(descriptor, 0, size_bytes)
            fcntl.fcntl(
                descriptor,
                fcntl.F_ADD_SEALS,
                fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL,
            )
            return cls(number, size_bytes, descriptor)
        except OSError as error:
            if descriptor >= 0:
                os.close(descriptor)
            raise OutOfMemory(
                f"{size_bytes / 1e6:.0f} MB of shared memory are unavailable: "
                f"{error.strerror}"
            ) from None

    @property
    def path(self) -> str:
        """Return the path of the file for another process of the same user (Linux)."""
        return f"/proc/{os.getpid()}/fd/{self.descriptor}"

    @classmethod
    def received(cls, number: int, size_bytes: int, descriptor: int) -> Slot:
        """Return a slot that another process has created.

        Raises
        ------
        ValueError
            If the file is not a sealed slot of that size.
        """
        import fcntl

        seals = fcntl.fcntl(descriptor, fcntl.F_GET_SEALS)
        if not seals & fcntl.F_SEAL_SHRINK:
            raise ValueError(f"slot {number} is not sealed")
        if os.fstat(descriptor).st_size != size_bytes:
            raise ValueError(f"slot {number} does not have {size_bytes} bytes")
        return cls(number, size_bytes, descriptor)

    def part(self, start: int, size_bytes: int) -> memoryview:
        """Return a part of the memory.

        Raises
        ------
        ValueError
            If the part extends beyond the slot.
        """
        if not 0 <= start <= start + size_bytes <= self.size_bytes:
            raise ValueError(
                f"bytes {start} to {start + size_bytes} of a slot of {self.size_bytes}"
            )
        return self._memory[start : start + size_bytes]

    def array(
        self, start: int, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> NDArray[Any]:
        """Return a part of the memory as an array; raises as `part` does."""
        size_bytes = math.prod(shape) * dtype.itemsize
        part = self.part(start, size_bytes)
        return np.frombuffer(part, dtype=dtype).reshape(shape)

    def put(self, images: Sequence[NDArray[Any]], starts: Sequence[int]) -> None:
        """Copy images to their starts; skip those that are already there."""
        for start, image in zip(starts, images, strict=True):
            if address_of(image) != self.address + start:
                np.copyto(self.array(start, image.shape, image.dtype), image)

    def close(self) -> None:
        """Close the file; the memory is freed with the last reference to a part."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


class SlotPool:
    """Pool of reusable slots.

    Parameters
    ----------
    max_bytes : int
        Largest total size of all slots.
    max_count : int
        Largest number of slots; each takes a file descriptor.
    reserve : callable, optional
        Returns a context in which this process may open descriptors.
    """

    def __init__(
        self,
        max_bytes: int,
        max_count: int = 1024,
        reserve: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.max_bytes, self.max_count = max_bytes, max_count
        self._reserve = reserve
        self._slots: dict[int, Slot] = {}
        self._free: list[Slot] = []
        self._next_number = 1

    @property
    def total_bytes(self) -> int:
        """Return the total size of all slots."""
        return sum(slot.size_bytes for slot in self._slots.values())

    def acquire(self, size_bytes: int) -> tuple[Slot, bool]:
        """Return a slot of at least this size, and whether it is new.

        Raises
        ------
        OutOfMemory
            If a limit is reached, or the system has no memory left.
        """
        fitting = [
            slot
            for slot in self._free
            if size_bytes
            <= slot.size_bytes
            <= MAX_REUSE_RATIO * max(size_bytes, PAGE_BYTES)
        ]
        if fitting:
            slot = min(fitting, key=lambda found: found.size_bytes)
            self._free.remove(slot)
            return slot, False
        return self.create(size_bytes), True

    def create(self, size_bytes: int) -> Slot:
        """Return a newly created slot.

        Raises
        ------
        OutOfMemory
            If a limit is reached, or the system has no memory left.
        """
        if self.total_bytes + size_bytes > self.max_bytes:
            raise OutOfMemory(
                f"{size_bytes / 1e6:.0f} MB requested in addition to "
                f"{self.total_bytes / 1e6:.0f} MB in use",
                allowed=f"{self.max_bytes / 1e6:.0f} MB for images in total",
            )
        if len(self._slots) >= self.max_count:
            raise OutOfMemory(
                f"{len(self._slots)} slots of shared memory are in use",
                allowed=f"{self.max_count} in total",
            )
        with self._reserve():
            slot = Slot.create(self._next_number, size_bytes)
        self._slots[slot.number] = slot
        self._next_number += 1
        return slot

    def release(self, slot: Slot) -> None:
        """Return a slot to the pool."""
        self._free.append(slot)

    def drop(self, slot: Slot) -> None:
        """Remove a slot from the pool and close it."""
        del self._slots[slot.number]
        slot.close()

    def trim(self) -> list[Slot]:
        """Close and return all free slots."""
        dropped, self._free = self._free, []
        for slot in dropped:
            self.drop(slot)
        return dropped

    def __iter__(self) -> Iterator[Slot]:
        """Iterate over all slots."""
        return iter(list(self._slots.values()))
