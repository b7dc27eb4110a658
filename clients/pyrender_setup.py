"""Import pyrender 0.1.45 on today's Python, without a display.

Import `pyrender` from here and nowhere else: three settings must come before it.
"""

import os
import warnings

import numpy as np
import pyglet

# PyOpenGL reads the platform once, at its first import.
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
# pyrender imports its window viewer; without this pyglet looks for a display.
pyglet.options["headless"] = True
# Removed from numpy 2; pyrender's Scene.bounds still reads it.
np.infty = np.inf  # noqa: NPY201

with warnings.catch_warnings():
    # Old syntax in a third party's files; nothing that we can mend from here.
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.simplefilter("ignore", SyntaxWarning)
    import pyrender

__all__ = ["delete_renderer", "pyrender", "release_context"]


def release_context(renderer: "pyrender.OffscreenRenderer") -> None:
    """Let go of the thread's EGL context, so that a GLX window may take over.

    pyrender's own hook for this does nothing, and X11 refuses a GLX context while an
    EGL one is current.  The next render takes the context back by itself.
    """
    _release(_display(renderer))


def delete_renderer(renderer: "pyrender.OffscreenRenderer") -> None:
    """Free an off-screen renderer; afterwards no context is current."""
    display = _display(renderer)
    renderer.delete()
    # pyrender destroys its context while it is current: it lives on until released.
    _release(display)


def _display(renderer: "pyrender.OffscreenRenderer"):
    return getattr(renderer._platform, "_egl_display", None)


def _release(display) -> None:
    from OpenGL import EGL

    if display is not None:
        EGL.eglMakeCurrent(
            display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT
        )
