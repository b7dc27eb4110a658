"""The OpenGL context and its memory: buffers, textures, uploads and readbacks."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import moderngl
import numpy as np
from numpy.typing import DTypeLike, NDArray

from filter_service import constants
from filter_service.errors import OutOfGpuMemory, RenderFailed
from filter_service.gl.choose_device import open_on_device
from filter_service.gl.current_context import (
    CurrentContext,
    EglCurrent,
    KeptState,
    current_moderngl_context,
    gl_functions,
)
from filter_service.gl.passes import Atlas, Buffer, BufferPart, Pages, Passes
from filter_service.gl.staging import (
    ALIGNMENT,
    Group,
    Staging,
    TimerQuery,
    copy_bytes,
    has_buffer_storage,
    wait_for_fence,
)
from filter_service.gl.texture_io import TextureIo
from filter_service.gl_device import (
    checked_gl_device,
    is_software_renderer,
    wanted_gl_device,
)

GROWTH = 1.25
"""Over-allocation of buffers that grow, so that slowly rising sizes do not reallocate
in every frame."""

ATLAS_TEXEL_BYTES = 16

ATLAS_BYTES = 1 << 30
"""Upper bound on the size of an atlas: twice the kernels of a frame."""

PART_ALIGNMENT = 256
"""Alignment of the parts of a buffer, which every OpenGL device accepts."""

PASS_BLOCKS = 13
"""Largest number of storage blocks that a pass binds, including its atlases."""


class Gpu:
    """An OpenGL context with named, grow-only storage buffers.

    Parameters
    ----------
    device : str, optional
        "auto", or the index of an EGL device; by default from the environment.
    current : CurrentContext, optional
        Context of the caller to use instead of an own one.  It must be current
        whenever this object is used.

    Attributes
    ----------
    info : dict
        Renderer, version, index of the EGL device (None for a context of the caller),
        and limits.
    functions : SimpleNamespace or None
        From `gl_functions`.
    is_software : bool
        Whether the renderer runs on the CPU.
    passes : Passes
    """

    def __init__(
        self, device: str | None = None, *, current: CurrentContext | None = None
    ) -> None:
        index: int | None = None
        self._egl = EglCurrent()
        if current is None:
            choice = wanted_gl_device() if device is None else checked_gl_device(device)
            with self._egl.kept():
                self.context, index = open_on_device(choice, _context_on)
                _ = self.context.info, self.context.extensions  # moderngl keeps them
            self.functions = gl_functions()
        else:
            self.context = current_moderngl_context(current)
            self.functions = gl_functions(current.load_opengl_function)
        self._current = current
        info = self.context.info
        self.info = {
            "renderer": info["GL_RENDERER"],
            "version": info["GL_VERSION"],
            "vendor": info["GL_VENDOR"],
            "device": index,
            "max_storage_block_bytes": info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"],
        }
        blocks = int(info["GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS"])
        if blocks < PASS_BLOCKS:
            raise RenderFailed(
                f"{self.info['renderer']} allows {blocks} storage blocks in a compute "
                f"shader; the passes need {PASS_BLOCKS}"
            )
        self.is_software = is_software_renderer(self.info["renderer"])
        self.max_block_bytes = int(info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])
        self._buffers: dict[str, Buffer] = {}
        self.passes = Passes(self.context)
        self._atlases: dict[str, moderngl.Texture] = {}
        self._queries: list[TimerQuery] = []
        self._free_queries: list[TimerQuery] = []
        self._texture_io: TextureIo | None = None
        self._owners: dict[str, object] = {}
        self._reads: list[_Read] = []
        self.atlas_is_buffer = (
            not self.is_software and self.max_block_bytes >= ATLAS_BYTES
        )
        self._kept_state: KeptState | None = None
        if current is not None:
            if self.functions is None:
                raise RenderFailed("the current OpenGL context lacks functions of 4.4")
            uses_images = not self.atlas_is_buffer
            self._kept_state = KeptState(self.functions, uses_images=uses_images)
        # A software renderer uses host memory, where staging would only add a copy.
        # Frames of textures are never waited for, so their counters need it.
        self.use_staging(not self.is_software or current is not None)

    @property
    def is_lost(self) -> bool:
        """Return whether the context is the caller's and not current.

        It may have been destroyed, and everything in it.
        """
        return self._current is not None and not self._current.is_current

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Make the context current, and then the one that was.

        In the caller's context, this keeps its state.

        Raises
        ------
        RenderFailed
            The caller's context is not current.
        """
        if self._current is None:
            with self._egl.kept(), self.context:
                yield
            return
        assert self._kept_state is not None
        with self.context, self._kept_state.kept():
            self.passes.forget_bindings()
            yield

    def use_staging(self, wanted: bool) -> None:
        """Enable or disable transfers through mapped memory, if the driver has it."""
        self._staging = None
        if wanted and self.functions is not None and has_buffer_storage(self.context):
            rings = (Staging(self.context, self.functions) for _ in range(2))
            self._staging = dict(zip(("to", "from"), rings, strict=True))

    def close(self) -> None:
        """Free all resources; the object cannot be used afterward."""
        if self.is_lost:
            return
        with self.entered():  # without a context, the driver frees nothing
            for buffer in self._buffers.values():
                buffer.release()
            for atlas in self._atlases.values():
                atlas.release()
            self.passes.release()
            for query in self._queries:
                query.release()
            for ring in (self._staging or {}).values():
                ring.release()
            if self._texture_io is not None:
                self._texture_io.release()
        self._buffers.clear()
        self._atlases.clear()
        with self._egl.kept():
            self.context.release()

    @property
    def texture_io(self) -> TextureIo:
        """Return the sampler and the framebuffer for textures; `close` frees them.

        Raises
        ------
        RenderFailed
            OpenGL lacks functions for frames in textures.
        """
        if self.functions is None:
            raise RenderFailed("this OpenGL lacks functions for frames in textures")
        if self._texture_io is None:
            self._texture_io = TextureIo(self.context, self.functions)
        return self._texture_io

    # ----- buffers

    @property
    def buffers(self) -> Mapping[str, Buffer]:
        """Named buffers."""
        return self._buffers

    def storage(self, name: str, n_bytes: int) -> Buffer:
        """Return a named buffer of at least this size; growing loses its contents.

        Raises
        ------
        OutOfGpuMemory
            The size exceeds a storage block or the memory of the device.
        """
        buffer = self._buffers.get(name)
        if buffer is not None and buffer.size >= n_bytes:
            return buffer
        if n_bytes > self.max_block_bytes:
            raise OutOfGpuMemory(
                f"buffer '{name}' needs {n_bytes / 1e6:.0f} MB; the largest storage "
                f"block of this device has {self.max_block_bytes / 1e6:.0f} MB"
            )
        wanted = max(int(n_bytes * (GROWTH if buffer is not None else 1.0)), 16)
        if buffer is not None:
            buffer.release()
            del self._buffers[name]
        try:
            created = self.context.buffer(reserve=min(wanted, self.max_block_bytes))
        except moderngl.Error as error:
            raise OutOfGpuMemory(
                f"cannot allocate buffer '{name}' of {wanted} bytes: {error}"
            ) from error
        self._buffers[name] = created
        return created

    def upload(self, name: str, *arrays: NDArray[Any]) -> Buffer:
        """Copy arrays to a named buffer, one after the other."""
        buffer = self.storage(name, sum(data.nbytes for data in arrays))
        start = 0
        for data in arrays:
            self.write(buffer, data, offset=start)
            start += data.nbytes
        return buffer

    def upload_parts(self, name: str, **arrays: NDArray[Any]) -> dict[str, BufferPart]:
        """Copy arrays to a named buffer in one transfer; return the part of each."""
        words, ranges = _joined(arrays)
        return _parts(self.upload(name, words), ranges)

    def own_parts(self, **arrays: NDArray[Any]) -> dict[str, BufferPart]:
        """Copy arrays to a new buffer, which the caller releases; return the parts.

        Raises
        ------
        OutOfGpuMemory
        """
        words, ranges = _joined(arrays)
        try:
            buffer = self.context.buffer(words)
        except moderngl.Error as error:
            raise OutOfGpuMemory(
                f"cannot allocate {words.nbytes} bytes: {error}"
            ) from error
        return _parts(buffer, ranges)

    def write(self, buffer: Buffer, data: NDArray[Any], *, offset: int = 0) -> None:
        """Copy an array into a buffer."""
        if not data.nbytes:
            return
        words = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        if self._staging is None:
            buffer.write(words, offset=offset)
            return
        ring = self._staging["to"]
        start, free = ring.allocate(words.size)
        copy_bytes(free, words)
        ring.copy_to(buffer, start, offset, words.size)

    def pages(self, n_words: int) -> Pages:
        """Return a texture array of 16-bit words for data that outlives a frame.

        Pages have STORE_SIDE lines of STORE_SIDE words; the last line, or page, is
        complete.

        Raises
        ------
        OutOfGpuMemory
            There are more pages than a texture array, or the device, can hold.
        """
        side = constants.STORE_SIDE
        lines = max(-(-n_words // side), 1)
        count = -(-lines // side)
        limit = int(self.context.info["GL_MAX_ARRAY_TEXTURE_LAYERS"])
        size = (side, min(lines, side), count)
        if count <= limit:
            try:
                with self._transfers():
                    pages = self.context.texture_array(size, 1, dtype="u2")
            except moderngl.Error as error:
                raise OutOfGpuMemory(
                    f"{2e-6 * n_words:.0f} MB of PSFs: {error}"
                ) from error
            pages.filter = (moderngl.NEAREST, moderngl.NEAREST)
            return pages
        raise OutOfGpuMemory(
            f"{2e-6 * n_words:.0f} MB of PSFs do not fit a texture array here "
            f"({2e-6 * limit * side * side:.0f} MB); narrow the pupil, focus or object "
            "range, or use a smaller image"
        )

    def write_pages(self, pages: Pages, first_line: int, lines: NDArray[Any]) -> None:
        """Copy whole lines (n, STORE_SIDE) of words to pages, starting at a line."""
        side = constants.STORE_SIDE
        while len(lines):
            page, row = divmod(first_line, side)
            count = min(len(lines), side - row)
            with self._transfers():
                pages.write(
                    np.ascontiguousarray(lines[:count]),
                    viewport=(0, row, page, side, count, 1),
                )
            first_line, lines = first_line + count, lines[count:]

    def _transfers(self) -> AbstractContextManager[None]:
        """Return a context in which moderngl transfers pixels."""
        if self._kept_state is None:
            return nullcontext()
        return self._kept_state.for_transfers()

    def atlas(self, name: str, n_texels: int) -> Atlas:
        """Return a named, grow-only atlas of texels of four uints.

        It is a storage buffer if `atlas_is_buffer`, otherwise a texture with rows of
        ATLAS_WIDTH texels.
        """
        if self.atlas_is_buffer:
            return self.storage(f"{name} atlas", ATLAS_TEXEL_BYTES * n_texels)
        rows = -(-n_texels // constants.ATLAS_WIDTH)
        atlas = self._atlases.get(name)
        if atlas is not None and atlas.height >= rows:
            return atlas
        limit = int(self.context.info["GL_MAX_TEXTURE_SIZE"])
        if rows > limit:
            raise OutOfGpuMemory(
                f"the frame's kernels have {n_texels} texels; a texture of this device "
                f"has at most {limit * constants.ATLAS_WIDTH}"
            )
        wanted = rows
        if atlas is not None:
            atlas.release()
            del self._atlases[name]
            wanted = min(int(rows * GROWTH) + 1, limit)
        with self._transfers():
            atlas = self.context.texture((constants.ATLAS_WIDTH, wanted), 4, dtype="u4")
        atlas.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._atlases[name] = atlas
        return atlas

    def claim(self, name: str, owner: object) -> None:
        """Record an owner that is about to overwrite the memory of a name."""
        self._owners[name] = owner

    def is_owner(self, name: str, owner: object) -> bool:
        """Return whether no other owner has claimed the memory since."""
        return self._owners.get(name) is owner

    def read(
        self, buffer: Buffer, shape: tuple[int, ...], dtype: DTypeLike
    ) -> NDArray[Any]:
        """Wait for the GPU, and return the start of a buffer as an array."""
        out = np.empty(shape, dtype=dtype)
        self.read_into((buffer, 0, out))
        return out

    def read_into(self, *parts: tuple[Buffer, int, NDArray[Any]]) -> None:
        """Wait for the GPU, and read each array from a buffer at a byte offset."""
        self.begin_read(*parts)()

    def begin_read(
        self, *parts: tuple[Buffer, int, NDArray[Any]]
    ) -> Callable[[], None]:
        """Start a readback; return a function that waits and then fills the arrays.

        Later dispatches may overwrite the buffers.  Without mapped memory, the arrays
        are filled at once.
        """
        parts = tuple(part for part in parts if part[2].nbytes)
        if self._staging is None:
            for buffer, offset, out in parts:
                buffer.read_into(_bytes_of(out), size=out.nbytes, offset=offset)
            return lambda: None
        ring = self._staging["from"]
        size = sum(out.nbytes + ALIGNMENT for _, _, out in parts)
        if not ring.has_space(size):
            for waiting in tuple(self._reads):
                self._end_read(waiting)
        start, free = ring.allocate(size)
        targets, at = [], 0
        for buffer, offset, out in parts:
            ring.copy_from(buffer, offset, start + at, out.nbytes)
            targets.append((_bytes_of(out), free[at : at + out.nbytes]))
            at += -(-out.nbytes // ALIGNMENT) * ALIGNMENT
        waiting = _Read(ring.fence(), targets)
        self._reads.append(waiting)
        if self._staging["to"].has_new:
            self._staging["to"].fence(is_free=True)
        return partial(self._end_read, waiting)

    def begin_late_read(
        self, *parts: tuple[Buffer, int, NDArray[Any]]
    ) -> Callable[[], bool]:
        """Start a readback; return a function that fills the arrays without waiting.

        It returns False until the GPU has copied the data.
        """
        if self._staging is None:
            self.read_into(*parts)
            return lambda: True
        self.begin_read(*parts)
        waiting = self._reads[-1]

        def is_done() -> bool:
            if not any(one is waiting for one in self._reads):
                return True
            if not self._staging or not self._staging["from"].is_passed(waiting.group):
                return False
            self._end_read(waiting)
            return True

        return is_done

    def _end_read(self, waiting: "_Read") -> None:
        if not any(one is waiting for one in self._reads):
            return
        assert self._staging is not None  # pending readbacks use it
        self._reads = [one for one in self._reads if one is not waiting]
        ring = self._staging["from"]
        ring.wait(waiting.group)
        for target, source in waiting.targets:
            copy_bytes(target, source)
        ring.free(waiting.group)

    def wait(self) -> None:
        """Wait until the GPU has finished all commands, by a fence.

        Raises
        ------
        RenderFailed
            The driver has lost the GPU.
        """
        if self.functions is None:
            self.context.finish()
        else:
            wait_for_fence(self.functions)

    @property
    def memory_mb(self) -> float:
        """Memory of the named buffers and atlases, MB."""
        buffers = sum(buffer.size for buffer in self._buffers.values())
        texels = sum(a.width * a.height for a in self._atlases.values())
        return (buffers + ATLAS_TEXEL_BYTES * texels) / 1e6

    # ----- timers and errors

    @property
    def has_timers(self) -> bool:
        """Return whether stages are timed by queries instead of the wall clock."""
        return not self.is_software and self.functions is not None

    def acquire_query(self) -> TimerQuery:
        """Return a timer query from the pool; see `release_queries`."""
        if self._free_queries:
            return self._free_queries.pop()
        assert self.functions is not None  # see `has_timers`
        self._queries.append(TimerQuery(self.functions))
        return self._queries[-1]

    def release_queries(self, queries: list[TimerQuery]) -> None:
        """Return timer queries to the pool; `close` deletes them."""
        self._free_queries += queries

    def drop_errors(self) -> None:
        """Drop errors that the caller's own commands have left in its context."""
        if self._current is not None and self.functions is not None:
            while self.functions.glGetError():
                pass

    def check(self, where: str) -> None:
        """Raise the error that OpenGL has recorded since the last check, if any."""
        error = self.context.error
        if error == "GL_OUT_OF_MEMORY":
            raise OutOfGpuMemory(f"{where}: {error}")
        if error != "GL_NO_ERROR":
            raise RenderFailed(f"{where}: {error}")


class _Read(NamedTuple):
    """A pending readback: its memory, and arrays with the part of each."""

    group: Group
    targets: list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]


def _context_on(index: int) -> moderngl.Context:
    settings: dict[str, Any] = {"backend": "egl", "device_index": index}
    return moderngl.create_context(standalone=True, require=430, **settings)


def _joined(
    arrays: dict[str, NDArray[Any]],
) -> tuple[NDArray[np.uint8], dict[str, tuple[int, int]]]:
    """Return aligned arrays one after the other, and first byte and size of each."""
    ranges, end = {}, 0
    for name, array in arrays.items():
        ranges[name] = end, max(array.nbytes, PART_ALIGNMENT)
        end += -(-ranges[name][1] // PART_ALIGNMENT) * PART_ALIGNMENT
    joined = np.zeros(end, np.uint8)
    for name, array in arrays.items():
        first = ranges[name][0]
        joined[first : first + array.nbytes] = _bytes_of(np.ascontiguousarray(array))
    return joined, ranges


def _parts(buffer: Buffer, ranges: dict[str, tuple[int, int]]) -> dict[str, BufferPart]:
    return {name: BufferPart(buffer, *part) for name, part in ranges.items()}


def _bytes_of(array: NDArray[Any]) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)
