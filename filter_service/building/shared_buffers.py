"""Large arrays from one process to another without a copy on the receiving side.

They go into an anonymous file in memory, whose descriptor travels over the pipe: the
receiver maps it, however large it is, in no time, and nothing is left behind when
either process dies.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Sequence

from filter_service.slots import starts_of


def write_shared(buffers: Sequence[memoryview]) -> int:
    """Return the descriptor of a new file in memory that holds the buffers."""
    starts, n_bytes = starts_of([buffer.nbytes for buffer in buffers])
    descriptor = _anonymous_file()
    try:
        os.ftruncate(descriptor, n_bytes)
        for start, buffer in zip(starts, buffers, strict=True):
            plain, written = buffer.cast("B"), 0
            while written < plain.nbytes:
                written += os.pwrite(descriptor, plain[written:], start + written)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def map_shared(descriptor: int, sizes: Sequence[int]) -> list[memoryview]:
    """Return the buffers of a file; they stay valid when it is closed.

    They may be written to, and nobody else sees it.  (To numba, arrays that cannot be
    written to are another type, for which it compiles everything anew.)
    """
    starts, n_bytes = starts_of(sizes)
    if n_bytes == 0:
        return [memoryview(bytearray()) for _ in sizes]
    mapped = memoryview(mmap.mmap(descriptor, n_bytes, access=mmap.ACCESS_COPY))
    return [
        mapped[start : start + size] for start, size in zip(starts, sizes, strict=True)
    ]


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):  # Linux
        return os.memfd_create("ocufilter-store")
    descriptor, path = tempfile.mkstemp(prefix="ocufilter-")
    os.unlink(path)
    return descriptor
