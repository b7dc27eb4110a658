"""Choice of the EGL device: the configured one, or the first that works."""

import ctypes
import ctypes.util
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from filter_service.errors import RenderFailed
from filter_service.gl_device import AUTO, BACKEND_VARIABLE

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


Context = TypeVar("Context")

ADVICE = "run 'ocufilter doctor' to see what is missing"

log = logging.getLogger("ocufilter")


def open_on_device(
    choice: str, open_context: Callable[[int], Context]
) -> tuple[Context, int]:
    """Return a context, and the index of its device.

    Parameters
    ----------
    choice : str
        "auto" for the first device that works, GPUs first; or the index of a device.
    open_context : callable
        ``open_context(index)``; raises if the device has no suitable context.

    Raises
    ------
    RenderFailed
        No device works, or the configured one does not; the message lists the devices.
    """
    devices = egl_devices()
    with _without_backend_variable():
        if choice != AUTO:
            return _open_named(int(choice), devices, open_context)
        return _open_first(devices, open_context)


def _open_named(
    index: int, devices: Sequence[EglDevice], open_context: Callable[[int], Context]
) -> tuple[Context, int]:
    available = ", ".join(map(str, devices)) or "EGL lists none"
    if devices and index >= len(devices):
        raise RenderFailed(
            f"gl_device is {index}; allowed: auto, or an EGL device: {available}"
        )
    try:
        return open_context(index), index
    except Exception as error:
        raise RenderFailed(
            f"gl_device {index} has no OpenGL 4.3 context through EGL "
            f"({_one_line(error)}); devices: {available}; {ADVICE}"
        ) from error


def _open_first(
    devices: Sequence[EglDevice], open_context: Callable[[int], Context]
) -> tuple[Context, int]:
    failed: list[str] = []
    last: Exception | None = None
    # Without a list, the first device is tried for the backend's own error message.
    for device in by_preference(devices) or [EglDevice(0, "first")]:
        try:
            context = open_context(device.index)
        except Exception as error:
            failed.append(f"device {device}: {_one_line(error)}")
            last = error
            continue
        for text in failed:
            log.warning("no OpenGL 4.3 context on EGL %s", text)
        if failed:
            log.warning("using EGL device %s instead", device)
        return context, device.index
    raise RenderFailed(
        f"no OpenGL 4.3 context through EGL ({'; '.join(failed)}); {ADVICE}"
    ) from last


def by_preference(devices: Sequence[EglDevice]) -> list[EglDevice]:
    """Return the devices in EGL's order, but GPUs before software renderers."""
    return sorted(devices, key=lambda device: device.is_software)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def _without_backend_variable() -> Iterator[None]:
    """Unset the variable that would override the index; `gl_device` has read it."""
    saved = os.environ.pop(BACKEND_VARIABLE, None)
    try:
        yield
    finally:
        if saved is not None:
            os.environ[BACKEND_VARIABLE] = saved
