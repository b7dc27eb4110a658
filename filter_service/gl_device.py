"""Selection of the EGL device for OpenGL, and recognition of software renderers.

The service passes its setting ``gl_device`` to its processes in an environment
variable, which commands read too.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

GL_DEVICE_VARIABLE = "OCUFILTER_GL_DEVICE"
BACKEND_VARIABLE = "GLCONTEXT_DEVICE_INDEX"
"""Variable of the glcontext package, which opens contexts."""

AUTO = "auto"


def checked_gl_device(wanted: str, name: str = "gl_device") -> str:
    """Return ``auto`` or the index of a device, as text.

    Raises
    ------
    ValueError
        If the value is neither.
    """
    if wanted == AUTO or (wanted.isascii() and wanted.isdecimal()):
        return wanted
    raise ValueError(
        f"{name} is {wanted!r:.100}; allowed: auto, or the index of an EGL device, "
        "0 or more, as `ocufilter doctor` lists them"
    )


def is_device_selected() -> bool:
    """Return whether the environment selects a device, which implies OpenGL."""
    return wanted_gl_device() != AUTO and bool(os.environ.get(GL_DEVICE_VARIABLE))


def wanted_gl_device() -> str:
    """Return the device that the environment selects.

    Raises
    ------
    ValueError
        If the variable is neither ``auto`` nor an index.
    """
    for variable in (GL_DEVICE_VARIABLE, BACKEND_VARIABLE):
        wanted = os.environ.get(variable, "")
        if wanted:
            return checked_gl_device(wanted, variable)
    return AUTO


SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "swr", "software")


def is_software_renderer(name: str) -> bool:
    """Return whether an OpenGL renderer of this name runs on the CPU."""
    return any(word in name.lower() for word in SOFTWARE_RENDERERS)


RENDER_NODES = ("/dev/dri/renderD*", "/dev/nvidia[0-9]*", "/dev/dxg")
"""Device files of GPU drivers on Linux; the last is for the Windows subsystem."""


def may_have_gpu(root: Path = Path("/")) -> bool:
    """Return whether there may be a GPU driver; always True if not on Linux.

    This takes less than a millisecond; opening a context takes 0.2 s.
    """
    if not sys.platform.startswith("linux"):
        return True
    return any(any(root.glob(pattern[1:])) for pattern in RENDER_NODES)
