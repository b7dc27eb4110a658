"""Renderbuffers of the caller: their properties, and copies that passes can sample."""

import ctypes
from types import SimpleNamespace

from filter_service.constants import TEXTURE_COLOR
from filter_service.errors import RenderFailed
from filter_service.texture_view import COLOR_FORMATS, GlTexture

GL_RENDERBUFFER, GL_RENDERBUFFER_BINDING = 0x8D41, 0x8CA7
GL_RENDERBUFFER_WIDTH, GL_RENDERBUFFER_HEIGHT = 0x8D42, 0x8D43
GL_RENDERBUFFER_INTERNAL_FORMAT = 0x8D44
GL_READ_FRAMEBUFFER, GL_DRAW_FRAMEBUFFER = 0x8CA8, 0x8CA9
GL_COLOR_ATTACHMENT0, GL_DEPTH_ATTACHMENT = 0x8CE0, 0x8D00
GL_COLOR_BUFFER_BIT, GL_DEPTH_BUFFER_BIT = 0x4000, 0x0100
GL_FRAMEBUFFER_COMPLETE, GL_NEAREST = 0x8CD5, 0x2600
GL_TEXTURE_2D, GL_TEXTURE0 = 0x0DE1, 0x84C0

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
