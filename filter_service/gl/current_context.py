"""The OpenGL context of the caller, which is current on the calling thread."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import moderngl

from filter_service.errors import RenderFailed

EGL_DRAW, EGL_READ = 0x3059, 0x305A

_pointer = ctypes.c_void_p


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
            store.default_context = default  # that of the caller, who may use moderngl
