"""OpenGL state of the caller, which stays as it is while passes run in its context."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

from filter_service import constants

GL_CURRENT_PROGRAM, GL_ACTIVE_TEXTURE, GL_TEXTURE0 = 0x8B8D, 0x84E0, 0x84C0
GL_TEXTURE_2D, GL_TEXTURE_2D_ARRAY = 0x0DE1, 0x8C1A
GL_SAMPLER_BINDING, GL_VERTEX_ARRAY_BINDING = 0x8919, 0x85B5
GL_SHADER_STORAGE_BUFFER = 0x90D2
GL_SHADER_STORAGE_BUFFER_BINDING = 0x90D3
GL_SHADER_STORAGE_BUFFER_START, GL_SHADER_STORAGE_BUFFER_SIZE = 0x90D4, 0x90D5
GL_READ_FRAMEBUFFER, GL_DRAW_FRAMEBUFFER = 0x8CA8, 0x8CA9
GL_READ_FRAMEBUFFER_BINDING, GL_DRAW_FRAMEBUFFER_BINDING = 0x8CAA, 0x8CA6
GL_VIEWPORT, GL_POLYGON_MODE, GL_FILL = 0x0BA2, 0x0B40, 0x1B02
GL_FRONT_AND_BACK, GL_COLOR_WRITEMASK = 0x0408, 0x0C23
GL_RGBA32UI, GL_READ_WRITE = 0x8D70, 0x88BA
GL_IMAGE_BINDING = {
    "name": 0x8F3A,
    "level": 0x8F3B,
    "layered": 0x8F3C,
    "layer": 0x8F3D,
    "access": 0x8F3E,
    "format": 0x906E,
}

BUFFERS = {
    # target: query of its binding
    0x8892: 0x8894,  # array
    0x8F36: 0x8F36,  # copy read
    0x8F37: 0x8F37,  # copy write
    0x90EE: 0x90EF,  # dispatch indirect
}
"""Generic bindings that moderngl and `Staging` change."""

PIXEL_BUFFERS = {
    0x88EB: 0x88ED,  # pixel pack
    0x88EC: 0x88EF,  # pixel unpack
}
"""Generic bindings that change what transfers of pixels mean."""

SWITCHES = {
    0x0BF2: "logic operation",
    0x0B44: "cull face",
    0x0B71: "depth test",
    0x0BD0: "dither",
    0x8DB9: "framebuffer sRGB",
    0x8C89: "rasterizer discard",
    0x0B90: "stencil test",
    0x809E: "sample alpha to coverage",
    0x8E51: "sample mask",
    **{0x3000 + index: f"clip distance {index}" for index in range(8)},
}
"""Capabilities that must be off."""

FIRST_SWITCHES = {0x0BE2: "blend", 0x0C11: "scissor test"}
"""The same, of the first draw buffer or viewport."""

PIXEL_STORE = {
    # parameter: as moderngl expects it
    0x0CF2: 0,  # unpack row length
    0x0CF3: 0,  # unpack skip rows
    0x0CF4: 0,  # unpack skip pixels
    0x0CF5: 1,  # unpack alignment
    0x806D: 0,  # unpack skip images
    0x806E: 0,  # unpack image height
    0x0CF0: 0,  # unpack swap bytes
    0x0D05: 1,  # pack alignment
    0x0D02: 0,  # pack row length
}

TEXTURE_UNITS = 5
"""Texture units that the passes use, from 0 on."""

STORAGE_BLOCKS = 1 + max(constants.BINDINGS.values())
IMAGE_UNITS = 2

_Ints = ctypes.c_int * 4


class KeptState:
    """Saves what the passes change, and restores it.

    Conditional rendering, transform feedback and queries of elapsed time must not be
    active: they would include the passes.

    Parameters
    ----------
    functions : SimpleNamespace
        From `gl_functions`.
    uses_images : bool
        Whether atlases are textures, which passes bind to texture and image units, as
        on a software renderer.
    """

    def __init__(self, functions: SimpleNamespace, *, uses_images: bool) -> None:
        self._gl = functions
        self._image_units = IMAGE_UNITS if uses_images else 0
        first = 0 if uses_images else constants.TEXTURE_STORE
        self._texture_units = range(first, TEXTURE_UNITS)
        self._ints = _Ints()
        self._long = ctypes.c_int64()

    def _get(self, name: int) -> int:
        self._gl.glGetIntegerv(name, self._ints)
        return self._ints[0]

    def _get_at(self, name: int, index: int) -> int:
        self._gl.glGetIntegeri_v(name, index, self._ints)
        return self._ints[0]

    def _get_long_at(self, name: int, index: int) -> int:
        self._gl.glGetInteger64i_v(name, index, ctypes.byref(self._long))
        return self._long.value

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Save the state and set what the passes need; on exit, restore it."""
        gl, get = self._gl, self._get
        program, vertices = get(GL_CURRENT_PROGRAM), get(GL_VERTEX_ARRAY_BINDING)
        buffers = [(target, get(query)) for target, query in BUFFERS.items()]
        blocks, storage = self._blocks(), get(GL_SHADER_STORAGE_BUFFER_BINDING)
        unit, textures = get(GL_ACTIVE_TEXTURE), self._textures()
        images = [self._image(index) for index in range(self._image_units)]
        drawn, read = get(GL_DRAW_FRAMEBUFFER_BINDING), get(GL_READ_FRAMEBUFFER_BINDING)
        viewport = (ctypes.c_float * 4)()
        gl.glGetFloati_v(GL_VIEWPORT, 0, viewport)
        polygon_mode = get(GL_POLYGON_MODE)
        mask = (ctypes.c_ubyte * 4)()
        gl.glGetBooleani_v(GL_COLOR_WRITEMASK, 0, mask)
        switches = [name for name in SWITCHES if gl.glIsEnabled(name)]
        first = [name for name in FIRST_SWITCHES if gl.glIsEnabledi(name, 0)]
        for name in switches:
            gl.glDisable(name)
        for name in first:
            gl.glDisablei(name, 0)
        for target, buffer in buffers:
            if buffer:
                gl.glBindBuffer(target, 0)
        if polygon_mode != GL_FILL:
            gl.glPolygonMode(GL_FRONT_AND_BACK, GL_FILL)
        gl.glColorMaski(0, 1, 1, 1, 1)
        try:
            yield
        finally:
            gl.glUseProgram(program)
            gl.glBindVertexArray(vertices)
            for target, buffer in buffers:
                gl.glBindBuffer(target, buffer)
            # Most are free, and one call unbinds all.
            gl.glBindBuffersBase(GL_SHADER_STORAGE_BUFFER, 0, STORAGE_BLOCKS, None)
            for index, (buffer, start, size) in enumerate(blocks):
                if not buffer:
                    continue
                if size:
                    gl.glBindBufferRange(
                        GL_SHADER_STORAGE_BUFFER, index, buffer, start, size
                    )
                else:
                    gl.glBindBufferBase(GL_SHADER_STORAGE_BUFFER, index, buffer)
            gl.glBindBuffer(GL_SHADER_STORAGE_BUFFER, storage)
            for index, plain, array, sampler in textures:
                gl.glActiveTexture(GL_TEXTURE0 + index)
                gl.glBindTexture(GL_TEXTURE_2D, plain)
                gl.glBindTexture(GL_TEXTURE_2D_ARRAY, array)
                gl.glBindSampler(index, sampler)
            gl.glActiveTexture(unit)
            for index, image in enumerate(images):
                gl.glBindImageTexture(index, *image)
            gl.glBindFramebuffer(GL_DRAW_FRAMEBUFFER, drawn)
            gl.glBindFramebuffer(GL_READ_FRAMEBUFFER, read)
            gl.glViewportIndexedf(0, *viewport)
            if polygon_mode != GL_FILL:
                gl.glPolygonMode(GL_FRONT_AND_BACK, polygon_mode)
            gl.glColorMaski(0, *mask)
            for name in switches:
                gl.glEnable(name)
            for name in first:
                gl.glEnablei(name, 0)

    @contextmanager
    def for_transfers(self) -> Iterator[None]:
        """Set what moderngl expects for transfers of pixels; on exit, restore it."""
        gl = self._gl
        store = [(name, self._get(name)) for name in PIXEL_STORE]
        buffers = [
            (target, self._get(query)) for target, query in PIXEL_BUFFERS.items()
        ]
        for name, _ in store:
            gl.glPixelStorei(name, PIXEL_STORE[name])
        for target, _ in buffers:
            gl.glBindBuffer(target, 0)
        try:
            yield
        finally:
            for name, value in store:
                gl.glPixelStorei(name, value)
            for target, buffer in buffers:
                gl.glBindBuffer(target, buffer)

    def _blocks(self) -> list[tuple[int, int, int]]:
        found = []
        for index in range(STORAGE_BLOCKS):
            buffer = self._get_at(GL_SHADER_STORAGE_BUFFER_BINDING, index)
            start = size = 0
            if buffer:  # each query takes a microsecond, and few callers have any
                start = self._get_long_at(GL_SHADER_STORAGE_BUFFER_START, index)
                size = self._get_long_at(GL_SHADER_STORAGE_BUFFER_SIZE, index)
            found.append((buffer, start, size))
        return found

    def _textures(self) -> list[tuple[int, int, int, int]]:
        found = []
        for index in self._texture_units:
            self._gl.glActiveTexture(GL_TEXTURE0 + index)
            plain, array = self._get(0x8069), self._get(0x8C1D)
            found.append((index, plain, array, self._get(GL_SAMPLER_BINDING)))
        return found

    def _image(self, index: int) -> tuple[int, ...]:
        found = {
            name: self._get_at(query, index) for name, query in GL_IMAGE_BINDING.items()
        }
        if not found["name"]:  # an unbound unit has no format to restore
            return 0, 0, 0, 0, GL_READ_WRITE, GL_RGBA32UI
        return tuple(found.values())
