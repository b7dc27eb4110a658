"""OpenGL functions that moderngl does not offer, called by ctypes."""

import ctypes
import ctypes.util
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

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
