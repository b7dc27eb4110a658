"""OpenGL contexts for OpenXR, and their session bindings.

open_context       EGL context without a window, or GLX context of a hidden window
current_platform   platform of the current context: required extensions and binding

OpenGL functions are loaded here, because importing pyopenxr makes PyOpenGL use GLX.
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from ctypes import POINTER, byref, c_int, c_uint, c_ulong, c_void_p
from typing import Any, cast

import moderngl
import xr

from clients.headset.runtime import NoRuntime, ShownView
from clients.headset.scenery import NEAR_M, Presenter
from filter_service.messages import Pose

GRAPHICS_VARIABLE = "OCUFILTER_HEADSET_GRAPHICS"
OPENGL, EGL_ENABLE = "XR_KHR_opengl_enable", "XR_MNDX_egl_enable"

_VERSION = 430
_EGL_CONFIG_ID, _EGL_NONE = 0x3028, 0x3038
_GLX_VISUAL_ID, _GLX_SCREEN, _GLX_FBCONFIG_ID = 0x800B, 0x800C, 0x8013
_FRAMEBUFFER, _TEXTURE_2D = 0x8D40, 0x0DE1
_COLOR, _DEPTH = 0x8CE0, 0x8D00  # GL_COLOR_ATTACHMENT0, GL_DEPTH_ATTACHMENT


def offered_extensions() -> set[str]:
    """Return the runtime's extensions; raise `xr.XrException` without a runtime."""
    return {
        properties.extension_name.decode()
        for properties in xr.enumerate_instance_extension_properties()
    }


@contextmanager
def open_context() -> Iterator[moderngl.Context]:
    """Open a context that the runtime supports; on entry, no context is current.

    The context comes from EGL, without a window or display, if the runtime supports
    that or if there is no runtime yet. Otherwise it comes from GLX, with a hidden
    window under X. The environment variable ``OCUFILTER_HEADSET_GRAPHICS`` overrides
    the choice with ``egl`` or ``glx``.

    Raises
    ------
    NoRuntime
        If the runtime requires an X display with OpenGL 4.3 and there is none.
    ValueError
        If the variable has another value.
    """
    opened = _egl_context() if _wanted() == "egl" else _glx_context()
    with opened as context:
        # A new EGL context is current. A thread with a current EGL context cannot have
        # a current GLX context, or the reverse, and the filter uses EGL.
        with context:
            pass
        yield context


def _wanted() -> str:
    wanted = os.environ.get(GRAPHICS_VARIABLE, "")
    if wanted not in ("", "egl", "glx"):
        raise ValueError(f"{GRAPHICS_VARIABLE} is {wanted!r}; allowed: egl, glx")
    if not wanted:
        wanted = "egl"  # also if there is no runtime yet
        with suppress(xr.XrException):
            wanted = "egl" if EGL_ENABLE in offered_extensions() else "glx"
    return wanted


@contextmanager
def _egl_context() -> Iterator[moderngl.Context]:
    context = moderngl.create_context(
        standalone=True, backend=cast("Any", "egl"), require=_VERSION
    )
    try:
        yield context
    finally:
        context.release()


@contextmanager
def _glx_context() -> Iterator[moderngl.Context]:
    if not os.environ.get("DISPLAY"):
        raise _no_display("DISPLAY is not set")
    # Under Wayland, glfw would load a library without GLX.
    os.environ.setdefault("PYGLFW_LIBRARY_VARIANT", "x11")
    try:
        import glfw
    except ImportError as error:
        raise NoRuntime(
            f"this OpenXR runtime requires the package glfw: {error}"
        ) from None
    errors: list[str] = []
    glfw.set_error_callback(
        lambda code, text: errors.append(cast("bytes", text).decode())
    )
    try:
        window = _hidden_window(glfw)
        if not window:  # a null pointer, which is not None
            raise _no_display("; ".join(errors))
        glfw.make_context_current(window)
        # Explicit libraries make moderngl create a separate context, not its default.
        context = moderngl.create_context(
            require=_VERSION,
            libgl=cast("Any", "libGL.so.1"),
            libx11=cast("Any", "libX11.so.6"),
        )
        glfw.make_context_current(cast("Any", None))
        try:
            yield context
        finally:
            context.release()
    finally:
        glfw.terminate()


