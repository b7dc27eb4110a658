"""Choice of the EGL device: the configured one, or the first that works."""

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from filter_service.errors import RenderFailed
from filter_service.gl.egl_devices import EglDevice, egl_devices
from filter_service.gl_device import AUTO, BACKEND_VARIABLE

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
