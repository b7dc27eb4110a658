"""Textures of the caller as input and output of passes, in its own context."""

from __future__ import annotations

import ctypes
import os
import stat
import struct
from collections.abc import Collection
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import moderngl

from filter_service.constants import TEXTURE_COLOR
from filter_service.errors import BadMessage, RenderFailed
from filter_service.gl.current_context import memory_functions
from filter_service.texture_view import (
    COLOR_FORMATS,
    GlTexture,
    TextureMemory,
    TextureSupport,
    TextureView,
)

GL_RENDERBUFFER, GL_RENDERBUFFER_BINDING = 0x8D41, 0x8CA7
GL_RENDERBUFFER_WIDTH, GL_RENDERBUFFER_HEIGHT = 0x8D42, 0x8D43
GL_RENDERBUFFER_INTERNAL_FORMAT = 0x8D44
GL_READ_FRAMEBUFFER, GL_DRAW_FRAMEBUFFER = 0x8CA8, 0x8CA9
GL_COLOR_ATTACHMENT0, GL_DEPTH_ATTACHMENT = 0x8CE0, 0x8D00
GL_COLOR_BUFFER_BIT, GL_DEPTH_BUFFER_BIT = 0x4000, 0x0100
GL_FRAMEBUFFER_COMPLETE, GL_NEAREST = 0x8CD5, 0x2600
GL_TEXTURE_2D, GL_TEXTURE_2D_ARRAY, GL_TEXTURE0 = 0x0DE1, 0x8C1A, 0x84C0
GL_TEXTURE_BINDING_2D, GL_TEXTURE_INTERNAL_FORMAT = 0x8069, 0x1003
GL_TEXTURE_WIDTH, GL_TEXTURE_HEIGHT, GL_TEXTURE_DEPTH = 0x1000, 0x1001, 0x8071

UNSIZED = {0x1908: 0x8058}
"""Sized formats, as textures need them, of formats without a size."""

_uint = ctypes.c_uint


