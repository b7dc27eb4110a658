"""Staging rings: persistently mapped memory for uploads and readbacks.

Drivers move buffers that are mapped for reading to host memory, and passes then access
them over the bus.  The buffers of the passes are therefore never mapped; data is copied
through a separate ring.  This requires `glBufferStorage` (OpenGL 4.4 or
ARB_buffer_storage).
"""

import ctypes
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimator.threads import call_after_fork, thread_count
from filter_service.errors import OutOfGpuMemory, RenderFailed

if TYPE_CHECKING:
    import moderngl

MIN_PART_BYTES = 2 << 20
"""Smallest part per thread.  For frames of 1280x720 on the host of an H100, parts of
half the size took longer than a single thread."""

MAX_THREADS = 4
"""Two frames of 1832x1920, state unchanged, on a 16-core Xeon host of an H100: 16.0 ms
with one thread, 13.8 with two, 12.4 with four, 12.8 with six, 13.7 with eight."""


def copy_bytes(target: NDArray[np.uint8], source: NDArray[np.uint8]) -> None:
    """Copy bytes (n,), in several threads if there are many; wait for completion."""
    # Half of the cores; the others are for other streams.
    count = min(source.size // MIN_PART_BYTES, thread_count() // 2, MAX_THREADS)
    if count < 2:
        target[:] = source
        return
    first, *others = pairwise(source.size * k // count for k in range(count + 1))
    waiting = [
        _pool().submit(np.copyto, target[start:end], source[start:end])
        for start, end in others
    ]
    np.copyto(target[: first[1]], source[: first[1]])
    for part in waiting:
        part.result()


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MAX_THREADS - 1, thread_name_prefix="copy")


call_after_fork(_pool.cache_clear)  # threads do not survive a fork


GL_TIME_ELAPSED, GL_QUERY_RESULT = 0x88BF, 0x8866


class TimerQuery:
    """Measures the time that the GPU takes for the commands within.

    Parameters
    ----------
    functions : SimpleNamespace
        From `gl_functions`.
    """

    def __init__(self, functions: SimpleNamespace) -> None:
        self._gl, self._name = functions, ctypes.c_uint(0)
        functions.glGenQueries(1, ctypes.byref(self._name))

    def __enter__(self) -> None:
        """Begin the query."""
        self._gl.glBeginQuery(GL_TIME_ELAPSED, self._name)

    def __exit__(self, *raised: object) -> None:
        """End the query."""
        self._gl.glEndQuery(GL_TIME_ELAPSED)

    @property
    def elapsed_ns(self) -> int:
        """Wait for the GPU, and return the time in nanoseconds."""
        found = ctypes.c_uint64(0)
        self._gl.glGetQueryObjectui64v(self._name, GL_QUERY_RESULT, ctypes.byref(found))
        return found.value

    def release(self) -> None:
        """Delete the query."""
        self._gl.glDeleteQueries(1, ctypes.byref(self._name))


GL_COPY_READ_BUFFER, GL_COPY_WRITE_BUFFER = 0x8F36, 0x8F37
GL_MAP_READ_BIT, GL_MAP_WRITE_BIT = 0x1, 0x2
GL_MAP_PERSISTENT_BIT, GL_MAP_COHERENT_BIT = 0x40, 0x80
GL_CLIENT_STORAGE_BIT = 0x200

ALIGNMENT = 256
"""Allocations start at multiples of this."""

INITIAL_BYTES = 1 << 20

MAX_BYTES = 1 << 29
"""Largest size of a ring.  Up to this size it grows for all transfers in flight; then
it waits for them."""

GL_SYNC_GPU_COMMANDS_COMPLETE = 0x9117
GL_SYNC_FLUSH_COMMANDS_BIT = 0x1
GL_TIMEOUT_EXPIRED, GL_WAIT_FAILED = 0x911B, 0x911D
WAIT_NS = 1_000_000_000

_uint = ctypes.c_uint


def has_buffer_storage(context: "moderngl.Context") -> bool:
    """Return whether the context supports persistently mapped buffers."""
    return context.version_code >= 440 or "GL_ARB_buffer_storage" in context.extensions


@dataclass(eq=False)
class Group:
    """Consecutive allocations, followed by a fence.

    Attributes
    ----------
    end : int
        End of the last allocation, in bytes since the ring was mapped.
    mark : int or None
        The fence; None once the GPU has passed it.
    is_free : bool
        Whether the memory may be used again after the fence.
    """

    end: int
    mark: int | None
    is_free: bool


class Staging:
    """A ring of mapped memory, whose allocations are freed in their order.

    Parameters
    ----------
    context : moderngl.Context
    functions : SimpleNamespace
        From `gl_functions`.
    """

    def __init__(self, context: "moderngl.Context", functions: SimpleNamespace) -> None:
        self._context = context
        self._gl = functions
        self._name = _uint(0)
        self._bytes: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._groups: deque[Group] = deque()
        self._first = self._end = 0  # in use, in bytes since the ring was mapped

    @property
    def size(self) -> int:
        """Size of the ring in bytes."""
        return self._bytes.size

    def release(self) -> None:
        """Free the ring; its allocations must not be accessed afterward."""
        for group in self._groups:
            if group.mark is not None:
                self._gl.glDeleteSync(group.mark)
        self._groups.clear()
        if self._name.value:
            self._gl.glDeleteBuffers(1, ctypes.byref(self._name))
        self._name, self._bytes = _uint(0), np.zeros(0, np.uint8)
        self._first = self._end = 0

    def has_space(self, n_bytes: int) -> bool:
        """Return whether bytes can be allocated, after their fences if necessary."""
        while not self._fits(n_bytes):
            if not self._groups or not self._groups[0].is_free:
                return False
            self._drop_oldest()
        return True

    def _fits(self, n_bytes: int) -> bool:
        return self._place(n_bytes) + n_bytes - self._first <= self.size

    def _place(self, n_bytes: int) -> int:
        """Return where an allocation would start: it does not cross the ring's end."""
        if self.size and self._end % self.size + n_bytes > self.size:
            return (self._end // self.size + 1) * self.size
        return self._end

    def _drop_oldest(self) -> None:
        group = self._groups.popleft()
        self.wait(group)
        self._first = group.end
        if self._first == self._end:  # empty: the whole ring is one piece
            self._first = self._end = 0

    def fence(self, *, is_free: bool = False) -> Group:
        """Submit all commands so far, and return the allocations since the last fence.

        Parameters
        ----------
        is_free : bool
            Whether their memory may be used again after the fence, without `free`.
        """
        mark = self._gl.glFenceSync(GL_SYNC_GPU_COMMANDS_COMPLETE, 0)
        self._gl.glFlush()
        group = Group(self._end, int(mark), is_free)
        self._groups.append(group)
        return group

    @property
    def has_new(self) -> bool:
        """Return whether there are allocations since the last fence."""
        return self._end != (self._groups[-1].end if self._groups else self._first)

    def free(self, group: Group) -> None:
        """Allow the memory of allocations to be used again."""
        group.is_free = True

    def is_passed(self, group: Group) -> bool:
        """Return whether the GPU has passed a fence, without waiting."""
        return self._waits(group, 0)

    def wait(self, group: Group) -> None:
        """Wait until the GPU has passed a fence.

        Raises
        ------
        RenderFailed
            The driver has lost the GPU.
        """
        while not self._waits(group, WAIT_NS):
            pass

    def _waits(self, group: Group, limit_ns: int) -> bool:
        if group.mark is None:
            return True
        if not _is_passed(self._gl, group.mark, limit_ns):
            return False
        group.mark = None
        return True

    def allocate(self, n_bytes: int) -> tuple[int, NDArray[np.uint8]]:
        """Allocate bytes; return their offset and an array of them.

        If the ring is too small, this waits for the GPU and maps a larger one; the
        caller has read what it still needs.

        Raises
        ------
        OutOfGpuMemory
            The driver cannot map a ring of the required size.
        """
        if not self.has_space(n_bytes):
            self._context.finish()
            wanted = 2 * (self._end - self._first + n_bytes)
            wanted = min(max(wanted, INITIAL_BYTES), MAX_BYTES)
            self._map_ring(max(wanted, n_bytes))
        place = self._place(n_bytes)
        self._end = -(-(place + n_bytes) // ALIGNMENT) * ALIGNMENT
        start = place % self.size
        return start, self._bytes[start : start + n_bytes]

    def copy_to(
        self, buffer: "moderngl.Buffer", start: int, at: int, n_bytes: int
    ) -> None:
        """Queue a copy of bytes from an offset of the ring to a buffer."""
        self._copy(self._name.value, buffer.glo, start, at, n_bytes)

    def copy_from(
        self, buffer: "moderngl.Buffer", at: int, start: int, n_bytes: int
    ) -> None:
        """Queue a copy of bytes from a buffer to an offset of the ring."""
        self._copy(buffer.glo, self._name.value, at, start, n_bytes)

    def _copy(
        self, source: int, target: int, read_at: int, write_at: int, n_bytes: int
    ) -> None:
        gl = self._gl
        gl.glBindBuffer(GL_COPY_READ_BUFFER, source)
        gl.glBindBuffer(GL_COPY_WRITE_BUFFER, target)
        gl.glCopyBufferSubData(
            GL_COPY_READ_BUFFER, GL_COPY_WRITE_BUFFER, read_at, write_at, n_bytes
        )

    def _map_ring(self, n_bytes: int) -> None:
        self.release()
        gl = self._gl
        access = GL_MAP_READ_BIT | GL_MAP_WRITE_BIT
        access |= GL_MAP_PERSISTENT_BIT | GL_MAP_COHERENT_BIT
        gl.glGenBuffers(1, ctypes.byref(self._name))
        gl.glBindBuffer(GL_COPY_READ_BUFFER, self._name)
        gl.glBufferStorage(
            GL_COPY_READ_BUFFER, n_bytes, None, access | GL_CLIENT_STORAGE_BIT
        )
        address = gl.glMapBufferRange(GL_COPY_READ_BUFFER, 0, n_bytes, access)
        if not address:
            self.release()
            raise OutOfGpuMemory(f"cannot map {n_bytes / 1e6:.0f} MB of memory")
        memory = (ctypes.c_uint8 * n_bytes).from_address(address)
        self._bytes = np.ctypeslib.as_array(memory)


def wait_for_fence(functions: SimpleNamespace) -> None:
    """Wait until the GPU has finished all commands of the current context.

    Raises
    ------
    RenderFailed
        The driver has lost the GPU.
    """
    mark = int(functions.glFenceSync(GL_SYNC_GPU_COMMANDS_COMPLETE, 0))
    while not _is_passed(functions, mark, WAIT_NS):
        pass


def _is_passed(functions: SimpleNamespace, mark: int, limit_ns: int) -> bool:
    """Return whether the GPU has passed a fence, which is then deleted."""
    found = functions.glClientWaitSync(mark, GL_SYNC_FLUSH_COMMANDS_BIT, limit_ns)
    if found == GL_TIMEOUT_EXPIRED:
        return False
    functions.glDeleteSync(mark)
    if found == GL_WAIT_FAILED:
        raise RenderFailed("the OpenGL driver has lost the GPU")
    return True
