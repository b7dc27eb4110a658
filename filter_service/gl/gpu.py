"""The OpenGL context, buffers and programs: the home of moderngl."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from filter_service import constants
from filter_service.errors import OutOfGpuMemory, RenderFailed, ShaderError
from filter_service.gl.choose_device import open_on_device
from filter_service.gl.copying import copy_bytes
from filter_service.gl.hardware import is_software_renderer
from filter_service.gl.shader_source import legend, load_shader
from filter_service.gl.staging import ALIGNMENT, Staging, gl_calls, has_buffer_storage
from filter_service.gl_device import checked_gl_device, wanted_gl_device

Buffer = moderngl.Buffer
Query = moderngl.Query
Pages = moderngl.TextureArray
Atlas = moderngl.Buffer | moderngl.Texture

GROWTH = 1.25
"""A buffer that must grow gets this much more than asked, so that slowly rising needs
do not reallocate every frame."""

ATLAS_TEXEL_BYTES = 16

ATLAS_BYTES = 1 << 30
"""More than an atlas ever takes: twice the kernels of a frame."""

ATLAS_BINDINGS = {"ATLAS": "ATLAS", "NODES": "NODE_ATLAS"}
"""Of atlases that are buffers, by the name of their texture."""

POINTS = {
    name.removeprefix("BINDING_"): point for name, point in constants.BINDINGS.items()
}

PASS_BLOCKS = 9
"""Storage blocks of the pass with most, if an atlas is one of them."""


_BARRIERS = (
    moderngl.SHADER_STORAGE_BARRIER_BIT
    | moderngl.COMMAND_BARRIER_BIT  # sizes of dispatches that a pass has written
    | moderngl.BUFFER_UPDATE_BARRIER_BIT  # copies to mapped memory
)
_IMAGE_BARRIERS = (
    _BARRIERS
    | moderngl.SHADER_IMAGE_ACCESS_BARRIER_BIT
    | moderngl.TEXTURE_FETCH_BARRIER_BIT
)
"""What comes after a pass and may read what it wrote."""


class BufferPart(NamedTuple):
    """Some bytes of a buffer, for a pass that has them as its own.

    It begins at a multiple of 256 bytes: any device allows that.
    """

    buffer: Buffer
    first_byte: int
    n_bytes: int


class Gpu:
    """A standalone EGL context with named, grow-only storage buffers.

    Parameters
    ----------
    device : str, optional
        "auto", or the index of an EGL device; else what the environment asks for.

    Attributes
    ----------
    info : dict
        Renderer, version, index of the EGL device, and the limits that the renderer
        plans with.
    is_software : bool
        Whether a CPU does the work.
    """

    def __init__(self, device: str | None = None) -> None:
        choice = wanted_gl_device() if device is None else checked_gl_device(device)
        self.context, index = open_on_device(choice, _context_on)
        info = self.context.info
        self.info = {
            "renderer": info["GL_RENDERER"],
            "version": info["GL_VERSION"],
            "vendor": info["GL_VENDOR"],
            "device": index,
            "max_storage_block_bytes": info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"],
        }
        self.is_software = is_software_renderer(self.info["renderer"])
        self.max_block_bytes = int(info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])
        self._buffers: dict[str, moderngl.Buffer] = {}
        self._programs: dict[tuple, moderngl.ComputeShader] = {}
        self._variants: dict[tuple, moderngl.ComputeShader] = {}
        self._atlases: dict[str, moderngl.Texture] = {}
        self._uniforms: dict[moderngl.ComputeShader, dict] = {}
        self._queries: list[moderngl.Query] = []
        self._owners: dict[str, object] = {}
        self._reads: list[_Read] = []
        self._bound: dict[int, Buffer | BufferPart] = {}
        self.atlas_is_buffer = not self.is_software and self._holds_large_atlases()
        # On a software renderer all memory is the host's: a copy more gains nothing.
        self.use_staging(not self.is_software)

    def _holds_large_atlases(self) -> bool:
        """Whether a pass may have an atlas of any size beside its other buffers."""
        blocks = int(self.context.info["GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS"])
        return blocks >= PASS_BLOCKS and self.max_block_bytes >= ATLAS_BYTES

    def use_staging(self, wanted: bool) -> None:
        """Send and fetch through mapped memory, where the driver has it, or not."""
        calls = gl_calls() if wanted and has_buffer_storage(self.context) else None
        self._staging = (
            None
            if calls is None
            else {way: Staging(self.context, calls) for way in ("to", "from")}
        )

    def close(self) -> None:
        """Free everything; the object is of no use afterwards."""
        with self.context:  # without one, the driver frees nothing
            for memory in (*self._buffers.values(), *self._atlases.values()):
                memory.release()
            for program in self._programs.values():
                program.release()
            for block in (self._staging or {}).values():
                block.release()
        self._buffers.clear()
        self._atlases.clear()
        self._programs.clear()
        self.context.release()

    # ----- buffers

    def storage(self, name: str, n_bytes: int) -> moderngl.Buffer:
        """Buffer of at least this size; its contents are lost when it grows.

        Raises
        ------
        OutOfGpuMemory
            More than one storage block may hold, or than the device has.
        """
        buffer = self._buffers.get(name)
        if buffer is not None and buffer.size >= n_bytes:
            return buffer
        if n_bytes > self.max_block_bytes:
            raise OutOfGpuMemory(
                f"buffer '{name}' needs {n_bytes / 1e6:.0f} MB, "
                f"a storage block holds {self.max_block_bytes / 1e6:.0f} MB here"
            )
        wanted = max(int(n_bytes * (GROWTH if buffer is not None else 1.0)), 16)
        if buffer is not None:
            buffer.release()
            del self._buffers[name]
        try:
            created = self.context.buffer(reserve=min(wanted, self.max_block_bytes))
        except moderngl.Error as error:
            raise OutOfGpuMemory(
                f"buffer '{name}' of {wanted} bytes: {error}"
            ) from error
        self._buffers[name] = created
        return created

    def upload(self, name: str, *arrays: NDArray) -> moderngl.Buffer:
        """Copy arrays to the start of a named buffer, one behind the other."""
        buffer = self.storage(name, sum(data.nbytes for data in arrays))
        start = 0
        for data in arrays:
            self.write(buffer, data, offset=start)
            start += data.nbytes
        return buffer

    def write(self, buffer: moderngl.Buffer, data: NDArray, *, offset: int = 0) -> None:
        """Copy an array into a buffer."""
        if not data.nbytes:
            return
        words = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        if self._staging is None:
            buffer.write(words, offset=offset)
            return
        block = self._staging["to"]
        start, free = block.take(words.size)
        copy_bytes(free, words)
        block.copy_to(buffer, start, offset, words.size)

    def pages(self, n_words: int) -> Pages:
        """Texture array of 16-bit words for data that outlives a frame.

        Pages of STORE_SIDE lines of STORE_SIDE words; the last line, or page, is whole.

        Raises
        ------
        OutOfGpuMemory
            More pages than a texture array may have, or than the device holds.
        """
        side = constants.STORE_SIDE
        lines = max(-(-n_words // side), 1)
        count = -(-lines // side)
        limit = int(self.context.info["GL_MAX_ARRAY_TEXTURE_LAYERS"])
        size = (side, min(lines, side), count)
        if count <= limit:
            try:
                pages = self.context.texture_array(size, 1, dtype="u2")
            except moderngl.Error as error:
                raise OutOfGpuMemory(
                    f"{2e-6 * n_words:.0f} MB of PSFs: {error}"
                ) from error
            pages.filter = (moderngl.NEAREST, moderngl.NEAREST)
            return pages
        raise OutOfGpuMemory(
            f"{2e-6 * n_words:.0f} MB of PSFs, a texture array holds "
            f"{2e-6 * limit * side * side:.0f} MB here; narrow the pupil, focus or "
            "object range, or use a smaller image"
        )

    def write_pages(self, pages: Pages, first_line: int, lines: NDArray) -> None:
        """Copy whole lines (n, STORE_SIDE) of words to pages, from a line on."""
        side = constants.STORE_SIDE
        while len(lines):
            page, row = divmod(first_line, side)
            count = min(len(lines), side - row)
            pages.write(
                np.ascontiguousarray(lines[:count]),
                viewport=(0, row, page, side, count, 1),
            )
            first_line, lines = first_line + count, lines[count:]

    def atlas(self, name: str, n_texels: int) -> Atlas:
        """Named, grow-only line of texels of four uints.

        A storage buffer, or a texture in lines of ATLAS_WIDTH, see `atlas_is_buffer`.
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
                f"the frame's kernels need {n_texels} texels, "
                f"a texture holds {limit * constants.ATLAS_WIDTH} here"
            )
        wanted = rows
        if atlas is not None:
            atlas.release()
            del self._atlases[name]
            wanted = min(int(rows * GROWTH) + 1, limit)
        atlas = self.context.texture((constants.ATLAS_WIDTH, wanted), 4, dtype="u4")
        atlas.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._atlases[name] = atlas
        return atlas

    def claim(self, name: str, owner: object) -> None:
        """Note who has filled memory of a name last."""
        self._owners[name] = owner

    def is_owner(self, name: str, owner: object) -> bool:
        """Return whether nobody else has filled it since."""
        return self._owners.get(name) is owner

    def read(self, buffer: moderngl.Buffer, shape: tuple, dtype) -> NDArray:
        """Read the start of a buffer as an array; waits for the GPU."""
        out = np.empty(shape, dtype=dtype)
        self.read_into((buffer, 0, out))
        return out

    def read_into(self, *parts: tuple[moderngl.Buffer, int, NDArray]) -> None:
        """Fill arrays from buffers, each from a byte on; waits for the GPU once."""
        self.begin_read(*parts)()

    def begin_read(
        self, *parts: tuple[moderngl.Buffer, int, NDArray]
    ) -> Callable[[], None]:
        """Have buffers sent; call what is returned to wait for it and fill the arrays.

        What is dispatched between may change the buffers.  Without mapped memory it is
        done at once.
        """
        parts = tuple(part for part in parts if part[2].nbytes)
        if self._staging is None:
            for buffer, offset, out in parts:
                buffer.read_into(_bytes_of(out), size=out.nbytes, offset=offset)
            return lambda: None
        block = self._staging["from"]
        room = sum(out.nbytes + ALIGNMENT for _, _, out in parts)
        if not block.has_room(room):
            for waiting in tuple(self._reads):
                self._end_read(waiting)
        start, free = block.take(room)
        targets, at = [], 0
        for buffer, offset, out in parts:
            block.copy_from(buffer, offset, start + at, out.nbytes)
            targets.append((_bytes_of(out), free[at : at + out.nbytes]))
            at += -(-out.nbytes // ALIGNMENT) * ALIGNMENT
        waiting = _Read(block.fence(), targets)
        self._reads.append(waiting)
        return partial(self._end_read, waiting)

    def _end_read(self, waiting: "_Read") -> None:
        if not any(one is waiting for one in self._reads):
            return
        self._reads = [one for one in self._reads if one is not waiting]
        self._staging["from"].wait(waiting.fence)
        for target, source in waiting.targets:
            copy_bytes(target, source)
        if not self._reads:
            for block in self._staging.values():
                block.reset()  # nothing waits any more

    @property
    def memory_mb(self) -> float:
        """Bytes held by the named buffers and atlases."""
        buffers = sum(buffer.size for buffer in self._buffers.values())
        texels = sum(a.width * a.height for a in self._atlases.values())
        return (buffers + ATLAS_TEXEL_BYTES * texels) / 1e6

    # ----- programs

    @property
    def program_count(self) -> int:
        """Passes compiled so far, each variant by itself."""
        return len(self._programs)

    def program(self, name: str, **defines: int) -> moderngl.ComputeShader:
        """Compiled pass ``shaders/passes/<name>.comp.glsl``, kept for reuse."""
        program = self._variants.get((name, *defines.items()))
        if program is not None:
            return program
        key = (name, *sorted(defines.items()))
        if key not in self._programs:
            text, files = load_shader(f"passes/{name}.comp.glsl", **defines)
            try:
                self._programs[key] = self.context.compute_shader(text)
            except moderngl.Error as error:
                raise ShaderError(legend(str(error), files)) from error
        self._variants[name, *defines.items()] = self._programs[key]
        return self._programs[key]

    def dispatch(
        self,
        name: str,
        groups: tuple[int, ...],
        *,
        buffers: dict[str, moderngl.Buffer | BufferPart],
        uniforms: dict | None = None,
        defines: dict | None = None,
        images: dict[str, Atlas] | None = None,
        textures: dict[str, Atlas | Pages] | None = None,
        indirect: tuple[moderngl.Buffer, int] | None = None,
    ) -> None:
        """Run a pass and order its writes before what follows.

        Parameters
        ----------
        groups : (x, y) or (x, y, z)
        buffers : dict
            Binding name without the ``BINDING_`` prefix to buffer, or a part of one.
        uniforms : dict, optional
            A uniform that the compiler removed is skipped.
        defines : dict, optional
            Variant of the pass.
        images, textures : dict, optional
            Name without the ``IMAGE_`` or ``TEXTURE_`` prefix to texture, or to what
            `atlas` returned.
        indirect : (buffer, byte), optional
            Where on the GPU the groups stand; ``groups`` are not looked at.
        """
        program, images, textures = self._variant_of(
            name, defines or {}, buffers, images or {}, textures or {}
        )
        for binding, buffer in buffers.items():
            self._bind(POINTS[binding], buffer)
        self._set_uniforms(program, uniforms or {})
        for name_of, image in images.items():
            unit = getattr(constants, f"IMAGE_{name_of}")
            image.bind_to_image(unit, read=True, write=True)
        for name_of, texture in textures.items():
            texture.use(getattr(constants, f"TEXTURE_{name_of}"))
        if indirect is not None:
            program.run_indirect(*indirect)
        else:
            program.run(*(max(count, 1) for count in (*groups, 1)[:3]))
        self.context.memory_barrier(_IMAGE_BARRIERS if images else _BARRIERS)

    def _variant_of(
        self, name: str, defines: dict, buffers: dict, images: dict, textures: dict
    ) -> tuple[moderngl.ComputeShader, dict, dict]:
        """Return a pass and its images and textures; buffers among them are bound."""
        is_buffer = False
        for named in (images, textures):
            for key, atlas in named.items():
                if isinstance(atlas, Buffer):
                    self._bind(POINTS[ATLAS_BINDINGS[key]], atlas)
                    is_buffer = True
        if is_buffer:
            defines = {**defines, "ATLAS_IS_BUFFER": 1}
            images, textures = _no_buffers(images), _no_buffers(textures)
        return self.program(name, **defines), images, textures

    def _bind(self, point: int, buffer: moderngl.Buffer | BufferPart) -> None:
        """Bind a buffer, unless it is: from frame to frame most of them stay.

        What is kept here is the buffer itself, so that no other takes its place.
        """
        if self._bound.get(point) == buffer:
            return
        if isinstance(buffer, BufferPart):
            whole, first, size = buffer
            whole.bind_to_storage_buffer(point, offset=first, size=size)
        else:
            buffer.bind_to_storage_buffer(point)
        self._bound[point] = buffer

    def _set_uniforms(self, program: moderngl.ComputeShader, uniforms: dict) -> None:
        """Set those that differ from the last dispatch's: each is a driver call."""
        known = self._uniforms.setdefault(program, {})
        for key, value in uniforms.items():
            if key in known and known[key] == value:
                continue
            known[key] = value
            member = program.get(key, None)
            if member is not None:
                member.value = value

    def take_query(self) -> moderngl.Query:
        """Return a timer that is not in use; see `give_queries`."""
        return self._queries.pop() if self._queries else self.context.query(time=True)

    def give_queries(self, queries: list[moderngl.Query]) -> None:
        """Take timers back: none is ever freed, so each is used again."""
        self._queries += queries

    def check(self, where: str) -> None:
        """Raise if OpenGL has noted an error since the last look."""
        error = self.context.error
        if error == "GL_OUT_OF_MEMORY":
            raise OutOfGpuMemory(f"{where}: {error}")
        if error != "GL_NO_ERROR":
            raise RenderFailed(f"{where}: {error}")


class _Read(NamedTuple):
    """What was sent: after a fence, to arrays from mapped memory."""

    fence: int
    targets: list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]


def _context_on(index: int) -> moderngl.Context:
    return moderngl.create_context(
        standalone=True, require=430, backend="egl", device_index=index
    )


def _no_buffers(named: dict) -> dict:
    return {key: kept for key, kept in named.items() if not isinstance(kept, Buffer)}


def _bytes_of(array: NDArray) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)