class Renderbuffers:
    """Copies of renderbuffers, each by one blit, in textures that are kept.

    Parameters
    ----------
    functions : SimpleNamespace
        From `gl_functions`.
    """

    def __init__(self, functions: SimpleNamespace) -> None:
        self._gl = functions
        self._framebuffers = (_uint * 2)()
        self._copies: dict[str, tuple[tuple[int, ...], int]] = {}

    def release(self) -> None:
        """Free the OpenGL objects."""
        for _, name in self._copies.values():
            self._gl.glDeleteTextures(1, ctypes.byref(_uint(name)))
        if self._framebuffers[0]:
            self._gl.glDeleteFramebuffers(2, self._framebuffers)
        self._copies.clear()

    def properties(self, name: int) -> tuple[tuple[int, int], int]:
        """Return the size and the internal format of a renderbuffer."""
        bound = ctypes.c_int(0)
        self._gl.glGetIntegerv(GL_RENDERBUFFER_BINDING, ctypes.byref(bound))
        self._gl.glBindRenderbuffer(GL_RENDERBUFFER, name)
        width_px, height_px, internal = (
            self._parameter(key)
            for key in (
                *(GL_RENDERBUFFER_WIDTH, GL_RENDERBUFFER_HEIGHT),
                GL_RENDERBUFFER_INTERNAL_FORMAT,
            )
        )
        self._gl.glBindRenderbuffer(GL_RENDERBUFFER, bound.value)
        return (width_px, height_px), internal

    def _parameter(self, name: int) -> int:
        found = ctypes.c_int(0)
        self._gl.glGetRenderbufferParameteriv(
            GL_RENDERBUFFER, name, ctypes.byref(found)
        )
        return found.value

    def copied(self, renderbuffer: GlTexture, size_px: tuple[int, int]) -> GlTexture:
        """Copy a renderbuffer to a texture of its format; return the texture.

        Raises
        ------
        RenderFailed
            OpenGL cannot copy it.
        """
        gl = self._gl
        is_color = renderbuffer.format in COLOR_FORMATS or renderbuffer.format == "r32f"
        attachment = GL_COLOR_ATTACHMENT0 if is_color else GL_DEPTH_ATTACHMENT
        texture = self._copy_of(renderbuffer, size_px)
        if not self._framebuffers[0]:
            gl.glGenFramebuffers(2, self._framebuffers)
        read, draw = self._framebuffers
        gl.glBindFramebuffer(GL_READ_FRAMEBUFFER, read)
        gl.glFramebufferRenderbuffer(
            GL_READ_FRAMEBUFFER, attachment, GL_RENDERBUFFER, renderbuffer.name
        )
        gl.glBindFramebuffer(GL_DRAW_FRAMEBUFFER, draw)
        gl.glFramebufferTexture2D(
            GL_DRAW_FRAMEBUFFER, attachment, GL_TEXTURE_2D, texture, 0
        )
        statuses = {
            gl.glCheckFramebufferStatus(target)
            for target in (GL_READ_FRAMEBUFFER, GL_DRAW_FRAMEBUFFER)
        }
        if statuses == {GL_FRAMEBUFFER_COMPLETE}:
            mask = GL_COLOR_BUFFER_BIT if is_color else GL_DEPTH_BUFFER_BIT
            gl.glBlitFramebuffer(0, 0, *size_px, 0, 0, *size_px, mask, GL_NEAREST)
        # Nothing stays attached, so that color and depth do not meet.
        gl.glFramebufferRenderbuffer(
            GL_READ_FRAMEBUFFER, attachment, GL_RENDERBUFFER, 0
        )
        gl.glFramebufferTexture2D(GL_DRAW_FRAMEBUFFER, attachment, GL_TEXTURE_2D, 0, 0)
        if statuses != {GL_FRAMEBUFFER_COMPLETE}:
            found = ", ".join(f"{status:#x}" for status in sorted(statuses))
            raise RenderFailed(
                f"cannot copy renderbuffer {renderbuffer.name}: framebuffer status "
                f"{found}"
            )
        return GlTexture(texture, renderbuffer.format)

    def _copy_of(self, renderbuffer: GlTexture, size_px: tuple[int, int]) -> int:
        """Return the texture for copies, one for each format; another size is new."""
        gl = self._gl
        _, internal = self.properties(renderbuffer.name)
        shape = *size_px, UNSIZED.get(internal, internal)
        known, name = self._copies.get(renderbuffer.format, ((), 0))
        if known == shape:
            return name
        if name:
            gl.glDeleteTextures(1, ctypes.byref(_uint(name)))
        made = _uint(0)
        gl.glGenTextures(1, ctypes.byref(made))
        gl.glActiveTexture(GL_TEXTURE0 + TEXTURE_COLOR)  # a unit that is kept
        gl.glBindTexture(GL_TEXTURE_2D, made.value)
        gl.glTexStorage2D(GL_TEXTURE_2D, 1, shape[2], *size_px)
        self._copies[renderbuffer.format] = shape, made.value
        return made.value


GL_TEXTURE_SRGB_DECODE_EXT, GL_SKIP_DECODE_EXT = 0x8A48, 0x8A4A
SRGB_DECODE = "GL_EXT_texture_sRGB_decode"

NEAREST_PARAMETERS = {
    0x2800: 0x2600,  # magnification: nearest
    0x2801: 0x2600,  # minification: nearest, without mipmaps
    0x884C: 0,  # no comparison of depth
}

INTERNAL_FORMATS = {
    "rgba8": (0x8058, 0x1908),
    "srgb8_a8": (0x8C43,),
    "rgba16f": (0x881A,),
    "d32f": (0x8CAC, 0x8CAD),  # without or with stencil
    "d24": (0x81A6, 0x88F0),
    "r32f": (0x822E,),
}
"""OpenGL's internal formats of each format."""


