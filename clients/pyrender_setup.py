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
    from OpenGL import EGL

    display = getattr(renderer._platform, "_egl_display", None)
    if display is not None:
        EGL.eglMakeCurrent(
            display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT
        )


def delete_renderer(renderer: "pyrender.OffscreenRenderer") -> None:
    """Free an off-screen renderer; afterwards no context is current."""
    platform = renderer._platform
    platform.make_current()
    renderer._renderer.delete()
    # Before the display ends, not after as pyrender has it: NVIDIA's EGL then no longer
    # knows the display, and Mesa's keeps the context alive.
    release_context(renderer)
    platform.delete_context()
    renderer._renderer = renderer._platform = None
