"""Import of pyrender 0.1.45 on current Python versions, without a display.

Import `pyrender` only from here: three settings must precede its import.
"""

import os
import warnings

import numpy as np
import pyglet

# PyOpenGL reads the platform once, at its first import.
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
# pyrender imports its viewer window, for which pyglet otherwise requires a display.
pyglet.options["headless"] = True
# Removed from numpy 2; pyrender's Scene.bounds still reads it.
np.infty = np.inf  # type: ignore[attr-defined]  # noqa: NPY201

with warnings.catch_warnings():
    # Old syntax in third-party files, which we cannot fix here.
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.simplefilter("ignore", SyntaxWarning)
    import pyrender

__all__ = ["delete_renderer", "pyrender", "release_context"]


def release_context(renderer: "pyrender.OffscreenRenderer") -> None:
    """Release the thread's EGL context, so that a GLX window can be used.

    pyrender's own hook for this does nothing, and X11 refuses a GLX context while an
    EGL one is current.  The next rendering makes the EGL context current again.
    """
    from OpenGL import EGL

    display = getattr(renderer._platform, "_egl_display", None)
    if display is not None:
        EGL.eglMakeCurrent(
            display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT
        )


def delete_renderer(renderer: "pyrender.OffscreenRenderer") -> None:
    """Delete an off-screen renderer; afterward no context is current."""
    platform = renderer._platform
    platform.make_current()
    renderer._renderer.delete()
    # Release before the display is terminated, not after as in pyrender: otherwise
    # NVIDIA's EGL no longer knows the display, and Mesa's keeps the context alive.
    release_context(renderer)
    platform.delete_context()
    renderer._renderer = renderer._platform = None