class BoundTexture:
    """A texture of the caller that passes sample.

    Parameters
    ----------
    sampler : int
        Name of a sampler to use instead of the texture's parameters.
    """

    def __init__(
        self, functions: SimpleNamespace, texture: GlTexture, sampler: int
    ) -> None:
        self._gl, self._texture, self._sampler = functions, texture, sampler

    def use(self, location: int) -> None:
        """Bind the texture and the sampler to a unit."""
        gl = self._gl
        gl.glActiveTexture(GL_TEXTURE0 + location)
        gl.glBindTexture(target_of(self._texture), self._texture.name)
        gl.glBindSampler(location, self._sampler)


class TextureIo:
    """Sampler and framebuffer for the caller's textures.

    Parameters
    ----------
    context : moderngl.Context
    functions : SimpleNamespace
        From `gl_functions`.

    Attributes
    ----------
    skips_decoding : bool
        Whether sRGB textures are sampled without decoding, so that shaders decode them
        as exactly as arrays.
    """

    def __init__(self, context: moderngl.Context, functions: SimpleNamespace) -> None:
        self._context, self._gl = context, functions
        self._triangles: dict[moderngl.Program, moderngl.VertexArray] = {}
        self._sampler = ctypes.c_uint(0)
        functions.glGenSamplers(1, ctypes.byref(self._sampler))
        parameters = dict(NEAREST_PARAMETERS)
        self.skips_decoding = SRGB_DECODE in context.extensions
        if self.skips_decoding:
            parameters[GL_TEXTURE_SRGB_DECODE_EXT] = GL_SKIP_DECODE_EXT
        for name, value in parameters.items():
            functions.glSamplerParameteri(self._sampler.value, name, value)
        self._framebuffer = ctypes.c_uint(0)
        functions.glGenFramebuffers(1, ctypes.byref(self._framebuffer))
        self._checked: set[tuple[Any, ...]] = set()
        self._renderbuffers = Renderbuffers(functions)

    def release(self) -> None:
        """Free the OpenGL objects."""
        for triangle in self._triangles.values():
            triangle.release()
        self._gl.glDeleteSamplers(1, ctypes.byref(self._sampler))
        self._gl.glDeleteFramebuffers(1, ctypes.byref(self._framebuffer))
        self._renderbuffers.release()

    def in_textures(self, view: TextureView) -> TextureView:
        """Return a view with renderbuffers copied to textures, for one frame.

        Raises
        ------
        RenderFailed
            OpenGL cannot copy them.
        """
        size_px = view.width_px, view.height_px
        if not (view.color.is_renderbuffer or view.depth.is_renderbuffer):
            return view
        color, depth = (
            self._renderbuffers.copied(image, size_px)
            if image.is_renderbuffer
            else image
            for image in (view.color, view.depth)
        )
        return replace(view, color=color, depth=depth)

    def input(self, texture: GlTexture) -> BoundTexture:
        """Return a texture that passes can sample."""
        return BoundTexture(self._gl, texture, self._sampler.value)

    def check(self, texture: GlTexture, size_px: tuple[int, int], field: str) -> None:
        """Check size and format of a texture or renderbuffer, once for each.

        Raises
        ------
        BadMessage
        """
        key = texture, size_px
        if key in self._checked:
            return
        kind = "renderbuffer" if texture.is_renderbuffer else "texture"
        exists = (
            self._gl.glIsRenderbuffer
            if texture.is_renderbuffer
            else self._gl.glIsTexture
        )
        if not exists(texture.name):
            raise BadMessage(
                f"{texture.name}", field=f"{field}.name", allowed=f"an existing {kind}"
            )
        found_px, internal = (
            self._renderbuffers.properties(texture.name)
            if texture.is_renderbuffer
            else self._properties(texture, field)
        )
        if found_px != size_px:
            raise BadMessage(
                f"{kind} {texture.name} has {found_px[0]}x{found_px[1]} px",
                field=field,
                allowed=f"{size_px[0]}x{size_px[1]} px, the size of the view",
            )
        if internal not in INTERNAL_FORMATS[texture.format]:
            known = [
                name for name, all_ in INTERNAL_FORMATS.items() if internal in all_
            ]
            raise BadMessage(
                f"{kind} {texture.name} is of internal format "
                f"{known[0] if known else hex(internal)}",
                field=f"{field}.format",
                allowed=f"{texture.format}, as declared",
            )
        self._checked.add(key)

    def _properties(
        self, texture: GlTexture, field: str
    ) -> tuple[tuple[int, int], int]:
        """Return size and internal format of a texture; check its target and layer."""
        gl, target = self._gl, target_of(texture)
        gl.glGetError()
        gl.glActiveTexture(GL_TEXTURE0 + TEXTURE_COLOR)  # a unit that is kept
        gl.glBindTexture(target, texture.name)
        if gl.glGetError():
            kind = "GL_TEXTURE_2D" if texture.layer is None else "GL_TEXTURE_2D_ARRAY"
            raise BadMessage(
                f"texture {texture.name} is of another target",
                field=f"{field}.name",
                allowed=f"a {kind}",
            )
        width_px, height_px, layers, internal = (
            self._parameter(target, name)
            for name in (
                *(GL_TEXTURE_WIDTH, GL_TEXTURE_HEIGHT, GL_TEXTURE_DEPTH),
                GL_TEXTURE_INTERNAL_FORMAT,
            )
        )
        if texture.layer is not None and texture.layer >= layers:
            raise BadMessage(
                f"{texture.layer}", field=f"{field}.layer", allowed=f"0 to {layers - 1}"
            )
        return (width_px, height_px), internal

    def forget(self) -> None:
        """Check all textures again: names of deleted textures are used for others."""
        self._checked.clear()

    def _parameter(self, target: int, name: int) -> int:
        found = ctypes.c_int(0)
        self._gl.glGetTexLevelParameteriv(target, 0, name, ctypes.byref(found))
        return found.value

    def draw(
        self, program: moderngl.Program, texture: GlTexture, size_px: tuple[int, int]
    ) -> None:
        """Draw a triangle that covers a texture.

        Raises
        ------
        RenderFailed
            OpenGL cannot draw to it.
        """
        gl = self._gl
        gl.glBindFramebuffer(GL_DRAW_FRAMEBUFFER, self._framebuffer.value)
        # Attached for each call: the name of a deleted texture may belong to another
        # one now, and draws to a deleted texture succeed while it is attached.
        gl.glFramebufferTexture2D(
            *(GL_DRAW_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_TEXTURE_2D, 0, 0)
        )
        if texture.is_renderbuffer:
            gl.glFramebufferRenderbuffer(
                *(GL_DRAW_FRAMEBUFFER, GL_COLOR_ATTACHMENT0),
                *(GL_RENDERBUFFER, texture.name),
            )
        elif texture.layer is None:
            gl.glFramebufferTexture2D(
                *(GL_DRAW_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_TEXTURE_2D),
                *(texture.name, 0),
            )
        else:
            gl.glFramebufferTextureLayer(
                *(GL_DRAW_FRAMEBUFFER, GL_COLOR_ATTACHMENT0),
                *(texture.name, 0, texture.layer),
            )
        status = gl.glCheckFramebufferStatus(GL_DRAW_FRAMEBUFFER)
        if status != GL_FRAMEBUFFER_COMPLETE:
            raise RenderFailed(
                f"cannot draw to {_kind(texture)} {texture.name}: framebuffer status "
                f"{status:#x}"
            )
        gl.glViewportIndexedf(0, 0.0, 0.0, *map(float, size_px))
        triangle = self._triangles.get(program)
        if triangle is None:
            triangle = self._context.vertex_array(program, [])
            self._triangles[program] = triangle
        # Mesa keeps a program, even a deleted one, if the next one has other stages.
        gl.glUseProgram(0)
        triangle.render(moderngl.TRIANGLES, vertices=3)
        gl.glUseProgram(0)


