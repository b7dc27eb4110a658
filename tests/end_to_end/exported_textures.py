"""A client with an OpenGL context, and memory as Mesa's Vulkan driver exports it.

OpenGL only imports memory.  The descriptors of this module have the same bytes as those
that lavapipe, Vulkan of the same Mesa, returns by `vkGetMemoryFdKHR`: a sealed file in
memory with a header of its size, the offset of the data, and the driver's identifier.
"""

import fcntl
import hashlib
import mmap
import os
import struct
from contextlib import contextmanager
from dataclasses import dataclass

import moderngl
import numpy as np

from filter_service.gl.texture_io import TextureImporter
from filter_service.texture_view import BYTES_PER_PIXEL, TextureMemory
from tests.numerical.gl_textures import FORMATS, TEXTURE_2D, Textures

DATA_START = 4096
SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
DRIVER_ID = hashlib.sha1(b"llvmpipe").digest()[:16]


def size_of(kind, size_px):
    """The bytes that llvmpipe needs: blocks of 4 pixels, rows of 64 bytes."""
    width, height = (-(-side // 4) * 4 for side in size_px)
    return -(-width * BYTES_PER_PIXEL[kind] // 64) * 64 * height


def export(size_bytes, *, seals=SEALS, driver=DRIVER_ID, start=DATA_START, stated=None):
    """Return the descriptor of new memory."""
    total = DATA_START + size_bytes
    descriptor = os.memfd_create("exported", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.posix_fallocate(descriptor, 0, total)
    with mmap.mmap(descriptor, total) as memory:
        memory[:32] = struct.pack("<QQ", stated or total, start) + driver
        memory[DATA_START - 8 : DATA_START] = struct.pack("<Q", start)
    if seals:
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
    return descriptor


@dataclass
class Exported:
    """A texture of this process, and how to share it."""

    descriptor: int
    imported: object
    memory: TextureMemory

    @property
    def texture(self):
        return self.imported.texture

    def share(self, client, **changes):
        """Share it with the service; return its number."""
        memory = self.memory
        values = {
            "width_px": memory.width_px,
            "height_px": memory.height_px,
            "format": memory.format,
            "size_bytes": memory.size_bytes,
        }
        return client.share_texture(self.descriptor, **values | changes)


class ExportingContext:
    """The current context, with textures in exported memory."""

    def __init__(self, context):
        self.textures = Textures()
        self._importer = TextureImporter(context.extensions, is_software=True)
        self._context = context
        self._all = []

    @property
    def device_uuid(self):
        return self._importer.support.device_uuids[0]

    def new(self, kind, size_px, pixels=None):
        """A texture of a format; ``pixels`` have their last row first."""
        size_bytes = size_of(kind, size_px)
        descriptor = export(size_bytes)
        memory = TextureMemory(*size_px, kind, size_bytes)
        imported = self._importer.import_texture(memory, os.dup(descriptor))
        self._all.append(Exported(descriptor, imported, memory))
        if pixels is not None:
            self.write(self._all[-1], pixels)
        return self._all[-1]

    def write(self, exported, pixels):
        """Fill a texture, and wait for the GPU."""
        memory = exported.memory
        _, form, kind_of, dtype, _ = FORMATS[memory.format]
        data = np.ascontiguousarray(pixels, dtype)
        self.textures.glBindTexture(TEXTURE_2D, exported.texture.name)
        size_px = memory.width_px, memory.height_px
        place = (TEXTURE_2D, 0, 0, 0, *size_px, form, kind_of)
        self.textures.glTexSubImage2D(*place, data.ctypes.data)
        self._context.finish()

    def read(self, exported):
        """The pixels of a texture."""
        size_px = exported.memory.width_px, exported.memory.height_px
        return self.textures.read(exported.texture, size_px)

    def close(self):
        self._context.finish()
        for exported in self._all:
            self._importer.release(exported.imported)
            os.close(exported.descriptor)


@contextmanager
def exporting_context():
    """A context of the client, current within."""
    context = moderngl.create_context(standalone=True, backend="egl", require=430)
    with context:
        exporting = ExportingContext(context)
        try:
            yield exporting
        finally:
            exporting.close()
    context.release()
