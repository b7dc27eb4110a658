"""OpenGL for OpenXR: an EGL context without a window, and how a session takes it.

pyopenxr makes PyOpenGL use GLX when it is imported, so functions are loaded here.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_int, c_uint, c_void_p

import moderngl
import xr

_CONFIG_ID, _NONE = 0x3028, 0x3038  # EGL_CONFIG_ID, EGL_NONE
_FRAMEBUFFER, _TEXTURE_2D = 0x8D40, 0x0DE1
_COLOR, _DEPTH = 0x8CE0, 0x8D00  # GL_COLOR_ATTACHMENT0, GL_DEPTH_ATTACHMENT


def _egl() -> ctypes.CDLL:
    egl = ctypes.CDLL("libEGL.so.1")
    for name in ("eglGetCurrentDisplay", "eglGetCurrentContext", "eglGetProcAddress"):
        getattr(egl, name).restype = c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    egl.eglQueryContext.argtypes = [c_void_p, c_void_p, c_int, POINTER(c_int)]
    egl.eglChooseConfig.argtypes = [
        *(c_void_p, POINTER(c_int), POINTER(c_void_p), c_int, POINTER(c_int)),
    ]
    return egl


def egl_binding() -> xr.GraphicsBindingEGLMNDX:
    """Return what a session is told of the current EGL context."""
    egl = _egl()
    display, context = egl.eglGetCurrentDisplay(), egl.eglGetCurrentContext()
    config_id, config, n_found = c_int(), c_void_p(), c_int()
    egl.eglQueryContext(display, context, _CONFIG_ID, byref(config_id))
    wanted = (c_int * 3)(_CONFIG_ID, config_id.value, _NONE)
    egl.eglChooseConfig(display, wanted, byref(config), 1, byref(n_found))
    # The fields are pointer types of PyOpenGL, which take no plain address.
    kinds = dict(xr.GraphicsBindingEGLMNDX._fields_)
    return xr.GraphicsBindingEGLMNDX(
        get_proc_address=ctypes.cast(
            egl.eglGetProcAddress, xr.PFN_xrEglGetProcAddressMNDX
        ),
        display=ctypes.cast(display, kinds["display"]),
        config=ctypes.cast(config, kinds["config"]),
        context=ctypes.cast(context, kinds["context"]),
    )


class Framebuffers:
    """Framebuffers over a runtime's images, each pair once.

    Parameters
    ----------
    context : moderngl.Context, current
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        load = _egl().eglGetProcAddress

        def function(name: str, *types):
            return ctypes.CFUNCTYPE(None, *types)(load(name.encode()))

        self._make = function("glGenFramebuffers", c_int, POINTER(c_uint))
        self._bind = function("glBindFramebuffer", c_uint, c_uint)
        self._delete = function("glDeleteFramebuffers", c_int, POINTER(c_uint))
        attach_types = (c_uint, c_uint, c_uint, c_uint, c_int)
        self._attach = function("glFramebufferTexture2D", *attach_types)
        self._found: dict[tuple[int, int], moderngl.Framebuffer] = {}

    def of(self, color: int, depth: int) -> moderngl.Framebuffer:
        """Return the framebuffer of two textures; depth 0 is none."""
        found = self._found.get((color, depth))
        if found is None:
            name = c_uint()
            self._make(1, byref(name))
            self._bind(_FRAMEBUFFER, name.value)
            self._attach(_FRAMEBUFFER, _COLOR, _TEXTURE_2D, color, 0)
            if depth:
                self._attach(_FRAMEBUFFER, _DEPTH, _TEXTURE_2D, depth, 0)
            found = self._context.detect_framebuffer(name.value)
            self._found[color, depth] = found
        return found

    def release(self) -> None:
        """Free all; a later session's textures have the same names."""
        for framebuffer in self._found.values():
            self._delete(1, byref(c_uint(framebuffer.glo)))
        self._found = {}
