"""Textures of a caller, made and read by OpenGL's own functions."""

import ctypes
from dataclasses import dataclass

import numpy as np

from filter_service.gl.current_context import CurrentContext
from filter_service.texture_view import GlTexture

TEXTURE_2D, TEXTURE_2D_ARRAY = 0x0DE1, 0x8C1A
FORMATS = {
    # internal format, format and type of the pixels, their dtype and channels
    "rgba8": (0x8058, 0x1908, 0x1401, np.uint8, 4),
    "srgb8_a8": (0x8C43, 0x1908, 0x1401, np.uint8, 4),
    "rgba16f": (0x881A, 0x1908, 0x140B, np.float16, 4),
    "d32f": (0x8CAC, 0x1902, 0x1406, np.float32, 1),
    "d24": (0x81A6, 0x1902, 0x1405, np.uint32, 1),
    "r32f": (0x822E, 0x1903, 0x1406, np.float32, 1),
}

_uint, _int, _pointer = ctypes.c_uint, ctypes.c_int, ctypes.c_void_p
_PROTOTYPES = {
    "glGenTextures": (_int, _pointer),
    "glDeleteTextures": (_int, _pointer),
    "glBindTexture": (_uint, _uint),
    "glPixelStorei": (_uint, _int),
    "glTexStorage2D": (_uint, _int, _uint, _int, _int),
    "glTexStorage3D": (_uint, _int, _uint, _int, _int, _int),
    "glTexSubImage2D": (_uint, *(_int,) * 5, _uint, _uint, _pointer),
    "glTexSubImage3D": (_uint, *(_int,) * 7, _uint, _uint, _pointer),
    "glGetTexImage": (_uint, _int, _uint, _uint, _pointer),
}


@dataclass
class Textures:
    """Makes textures in the current context."""

    def __post_init__(self):
        context = CurrentContext()
        for name, arguments in _PROTOTYPES.items():
            address = context.load_opengl_function(name)
            setattr(self, name, ctypes.CFUNCTYPE(None, *arguments)(address))
        self.glPixelStorei(0x0CF5, 1)
        self.glPixelStorei(0x0D05, 1)

    def new(self, kind, size_px, pixels=None, *, layer=None, layer_count=3):
        """Return a texture of a format; ``pixels`` have their last row first."""
        internal, form, kind_of, dtype, _ = FORMATS[kind]
        name = _uint()
        self.glGenTextures(1, ctypes.byref(name))
        data = None if pixels is None else np.ascontiguousarray(pixels, dtype)
        if layer is None:
            self.glBindTexture(TEXTURE_2D, name.value)
            self.glTexStorage2D(TEXTURE_2D, 1, internal, *size_px)
            if data is not None:
                place = (TEXTURE_2D, 0, 0, 0, *size_px, form, kind_of)
                self.glTexSubImage2D(*place, data.ctypes.data)
        else:
            self.glBindTexture(TEXTURE_2D_ARRAY, name.value)
            self.glTexStorage3D(TEXTURE_2D_ARRAY, 1, internal, *size_px, layer_count)
            if data is not None:
                place = (TEXTURE_2D_ARRAY, 0, 0, 0, layer, *size_px, 1, form, kind_of)
                self.glTexSubImage3D(*place, data.ctypes.data)
        return GlTexture(name.value, kind, layer)

    def read(self, texture, size_px, *, layer_count=3):
        """Return the pixels (height, width, channels) of a texture or its layer."""
        _, form, kind_of, dtype, channels = FORMATS[texture.format]
        width, height = size_px
        count = 1 if texture.layer is None else layer_count
        found = np.empty((count, height, width, channels), dtype)
        target = TEXTURE_2D if texture.layer is None else TEXTURE_2D_ARRAY
        self.glBindTexture(target, texture.name)
        self.glGetTexImage(target, 0, form, kind_of, found.ctypes.data)
        return found[texture.layer or 0]

    def delete(self, texture):
        """Delete a texture."""
        self.glDeleteTextures(1, ctypes.byref(_uint(texture.name)))