def target_of(texture: GlTexture) -> int:
    """Return the OpenGL target of a texture."""
    return GL_TEXTURE_2D if texture.layer is None else GL_TEXTURE_2D_ARRAY


def _kind(texture: GlTexture) -> str:
    return "renderbuffer" if texture.is_renderbuffer else "texture"


EXTENSIONS = {"GL_EXT_memory_object", "GL_EXT_memory_object_fd"}
GL_DEDICATED_MEMORY_OBJECT = 0x9581
GL_HANDLE_TYPE_OPAQUE_FD = 0x9586
GL_NUM_DEVICE_UUIDS, GL_DEVICE_UUID, GL_DRIVER_UUID = 0x9596, 0x9597, 0x9598
UUID_BYTES = 16
MAX_DEVICE_UUIDS = 4

_SOFTWARE_HEADER = struct.Struct("<QQ")
"""Size and data offset at the start of a descriptor of Mesa's software renderer."""

MAX_SOFTWARE_HEADER_BYTES = 1 << 16
"""Largest part of such a file besides the allocation: a page and 40 bytes in 22.3."""


@dataclass(frozen=True)
class ImportedTexture:
    """A texture whose memory belongs to another process.

    Attributes
    ----------
    texture : GlTexture
    memory : int
        Name of the memory object.
    """

    texture: GlTexture
    memory: int