def _hidden_window(glfw: Any) -> Any:
    """Create a hidden window; return None if that fails."""
    glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_X11)
    if not glfw.init():
        return None
    for hint, value in (
        (glfw.VISIBLE, glfw.FALSE),
        (glfw.CONTEXT_CREATION_API, glfw.NATIVE_CONTEXT_API),
        (glfw.CONTEXT_VERSION_MAJOR, _VERSION // 100),
        (glfw.CONTEXT_VERSION_MINOR, _VERSION // 10 % 10),
        (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
    ):
        glfw.window_hint(hint, value)
    return glfw.create_window(16, 16, "ocufilter headset", None, None)


def _no_display(why: str) -> NoRuntime:
    return NoRuntime(
        f"this OpenXR runtime requires an X display with OpenGL 4.3: {why}"
    )


class Egl:
    """EGL, which provides contexts without a window.

    Attributes
    ----------
    name : str
        Name of the platform.
    extensions : tuple of str
        OpenXR extensions that a session with such a context requires.
    """

    name = "EGL"
    extensions = (OPENGL, EGL_ENABLE)

    def __init__(self) -> None:
        egl = self._egl = ctypes.CDLL("libEGL.so.1")
        egl.eglGetCurrentDisplay.restype = egl.eglGetCurrentContext.restype = c_void_p
        egl.eglGetProcAddress.restype = c_void_p
        egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
        egl.eglQueryContext.argtypes = [c_void_p, c_void_p, c_int, POINTER(c_int)]
        egl.eglChooseConfig.argtypes = [
            *(c_void_p, POINTER(c_int), POINTER(c_void_p), c_int, POINTER(c_int)),
        ]

    def is_current(self) -> bool:
        """Return whether the current context is an EGL context."""
        return bool(self._egl.eglGetCurrentContext())

    def load(self, name: str) -> int:
        """Return the address of an OpenGL function."""
        return self._egl.eglGetProcAddress(name.encode())

    def binding(self) -> xr.GraphicsBindingEGLMNDX:
        """Return the session's graphics binding for the current context."""
        egl = self._egl
        display, context = egl.eglGetCurrentDisplay(), egl.eglGetCurrentContext()
        config_id, config, n_found = c_int(), c_void_p(), c_int()
        egl.eglQueryContext(display, context, _EGL_CONFIG_ID, byref(config_id))
        wanted = (c_int * 3)(_EGL_CONFIG_ID, config_id.value, _EGL_NONE)
        egl.eglChooseConfig(display, wanted, byref(config), 1, byref(n_found))
        return _filled(
            xr.GraphicsBindingEGLMNDX,
            get_proc_address=egl.eglGetProcAddress,
            display=display,
            config=config,
            context=context,
        )


class Glx:
    """GLX, which provides contexts of windows under X; see `Egl`."""

    name = "GLX"
    extensions = (OPENGL,)

    def __init__(self) -> None:
        glx, self._x11 = ctypes.CDLL("libGL.so.1"), ctypes.CDLL("libX11.so.6")
        self._glx = glx
        glx.glXGetCurrentDisplay.restype = glx.glXGetCurrentContext.restype = c_void_p
        glx.glXGetCurrentDrawable.restype = c_ulong
        glx.glXGetProcAddressARB.restype = c_void_p
        glx.glXGetProcAddressARB.argtypes = [ctypes.c_char_p]
        asking: list[Any] = [c_void_p, c_void_p, c_int, POINTER(c_int)]
        glx.glXQueryContext.argtypes = glx.glXGetFBConfigAttrib.argtypes = asking
        glx.glXChooseFBConfig.argtypes = [
            *(c_void_p, c_int, POINTER(c_int), POINTER(c_int))
        ]
        glx.glXChooseFBConfig.restype = POINTER(c_void_p)
        self._x11.XFree.argtypes = [c_void_p]

    def is_current(self) -> bool:
        """Return whether the current context is a GLX context."""
        return bool(self._glx.glXGetCurrentContext())

    def load(self, name: str) -> int:
        """Return the address of an OpenGL function."""
        return self._glx.glXGetProcAddressARB(name.encode())

    def binding(self) -> xr.GraphicsBindingOpenGLXlibKHR:
        """Return the session's graphics binding for the current context."""
        glx = self._glx
        display, context = glx.glXGetCurrentDisplay(), glx.glXGetCurrentContext()
        config = self._config(display, context)
        visual_id = c_int()
        glx.glXGetFBConfigAttrib(display, config, _GLX_VISUAL_ID, byref(visual_id))
        return _filled(
            xr.GraphicsBindingOpenGLXlibKHR,
            x_display=display,
            visualid=visual_id.value,
            glx_fbconfig=config,
            glx_drawable=glx.glXGetCurrentDrawable(),
            glx_context=context,
        )

    def _config(self, display: int, context: int) -> int | None:
        glx = self._glx
        config_id, screen, n_found = c_int(), c_int(), c_int()
        glx.glXQueryContext(display, context, _GLX_FBCONFIG_ID, byref(config_id))
        glx.glXQueryContext(display, context, _GLX_SCREEN, byref(screen))
        wanted = (c_int * 3)(_GLX_FBCONFIG_ID, config_id.value, 0)
        found = glx.glXChooseFBConfig(display, screen, wanted, byref(n_found))
        config = found[0] if n_found.value else None
        self._x11.XFree(found)
        return config


def current_platform() -> Egl | Glx:
    """Return the platform of the current context."""
    egl = Egl()
    return egl if egl.is_current() else Glx()


def _filled(structure: Any, **fields: Any) -> Any:
    """Create a structure; cast pointers to the PyOpenGL types of its fields."""
    kinds = dict(structure._fields_)
    return structure(
        **{
            name: value
            if issubclass(kinds[name], ctypes._SimpleCData)
            else ctypes.cast(value, kinds[name])
            for name, value in fields.items()
        }
    )


class Framebuffers:
    """Framebuffers of a runtime's images, one for each pair of color and depth.

    Parameters
    ----------
    context : moderngl.Context
        Context to draw in, which must be current.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        load = current_platform().load

        def function(name: str, *types: type[Any]) -> Callable[..., None]:
            return ctypes.CFUNCTYPE(None, *types)(load(name))

        self._make = function("glGenFramebuffers", c_int, POINTER(c_uint))
        self._bind = function("glBindFramebuffer", c_uint, c_uint)
        self._delete = function("glDeleteFramebuffers", c_int, POINTER(c_uint))
        attach_types = (c_uint, c_uint, c_uint, c_uint, c_int)
        self._attach = function("glFramebufferTexture2D", *attach_types)
        self._found: dict[tuple[int, int], moderngl.Framebuffer] = {}

    def of(self, color: int, depth: int) -> moderngl.Framebuffer:
        """Return the framebuffer of a color and a depth texture; depth 0 means none."""
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
        """Free all framebuffers: textures of a later session reuse their names."""
        for framebuffer in self._found.values():
            self._delete(1, byref(c_uint(framebuffer.glo)))
        self._found = {}


# Swapchains and projection layers

_COLOR_FORMATS = (0x8C43, 0x8058)  # GL_SRGB8_ALPHA8, GL_RGBA8
_DEPTH_FORMATS = (0x8CAC, 0x81A5)  # GL_DEPTH_COMPONENT32F, GL_DEPTH_COMPONENT16
_WAIT_NS = 2_000_000_000


class _Swapchain:
    """A swapchain and the names of its textures."""

    def __init__(
        self,
        session: xr.Session,
        image_format: int,
        usage: xr.SwapchainUsageFlags,
        size_px: tuple[int, int],
    ):
        width, height = size_px
        self.handle = xr.create_swapchain(
            session,
            xr.SwapchainCreateInfo(
                usage_flags=usage | xr.SwapchainUsageFlags.SAMPLED_BIT,
                format=image_format,
                sample_count=1,
                width=width,
                height=height,
                face_count=1,
                array_size=1,
                mip_count=1,
            ),
        )
        images = xr.enumerate_swapchain_images(self.handle, xr.SwapchainImageOpenGLKHR)
        self._textures = [image.image for image in images]
        rect = xr.Rect2Di(xr.Offset2Di(0, 0), xr.Extent2Di(width, height))
        self.part = xr.SwapchainSubImage(self.handle, rect, 0)

    def acquire(self) -> int:
        """Acquire and return the texture to draw into."""
        index = xr.acquire_swapchain_image(self.handle, xr.SwapchainImageAcquireInfo())
        xr.wait_swapchain_image(
            self.handle, xr.SwapchainImageWaitInfo(timeout=_WAIT_NS)
        )
        return self._textures[index]

    def release(self) -> None:
        """Return the texture to the runtime."""
        xr.release_swapchain_image(self.handle, xr.SwapchainImageReleaseInfo())


class StereoImages:
    """Swapchains of both eyes, and the projection layers that show them.

    Parameters
    ----------
    session : xr.Session
        Session that owns the swapchains.
    context : moderngl.Context
        Context to draw in, which must be current for every call.
    size_px : (int, int)
        Width and height of an image.
    with_depth : bool
        Whether to submit depth, which the runtime must support.
    """

    def __init__(
        self,
        session: xr.Session,
        context: moderngl.Context,
        size_px: tuple[int, int],
        *,
        with_depth: bool,
    ) -> None:
        offered = list(xr.enumerate_swapchain_formats(session))
        usage = xr.SwapchainUsageFlags
        self._color, self._depth = (
            [
                _Swapchain(session, kind, bit, size_px)
                for kind in [k for k in formats if k in offered][:1]
                for _ in range(2)
            ]
            for formats, bit in (
                (_COLOR_FORMATS, usage.COLOR_ATTACHMENT_BIT),
                (
                    _DEPTH_FORMATS if with_depth else (),
                    usage.DEPTH_STENCIL_ATTACHMENT_BIT,
                ),
            )
        )
        if not self._color:
            raise RuntimeError(
                f"the runtime offers the color formats {offered}; expected one of "
                f"{_COLOR_FORMATS}"
            )
        self.has_depth = bool(self._depth)
        self._framebuffers = Framebuffers(context)
        self._presenter = Presenter(context, size_px)

    def release(self) -> None:
        """Free the OpenGL objects and the swapchains."""
        self._framebuffers.release()
        self._presenter.release()
        for swapchain in (*self._color, *self._depth):
            xr.destroy_swapchain(swapchain.handle)

    def layer(
        self, space: xr.Space, shown: Sequence[ShownView]
    ) -> tuple[xr.CompositionLayerProjection, list[xr.CompositionLayerDepthInfoKHR]]:
        """Draw a frame; return its projection layer, and structures it points to."""
        kept, views = [], []
        for i, view in enumerate(shown):
            used = [self._color[i], *self._depth[i : i + 1]]
            textures = [swapchain.acquire() for swapchain in used]
            depth = textures[1] if len(textures) > 1 else 0
            try:
                # The runtime waits for what was submitted before the release.
                self._presenter.draw(view, self._framebuffers.of(textures[0], depth))
            finally:
                for swapchain in used:
                    swapchain.release()
            more = None
            if self._depth:
                info = xr.CompositionLayerDepthInfoKHR(
                    sub_image=self._depth[i].part,
                    min_depth=0.0,
                    max_depth=1.0,
                    near_z=NEAR_M,
                    far_z=math.inf,
                )
                kept.append(info)
                more = ctypes.cast(ctypes.pointer(info), ctypes.c_void_p)
            views.append(
                xr.CompositionLayerProjectionView(
                    pose=posef(view.view.pose),
                    fov=fov(view.view.tangents),
                    sub_image=self._color[i].part,
                    next=more,
                )
            )
        return xr.CompositionLayerProjection(space=space, views=views), kept


def posef(pose: Pose) -> xr.Posef:
    """Return a pose as an OpenXR structure."""
    x, y, z, *quaternion = pose
    return xr.Posef(xr.Quaternionf(*quaternion), xr.Vector3f(x, y, z))


def pose_of(posef: xr.Posef) -> Pose:
    """Return an OpenXR pose as seven numbers."""
    p, q = posef.position, posef.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def fov(tangents: tuple[float, float, float, float]) -> xr.Fovf:
    """Convert the tangents of the image edges to OpenXR's angles."""
    return xr.Fovf(*(math.atan(tangent) for tangent in tangents))


def tangents_of(fov: xr.Fovf) -> tuple[float, float, float, float]:
    """Convert OpenXR's angles to the tangents left, right, up and down."""
    return (
        math.tan(fov.angle_left),
        math.tan(fov.angle_right),
        math.tan(fov.angle_up),
        math.tan(fov.angle_down),
    )
