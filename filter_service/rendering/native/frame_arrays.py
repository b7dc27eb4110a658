"""Reusable memory of frames, for arrays that the compiled loops fill."""

from __future__ import annotations

import mmap
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from estimator.native.records import pointer_to

SPARE_RATIO = 1.25
"""Over-allocation, so that slowly rising sizes do not reallocate in every frame."""

HUGE_PAGES_FROM_BYTES = 4_000_000
"""Smallest dense buffer that uses huge pages, as NumPy's arrays do."""

TRIM_INTERVAL = 8
"""Number of frames after which unused pages return to the system."""


_PRIVATE = (
    {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS}
    if hasattr(mmap, "MAP_PRIVATE")
    else {}  # on Windows, whose anonymous maps are private
)


@dataclass(eq=False)
class _Buffer:
    """Private memory, and how many of its bytes frames have used."""

    memory: mmap.mmap
    address: int
    used_bytes: int = 0  # by the current frame
    most_bytes: int = 0  # by frames since the last call of `trim`
    touched_bytes: int = 0

    @classmethod
    def of(cls, n_bytes: int, *, is_dense: bool) -> _Buffer:
        """Return a buffer whose pages take memory once they are written to.

        Raises
        ------
        MemoryError
        """
        try:
            memory = mmap.mmap(-1, n_bytes, **_PRIVATE)
        except OSError as error:
            raise MemoryError(
                f"{n_bytes / 1e6:.0f} MB for a buffer of frames: {error.strerror}"
            ) from None
        if is_dense and n_bytes >= HUGE_PAGES_FROM_BYTES:
            with suppress(OSError, AttributeError):  # unknown to this system
                memory.madvise(mmap.MADV_HUGEPAGE)
        return cls(memory, pointer_to(np.frombuffer(memory, np.uint8)))

    def use(self, n_bytes: int) -> int:
        """Note the use of the first bytes, and return their address."""
        self.used_bytes = n_bytes
        self.most_bytes = max(self.most_bytes, n_bytes)
        self.touched_bytes = max(self.touched_bytes, n_bytes)
        return self.address

    def trim(self) -> None:
        """Return the pages beyond those that frames use, if these are the larger part.

        They stay reserved, and are zero when they are used again.
        """
        start = -(-self.most_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        if self.touched_bytes > 2 * start:
            with suppress(OSError, AttributeError):
                self.memory.madvise(
                    mmap.MADV_DONTNEED, start, self.touched_bytes - start
                )
                self.touched_bytes = start
        self.most_bytes = self.used_bytes


class Arrays:
    """Named arrays that frames reuse.

    Parameters
    ----------
    is_dense : bool
        Whether frames use all elements of an array, and of varying numbers of them.
        Otherwise pages are small: fragments of a frame are spread over the arrays, so
        that with huge pages, those of 1280x720 took 80 MB instead of 25.
    """

    def __init__(self, *, is_dense: bool = False) -> None:
        self._is_dense = is_dense
        self._buffers: dict[str, _Buffer] = {}
        self._n_frames = 0

    def address(self, name: str, count: int, dtype: DTypeLike) -> int:
        """Return the address of a named array of at least ``count`` elements.

        It is not initialized.  Its contents are lost when it grows.
        """
        n_bytes = count * np.dtype(dtype).itemsize
        own = self._buffers.get(name)
        if own is None or len(own.memory) < n_bytes:
            own = None
            self._buffers.pop(name, None)  # frees it before the next allocation
            size = int(SPARE_RATIO * n_bytes) + 1
            own = self._buffers[name] = _Buffer.of(size, is_dense=self._is_dense)
        return own.use(n_bytes)

    def restart(self) -> None:
        """Forget what earlier frames used: those of another eye follow."""
        self._n_frames = 0
        for own in self._buffers.values():
            own.used_bytes = own.most_bytes = 0

    def end_frame(self) -> None:
        """Count a frame; after `TRIM_INTERVAL` of them, return unused pages."""
        self._n_frames += 1
        if self._n_frames % TRIM_INTERVAL == 0:
            for own in self._buffers.values():
                own.trim()

    @property
    def memory_mb(self) -> float:
        """Largest memory of all arrays, MB; sparse ones may take less."""
        return sum(own.touched_bytes for own in self._buffers.values()) / 1e6
