"""The OpenGL context of the caller, which is current on the calling thread."""

import ctypes
import ctypes.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import moderngl

from filter_service import constants
from filter_service.errors import RenderFailed

_uint, _int, _size = ctypes.c_uint, ctypes.c_int, ctypes.c_ssize_t
_pointer, _bool = ctypes.c_void_p, ctypes.c_ubyte

_PROTOTYPES: dict[str, tuple[Any, ...]] = {
    # result, then arguments
    "glActiveTexture": (None, _uint),
    "glBeginQuery": (None, _uint, _uint),
    "glBindBuffer": (None, _uint, _uint),
    "glBindBufferRange": (None, _uint, _uint, _uint, _size, _size),
    "glBindBufferBase": (None, _uint, _uint, _uint),
    "glBindBuffersBase": (None, _uint, _uint, _int, _pointer),
    "glBindFramebuffer": (None, _uint, _uint),
    "glBindImageTexture": (None, _uint, _uint, _int, _bool, _int, _uint, _uint),
    "glBindRenderbuffer": (None, _uint, _uint),
    "glBindSampler": (None, _uint, _uint),
    "glBindTexture": (None, _uint, _uint),
    "glBindVertexArray": (None, _uint),
    "glBlitFramebuffer": (None, *(_int,) * 8, _uint, _uint),
    "glBufferStorage": (None, _uint, _size, _pointer, _uint),
    "glCheckFramebufferStatus": (_uint, _uint),
    "glClientWaitSync": (_uint, _pointer, _uint, ctypes.c_uint64),
    "glColorMaski": (None, _uint, _bool, _bool, _bool, _bool),
    "glCopyBufferSubData": (None, _uint, _uint, _size, _size, _size),
    "glDeleteBuffers": (None, _int, _pointer),
    "glDeleteFramebuffers": (None, _int, _pointer),
    "glDeleteQueries": (None, _int, _pointer),
    "glDeleteSamplers": (None, _int, _pointer),
    "glDeleteSync": (None, _pointer),
    "glDeleteTextures": (None, _int, _pointer),
    "glDisable": (None, _uint),
    "glDisablei": (None, _uint, _uint),
    "glEnable": (None, _uint),
    "glEnablei": (None, _uint, _uint),
    "glEndQuery": (None, _uint),
    "glFenceSync": (_pointer, _uint, _uint),
    "glFlush": (None,),
    "glFramebufferRenderbuffer": (None, _uint, _uint, _uint, _uint),
    "glFramebufferTexture2D": (None, _uint, _uint, _uint, _uint, _int),
    "glFramebufferTextureLayer": (None, _uint, _uint, _uint, _int, _int),
    "glGenBuffers": (None, _int, _pointer),
    "glGenFramebuffers": (None, _int, _pointer),
    "glGenQueries": (None, _int, _pointer),
    "glGenSamplers": (None, _int, _pointer),
    "glGenTextures": (None, _int, _pointer),
    "glGetBooleani_v": (None, _uint, _uint, _pointer),
    "glGetError": (_uint,),
    "glGetFloati_v": (None, _uint, _uint, _pointer),
    "glGetInteger64i_v": (None, _uint, _uint, _pointer),
    "glGetIntegeri_v": (None, _uint, _uint, _pointer),
    "glGetIntegerv": (None, _uint, _pointer),
    "glGetQueryObjectui64v": (None, _uint, _uint, _pointer),
    "glGetRenderbufferParameteriv": (None, _uint, _uint, _pointer),
    "glGetTexLevelParameteriv": (None, _uint, _int, _uint, _pointer),
    "glIsEnabled": (_bool, _uint),
    "glIsEnabledi": (_bool, _uint, _uint),
    "glIsRenderbuffer": (_bool, _uint),
    "glIsTexture": (_bool, _uint),
    "glMapBufferRange": (_pointer, _uint, _size, _size, _uint),
    "glPixelStorei": (None, _uint, _int),
    "glPolygonMode": (None, _uint, _uint),
    "glSamplerParameteri": (None, _uint, _uint, _int),
    "glTexStorage2D": (None, _uint, _int, _uint, _int, _int),
    "glUseProgram": (None, _uint),
    "glViewportIndexedf": (None, _uint, *(ctypes.c_float,) * 4),
}

AddressOf = Callable[[str], int | None]


def egl_address_of(name: str) -> int | None:
    """Return the address of an OpenGL function by EGL, or None."""
    library = ctypes.util.find_library("EGL") or "libEGL.so.1"
    try:
        address_of = ctypes.CDLL(library).eglGetProcAddress
    except (OSError, AttributeError):
        return None
    address_of.restype, address_of.argtypes = _pointer, [ctypes.c_char_p]
    found: int | None = address_of(name.encode())
    return found


