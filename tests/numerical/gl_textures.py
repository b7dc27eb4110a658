"""Textures of a caller, made and read by OpenGL's own functions."""

import ctypes
from contextlib import contextmanager
from dataclasses import dataclass

import moderngl
import numpy as np

from filter_service.gl.current_context import CurrentContext
from filter_service.rendering.frame import white_level
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.rgbd_view import RgbdView
from filter_service.texture_view import DepthProjection, GlTexture, TextureView

TEXTURE_2D, TEXTURE_2D_ARRAY, RENDERBUFFER = 0x0DE1, 0x8C1A, 0x8D41
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
    "glGenRenderbuffers": (_int, _pointer),
    "glDeleteRenderbuffers": (_int, _pointer),
    "glBindRenderbuffer": (_uint, _uint),
    "glRenderbufferStorageMultisample": (_uint, _int, _uint, _int, _int),
    "glGenFramebuffers": (_int, _pointer),
    "glDeleteFramebuffers": (_int, _pointer),
    "glBindFramebuffer": (_uint, _uint),
    "glFramebufferTexture2D": (_uint, _uint, _uint, _uint, _int),
    "glFramebufferRenderbuffer": (_uint, _uint, _uint, _uint),
    "glBlitFramebuffer": (*(_int,) * 8, _uint, _uint),
}

SETS = (
    # format and layer of color, depth and target
    (("rgba8", None), ("r32f", None), ("srgb8_a8", None)),
    (("srgb8_a8", 0), ("d32f", None), ("rgba16f", 2)),
    (("rgba16f", None), ("d24", 2), ("rgba8", None)),
    (("rgba8", 1), ("d32f", 1), ("rgba8", 0)),
)
"""Textures of views: all formats, and layers of arrays or not in all combinations."""

NEAR_M = 0.05
MOST_D24 = 2**24 - 1


@contextmanager
def callers_context():
    """A context of a caller, current within."""
    context = moderngl.create_context(standalone=True, backend="egl", require=430)
    with context:
        yield context
    context.release()


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

    def renderbuffer(self, texture, size_px, *, sample_count=0):
        """Return a renderbuffer with the contents of a texture."""
        name = _uint()
        self.glGenRenderbuffers(1, ctypes.byref(name))
        self.glBindRenderbuffer(RENDERBUFFER, name.value)
        self.glRenderbufferStorageMultisample(
            RENDERBUFFER, sample_count, FORMATS[texture.format][0], *size_px
        )
        found = GlTexture(name.value, texture.format, is_renderbuffer=True)
        self._blit(texture, found, size_px)
        return found

    def texture_of(self, renderbuffer, size_px):
        """Return a texture with the contents of a renderbuffer."""
        found = self.new(renderbuffer.format, size_px)
        self._blit(renderbuffer, found, size_px)
        return found

    def _blit(self, source, target, size_px):
        is_depth = source.format in ("d32f", "d24")
        attachment, mask = (0x8D00, 0x100) if is_depth else (0x8CE0, 0x4000)
        names = (_uint * 2)()
        self.glGenFramebuffers(2, names)
        for where, name, image in zip(
            (0x8CA8, 0x8CA9), names, (source, target), strict=True
        ):
            self.glBindFramebuffer(where, name)
            if image.is_renderbuffer:
                self.glFramebufferRenderbuffer(
                    where, attachment, RENDERBUFFER, image.name
                )
            else:
                self.glFramebufferTexture2D(
                    where, attachment, TEXTURE_2D, image.name, 0
                )
        self.glBlitFramebuffer(0, 0, *size_px, 0, 0, *size_px, mask, 0x2600)
        self.glDeleteFramebuffers(2, names)

    def delete(self, texture):
        """Delete a texture or a renderbuffer."""
        delete = (
            self.glDeleteRenderbuffers
            if texture.is_renderbuffer
            else self.glDeleteTextures
        )
        delete(1, ctypes.byref(_uint(texture.name)))


def arrays_of(view, formats):
    """The view with 8-bit color, as textures of one of `SETS` hold it."""
    (color, _), (depth, _), _ = formats
    rgb, depth_m = view.color, view.depth_m
    if color == "rgba16f":
        rgb = linear_from_srgb(rgb).astype(np.float16)
    if depth == "d24":
        with np.errstate(divide="ignore"):
            depth_m = (NEAR_M * MOST_D24 / d24_of(depth_m)).astype(np.float32)
    return RgbdView(rgb, depth_m, view.tangents)


def d24_of(depth_m):
    """Integers of a reversed depth buffer."""
    return np.round(NEAR_M / depth_m.astype(float) * MOST_D24)


class ViewTextures:
    """A view in new textures, and a texture for its filtered image.

    Parameters
    ----------
    view : RgbdView
        With 8-bit color.
    formats : tuple
        One of `SETS`.
    """

    def __init__(self, view, formats):
        self._textures = textures = Textures()
        color, depth, target = formats
        self._size_px = size_px = view.width_px, view.height_px
        rgb = arrays_of(view, formats).color
        stored, projection = view.depth_m, None
        if depth[0] != "r32f":
            projection = DepthProjection(NEAR_M, is_reversed=True)
            stored = NEAR_M / stored
        if depth[0] == "d24":
            share = d24_of(view.depth_m) / MOST_D24
            stored = np.round(share * (2**32 - 1)).astype(np.uint32)
        rgba = np.dstack([rgb, np.ones(stored.shape, rgb.dtype)])
        self.view = TextureView(
            textures.new(color[0], size_px, rgba, layer=color[1]),
            textures.new(depth[0], size_px, stored, layer=depth[1]),
            *size_px,
            view.tangents,
            projection,
            is_top_first=True,
            white_ratio=white_level(rgb),
        )
        self.target = textures.new(target[0], size_px, layer=target[1])

    def image(self):
        """Return the filtered image (height, width, 3)."""
        return self._textures.read(self.target, self._size_px)[..., :3]

    def delete(self):
        """Delete the textures."""
        for texture in (self.view.color, self.view.depth, self.target):
            self._textures.delete(texture)
