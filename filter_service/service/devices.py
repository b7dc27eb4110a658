"""The devices that filter, as the settings name them: a process for each.

``native`` and ``native:2`` are the compiled loops, with a share of all threads or with
so many; ``gl`` and ``gl:1`` are OpenGL on the first EGL device that works, or on that
one; ``auto`` is what one process alone would take.
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
    """What one process filters with.

    Attributes
    ----------
    engine, gl_device : str
        As the settings of these names.
    threads : int, optional
        None: a share of all.
    """

    engine: str
    gl_device: str = "auto"
    threads: int | None = None


def device_named(text: str) -> Device:
    """Return what a name says.

    Raises
    ------
    ValueError
    """
    engine, colon, number = text.partition(":")
    is_number = number.isascii() and number.isdecimal()
    if engine in ENGINES and not colon:
        return Device(engine)
    if engine == "gl" and is_number:
        return Device(engine, gl_device=number)
    if engine == "native" and is_number and 1 <= int(number) <= MAX_THREADS:
        return Device(engine, threads=int(number))
    raise ValueError(f"devices has {text!r}; allowed: {ALLOWED}")


def check_devices(names: tuple[str, ...], *, engine: str, gl_device: str) -> None:
    """Refuse devices that cannot be, and engines told twice.

    Raises
    ------
    ValueError
    """
    if len(names) > MAX_DEVICES:
        raise ValueError(f"devices are {len(names)}; allowed: {ALLOWED}")
    for name in names:
        device_named(name)
    for setting, value in (("engine", engine), ("gl_device", gl_device)):
        if names and value != "auto":
            raise ValueError(
                f"{setting} is {value!r}, and devices name one each; allowed beside "
                "devices: auto"
            )
