"""Device names in the settings; each device filters in a process of its own.

``native`` and ``native:2`` are the compiled loops, with a share of all threads or with
the given number; ``gl`` and ``gl:1`` are OpenGL on the first EGL device that works, or
on the given one; ``auto`` is the default choice of a single process.
"""

from __future__ import annotations

from dataclasses import dataclass

from estimator.threads import MAX_THREADS
from filter_service.constants import ENGINES
from filter_service.wire.message import MAX_DEVICES

ALLOWED = (
    f"up to {MAX_DEVICES} of auto, native, native:THREADS (1 to {MAX_THREADS}), gl, "
    "gl:INDEX"
)


@dataclass(frozen=True)
class Device:
    """Engine and resources of one render worker.

    Attributes
    ----------
    engine, gl_device : str
        See the settings of the same names.
    threads : int, optional
        Number of threads; None: a share of all threads.
    """

    engine: str
    gl_device: str = "auto"
    threads: int | None = None


def device_named(text: str) -> Device:
    """Parse the name of a device.

    Raises
    ------
    ValueError
        If the name is invalid.
    """
    engine, colon, number = text.partition(":")
    is_number = number.isascii() and number.isdecimal()
    if engine in ENGINES and not colon:
        return Device(engine)
    if engine == "gl" and is_number:
        return Device(engine, gl_device=number)
    if engine == "native" and is_number and 1 <= int(number) <= MAX_THREADS:
        return Device(engine, threads=int(number))
    raise ValueError(f"unknown device {text!r:.100} in devices; allowed: {ALLOWED}")


def check_devices(names: tuple[str, ...], *, engine: str, gl_device: str) -> None:
    """Check the names of devices, and that no other setting selects an engine.

    Raises
    ------
    ValueError
        If there are too many names, one is invalid, or ``engine`` or ``gl_device`` is
        set as well.
    """
    if len(names) > MAX_DEVICES:
        raise ValueError(f"devices has {len(names)} items; allowed: {ALLOWED}")
    for name in names:
        device_named(name)
    for setting, value in (("engine", engine), ("gl_device", gl_device)):
        if names and value != "auto":
            raise ValueError(
                f"{setting} is {value!r:.100}, but devices select their own engines; "
                "allowed with devices: auto"
            )
