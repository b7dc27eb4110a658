"""Textures in memory of another process, imported from file descriptors.

OpenGL imports such memory and cannot export it: the descriptor comes from Vulkan.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import stat
import struct
from collections.abc import Collection
from dataclasses import dataclass
from types import SimpleNamespace

from filter_service.errors import BadMessage, RenderFailed
from filter_service.gl.functions import memory_functions
from filter_service.gl.texture_io import INTERNAL_FORMATS
from filter_service.texture_view import GlTexture, TextureMemory, TextureSupport

EXTENSIONS = {"GL_EXT_memory_object", "GL_EXT_memory_object_fd"}
GL_TEXTURE_2D, GL_TEXTURE_BINDING_2D = 0x0DE1, 0x8069
GL_TEXTURE_WIDTH, GL_TEXTURE_HEIGHT = 0x1000, 0x1001
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
    """Check memory of Mesa's software renderer, which maps what its header says.

    Raises
    ------
    BadMessage
        If the file could shrink, which would end this process by a bus error, is
        smaller than its header says, or does not have the stated size.
    """
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
