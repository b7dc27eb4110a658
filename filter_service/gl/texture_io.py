"""Textures of the caller as input and output of passes, in its own context."""

import ctypes
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import moderngl

from filter_service.constants import TEXTURE_COLOR
from filter_service.errors import BadMessage, RenderFailed
from filter_service.gl.renderbuffers import GL_RENDERBUFFER, Renderbuffers
from filter_service.texture_view import GlTexture, TextureView

GL_TEXTURE_2D, GL_TEXTURE_2D_ARRAY, GL_TEXTURE0 = 0x0DE1, 0x8C1A, 0x84C0
GL_TEXTURE_WIDTH, GL_TEXTURE_HEIGHT, GL_TEXTURE_DEPTH = 0x1000, 0x1001, 0x8071
GL_TEXTURE_INTERNAL_FORMAT = 0x1003
GL_DRAW_FRAMEBUFFER, GL_COLOR_ATTACHMENT0 = 0x8CA9, 0x8CE0
GL_FRAMEBUFFER_COMPLETE = 0x8CD5
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
        # Attached anew each time: a deleted texture's name may now be of another one,
        # and as long as it is attached, draws to a deleted texture succeed.
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