class TextureImporter:
    """Imports memory as textures of the current context.

    Parameters
    ----------
    extensions : collection of str
        Extensions of the context.
    is_software : bool
        Whether the renderer runs on the CPU.

    Raises
    ------
    RenderFailed
        If OpenGL cannot import memory.
    """

    def __init__(self, extensions: Collection[str], *, is_software: bool) -> None:
        functions = memory_functions()
        missing = sorted(EXTENSIONS - set(extensions))
        if missing or functions is None:
            raise RenderFailed(f"this OpenGL lacks {' and '.join(missing) or 'memory'}")
        self._gl: SimpleNamespace = functions
        self._is_software = is_software
        self.support = TextureSupport(
            tuple(self._uuid(index) for index in range(self._uuid_count())),
            self._uuid(None),
        )

    def _uuid_count(self) -> int:
        count = ctypes.c_int(0)
        self._gl.glGetIntegerv(GL_NUM_DEVICE_UUIDS, ctypes.byref(count))
        return min(count.value, MAX_DEVICE_UUIDS)

    def _uuid(self, device: int | None) -> str:
        """Return the UUID of a device, or of the driver, as hexadecimal digits."""
        found = (ctypes.c_ubyte * UUID_BYTES)()
        if device is None:
            self._gl.glGetUnsignedBytevEXT(GL_DRIVER_UUID, found)
        else:
            self._gl.glGetUnsignedBytei_vEXT(GL_DEVICE_UUID, device, found)
        return bytes(found).hex()

    def import_texture(self, memory: TextureMemory, descriptor: int) -> ImportedTexture:
        """Return a texture in the memory of a descriptor, which this closes.

        Raises
        ------
        BadMessage
            If OpenGL cannot use the memory for such a texture.
        """
        gl = self._gl
        name, texture = ctypes.c_uint(0), ctypes.c_uint(0)
        before = ctypes.c_int(0)
        is_owned = True
        try:
            if self._is_software:
                _check_software_memory(descriptor, memory.size_bytes)
            while gl.glGetError():
                pass
            gl.glCreateMemoryObjectsEXT(1, ctypes.byref(name))
            is_dedicated = ctypes.c_int(memory.is_dedicated)
            gl.glMemoryObjectParameterivEXT(
                name.value, GL_DEDICATED_MEMORY_OBJECT, ctypes.byref(is_dedicated)
            )
            gl.glImportMemoryFdEXT(
                name.value, memory.size_bytes, GL_HANDLE_TYPE_OPAQUE_FD, descriptor
            )
            error = gl.glGetError()
            is_owned = bool(error)  # otherwise OpenGL has closed it
        finally:
            if is_owned:
                os.close(descriptor)
        gl.glGenTextures(1, ctypes.byref(texture))
        gl.glGetIntegerv(GL_TEXTURE_BINDING_2D, ctypes.byref(before))
        gl.glBindTexture(GL_TEXTURE_2D, texture.value)
        if not error:
            gl.glTexStorageMem2DEXT(
                *(GL_TEXTURE_2D, 1, INTERNAL_FORMATS[memory.format][0]),
                *(memory.width_px, memory.height_px, name.value, 0),
            )
            error = gl.glGetError()
        # Mesa 22.3 reports no error for memory that is too small or of another driver;
        # the texture then has no size.
        size_px = self._parameter(GL_TEXTURE_WIDTH), self._parameter(GL_TEXTURE_HEIGHT)
        gl.glBindTexture(GL_TEXTURE_2D, before.value)
        found = ImportedTexture(GlTexture(texture.value, memory.format), name.value)
        if error or size_px != (memory.width_px, memory.height_px):
            self.release(found)
            raise BadMessage(
                f"OpenGL cannot use it as {memory.width_px} x {memory.height_px} "
                f"{memory.format}" + (f" (error {error:#x})" if error else ""),
                field="descriptor",
                allowed=f"memory of at least {memory.size_bytes} bytes that Vulkan "
                "exported as an opaque descriptor on this device",
            )
        return found

    def _parameter(self, name: int) -> int:
        found = ctypes.c_int(0)
        self._gl.glGetTexLevelParameteriv(GL_TEXTURE_2D, 0, name, ctypes.byref(found))
        return found.value

    def release(self, imported: ImportedTexture) -> None:
        """Free a texture, and then its memory, which llvmpipe's texture still uses."""
        name = ctypes.c_uint(imported.texture.name)
        self._gl.glDeleteTextures(1, ctypes.byref(name))
        name = ctypes.c_uint(imported.memory)
        self._gl.glDeleteMemoryObjectsEXT(1, ctypes.byref(name))


