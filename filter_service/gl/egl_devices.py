"""List of the EGL devices: GPUs and the software renderer."""

import ctypes
import ctypes.util
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

EGL_VENDOR, EGL_EXTENSIONS, EGL_RENDERER_EXT = 0x3053, 0x3055, 0x335F
EGL_DRM_RENDER_NODE_FILE_EXT = 0x3377
SOFTWARE_EXTENSION = "EGL_MESA_device_software"
NAME_EXTENSION = "EGL_EXT_device_query_name"
NODE_EXTENSION = "EGL_EXT_device_drm_render_node"

LIBRARY_VARIABLE = "GLCONTEXT_LINUX_LIBEGL"
"""Environment variable with the path of the EGL library; glcontext reads it, too."""

_pointer, _int = ctypes.c_void_p, ctypes.c_int
_QUERY_DEVICES = ctypes.CFUNCTYPE(
    ctypes.c_uint, _int, _pointer, ctypes.POINTER(ctypes.c_int)
)
_QUERY_STRING = ctypes.CFUNCTYPE(ctypes.c_char_p, _pointer, _int)


@dataclass(frozen=True)
class EglDevice:
    """An EGL device, as far as it can be described before it is opened.

    Attributes
    ----------
    index : int
    name : str
        Name, if EGL provides one.
    extensions : tuple of str
    """

    index: int
    name: str
    extensions: tuple[str, ...] = ()

    @property
    def is_software(self) -> bool:
        """Whether the device renders on the CPU."""
        return SOFTWARE_EXTENSION in self.extensions

    def __str__(self) -> str:
        """Return index and name."""
        return f"{self.index} ({self.name})"


def egl_devices() -> list[EglDevice]:
    """Return the devices in EGL's order; empty if EGL cannot list them."""
    address_of = _address_of()
    of_query = address_of(b"eglQueryDevicesEXT")
    of_text = address_of(b"eglQueryDeviceStringEXT")
    if not of_query or not of_text:
        return []
    query, text_of = _QUERY_DEVICES(of_query), _QUERY_STRING(of_text)
    count = ctypes.c_int(0)
    if not query(0, None, ctypes.byref(count)) or count.value < 1:
        return []
    handles = (_pointer * count.value)()
    if not query(count.value, handles, ctypes.byref(count)):
        return []
    return [
        _described(index, partial(text_of, handle))
        for index, handle in enumerate(handles[: count.value])
    ]


def _address_of() -> Callable[[bytes], int | None]:
    """Return a function that looks up addresses; it returns None without EGL."""
    library = os.environ.get(LIBRARY_VARIABLE) or ctypes.util.find_library("EGL")
    try:
        address_of = ctypes.CDLL(library or "libEGL.so.1").eglGetProcAddress
    except (OSError, AttributeError):
        return lambda name: None
    address_of.restype, address_of.argtypes = _pointer, [ctypes.c_char_p]
    return address_of


def _described(index: int, text_of: Callable[[int], bytes | None]) -> EglDevice:
    """Return a device, with the name that its extensions provide."""

    def text(what: int) -> str:
        return (text_of(what) or b"").decode(errors="replace")

    extensions = tuple(text(EGL_EXTENSIONS).split())
    words = []
    if NAME_EXTENSION in extensions:
        words += [text(EGL_VENDOR), text(EGL_RENDERER_EXT)]
    if SOFTWARE_EXTENSION in extensions:
        words.append("software")
    elif NODE_EXTENSION in extensions:
        words.append(text(EGL_DRM_RENDER_NODE_FILE_EXT))
    if "EGL_NV_device_cuda" in extensions and not any(words):
        words.append("NVIDIA")
    return EglDevice(index, " ".join(filter(None, words)) or "unnamed", extensions)