_MEMORY_PROTOTYPES: dict[str, tuple[Any, ...]] = {
    # GL_EXT_memory_object and GL_EXT_memory_object_fd
    "glBindTexture": (None, _uint, _uint),
    "glCreateMemoryObjectsEXT": (None, _int, _pointer),
    "glDeleteMemoryObjectsEXT": (None, _int, _pointer),
    "glDeleteTextures": (None, _int, _pointer),
    "glGenTextures": (None, _int, _pointer),
    "glGetError": (_uint,),
    "glGetIntegerv": (None, _uint, _pointer),
    "glGetTexLevelParameteriv": (None, _uint, _int, _uint, _pointer),
    "glGetUnsignedBytei_vEXT": (None, _uint, _uint, _pointer),
    "glGetUnsignedBytevEXT": (None, _uint, _pointer),
    "glImportMemoryFdEXT": (None, _uint, ctypes.c_uint64, _uint, _int),
    "glMemoryObjectParameterivEXT": (None, _uint, _uint, _pointer),
    "glTexStorageMem2DEXT": (
        *(None, _uint, _int, _uint, _int, _int, _uint),
        ctypes.c_uint64,
    ),
}


def gl_functions(address_of: AddressOf = egl_address_of) -> SimpleNamespace | None:
    """Return the functions by name, or None if one of them is missing."""
    return _loaded(_PROTOTYPES, address_of)


def memory_functions(address_of: AddressOf = egl_address_of) -> SimpleNamespace | None:
    """Return the functions that import memory, or None if one of them is missing."""
    return _loaded(_MEMORY_PROTOTYPES, address_of)


def _loaded(
    prototypes: dict[str, tuple[Any, ...]], address_of: AddressOf
) -> SimpleNamespace | None:
    found = {}
    for name, (result, *arguments) in prototypes.items():
        address = address_of(name)
        if not address:
            return None
        found[name] = ctypes.CFUNCTYPE(result, *arguments)(address)
    return SimpleNamespace(**found)


EGL_DRAW, EGL_READ = 0x3059, 0x305A


class CurrentContext:
    """The context that is current when this object is created, for moderngl.

    Attributes
    ----------
    platform : "EGL" or "GLX"
    handle : int
        Address of the context.

    Raises
    ------
    RenderFailed
        If no context is current.
    """

    def __init__(self) -> None:
        for platform, library, prefix in (
            ("EGL", "libEGL.so.1", "egl"),
            ("GLX", "libGL.so.1", "glX"),
        ):
            try:
                loaded = ctypes.CDLL(library)
                self._current = getattr(loaded, f"{prefix}GetCurrentContext")
                self._address_of = getattr(loaded, f"{prefix}GetProcAddress")
            except (OSError, AttributeError):
                continue
            self._current.restype = self._address_of.restype = _pointer
            self._address_of.argtypes = [ctypes.c_char_p]
            self.platform, self.handle = platform, int(self._current() or 0)
            if self.handle:
                return
        raise RenderFailed("no OpenGL context is current on this thread")

    def load_opengl_function(self, name: str) -> int:
        """Return the address of an OpenGL function, or 0."""
        return int(self._address_of(name.encode()) or 0)

    @property
    def is_current(self) -> bool:
        """Return whether the context is current on the calling thread."""
        return int(self._current() or 0) == self.handle

    def __enter__(self) -> "CurrentContext":
        """Check that the context is current; it stays so.

        Raises
        ------
        RenderFailed
        """
        if not self.is_current:
            raise RenderFailed(
                "the OpenGL context of this filter is not current on this thread"
            )
        return self

    def __exit__(self, *raised: object) -> None:
        """Do nothing."""

    def release(self) -> None:
        """Do nothing: the context belongs to the caller."""


class EglCurrent:
    """Remembers which EGL context is current, and makes it current again.

    glcontext leaves no context current when it leaves one.
    """

    def __init__(self) -> None:
        try:
            egl = ctypes.CDLL("libEGL.so.1")
            self._display = egl.eglGetCurrentDisplay
            self._surface, self._context = (
                egl.eglGetCurrentSurface,
                egl.eglGetCurrentContext,
            )
            self._make_current = egl.eglMakeCurrent
        except (OSError, AttributeError):
            self._is_loaded = False
            return
        self._is_loaded = True
        for function in (self._display, self._surface, self._context):
            function.restype = _pointer
        self._make_current.argtypes = [_pointer] * 4

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Make the context that is current now current again on exit."""
        context = self._context() if self._is_loaded else None
        if not context:
            yield
            return
        draw, read = self._surface(EGL_DRAW), self._surface(EGL_READ)
        display = self._display()
        try:
            yield
        finally:
            self._make_current(display, draw, read, context)


def current_moderngl_context(loader: CurrentContext) -> moderngl.Context:
    """Return moderngl's objects for the caller's context.

    Raises
    ------
    RenderFailed
        If the context has an older version than OpenGL 4.3.
    """
    store: Any = getattr(moderngl, "_store", None)
    default = getattr(store, "default_context", None)
    settings: dict[str, Any] = {"context": loader}
    try:
        return moderngl.create_context(require=430, **settings)
    except Exception as error:  # moderngl raises no narrower type
        raise RenderFailed(
            f"the current {loader.platform} context is not of OpenGL 4.3: {error}"
        ) from error
    finally:
        if store is not None:
            store.default_context = default  # of the caller, who may use moderngl


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
"""Generic bindings that affect pixel transfers."""

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
    """Saves the OpenGL state that the passes change, and restores it.

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
        """Save the state and set the one that the passes need; on exit, restore it."""
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
        """Set the state that moderngl expects for transfers; on exit, restore it."""
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