def _check_software_memory(descriptor: int, size_bytes: int) -> None:
    """Check memory of Mesa's software renderer, which maps the size in its header.

    Raises
    ------
    BadMessage
        If the file could shrink, which would end this process by a bus error, is
        smaller than its header says, or does not have the stated size.
    """
    import fcntl  # Unix only, like descriptors of textures

    try:
        found = os.fstat(descriptor)
        is_sealed = stat.S_ISREG(found.st_mode) and bool(
            fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK
        )
        header = os.pread(descriptor, _SOFTWARE_HEADER.size, 0)
        size, offset = _SOFTWARE_HEADER.unpack(header)
    except (OSError, struct.error) as error:
        raise _not_memory(f"it cannot be read: {error}") from None
    if not is_sealed:
        raise _not_memory("its file is not sealed")
    if not _SOFTWARE_HEADER.size <= offset <= size <= found.st_size:
        raise _not_memory(f"its header is wrong: {size} bytes from {offset}")
    most_bytes = size_bytes + MAX_SOFTWARE_HEADER_BYTES  # it is mapped as a whole
    if size - offset < size_bytes or size > most_bytes:
        raise _not_memory(f"it has {size - offset} bytes; size_bytes is {size_bytes}")


def _not_memory(message: str) -> BadMessage:
    return BadMessage(
        message,
        field="descriptor",
        allowed="memory that Vulkan exported as an opaque descriptor on this device",
    )
