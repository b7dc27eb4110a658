"""Run-time switches of the viewer, set by keys or by controller buttons."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from clients.headset.runtime import EYES, Eye

try:  # not available on every system
    import termios
    import tty
except ImportError:
    termios = tty = cast("Any", None)

PRESETS = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)
HELP = (
    "keys: both eyes: "
    + ", ".join(f"{n} {name}" for n, name in enumerate(PRESETS, 1))
    + "; l, r: next preset for the left or right eye; f: filter on or off; "
    "s: split view, unfiltered on the left; q: quit"
)


@dataclass
class Controls:
    """Run-time switches of the viewer.

    Attributes
    ----------
    profiles : dict
        Profile of each eye.
    change : callable
        Called with (eye, profile) when an eye changes.
    say : callable
        Called with each message for the user, one line.
    is_on : bool
        Whether the filter is on; otherwise the scene is shown unfiltered.
    is_split : bool
        Whether the left half is shown unfiltered.
    is_over : bool
        Whether the user has ended the program.
    """

    profiles: dict[Eye, Mapping[str, Any]]
    change: Callable[[Eye, Mapping[str, Any]], None]
    say: Callable[[str], None] = lambda line: None
    is_on: bool = True
    is_split: bool = False
    is_over: bool = False
    _numbers: dict[Eye, int] = field(default_factory=lambda: dict.fromkeys(EYES, -1))

    def press(self, keys: str, buttons: Sequence[str] = ()) -> None:
        """Handle pressed keys and controller buttons."""
        for key in keys:
            if key in "123456":
                for eye in EYES:
                    self._set(eye, int(key) - 1)
            elif key in ("l", "r"):
                eye = "left" if key == "l" else "right"
                self._set(eye, (self._numbers[eye] + 1) % len(PRESETS))
            elif key == "f":
                self._switch()
            elif key == "s":
                self.is_split = not self.is_split
                self.say(f"split {'on' if self.is_split else 'off'}")
            elif key == "q":
                self.is_over = True
        for button in buttons:
            if button == "on_off":
                self._switch()
            elif button == "next_eye":
                for eye in EYES:
                    self._set(eye, (self._numbers[eye] + 1) % len(PRESETS))

    def _switch(self) -> None:
        self.is_on = not self.is_on
        self.say(f"filter {'on' if self.is_on else 'off: the scene is unfiltered'}")

    def _set(self, eye: Eye, number: int) -> None:
        self._numbers[eye] = number
        self.profiles[eye] = {"kind": "preset", "name": PRESETS[number]}
        self.change(eye, self.profiles[eye])


class TerminalKeys:
    """Reader of single key presses from the terminal; reads none from other stdin."""

    def __init__(self) -> None:
        self._before: list[Any] | None = None
        self._descriptor: int | None = None

    def __enter__(self) -> TerminalKeys:
        """Switch the terminal to unbuffered input."""
        if termios is not None and sys.stdin is not None and sys.stdin.isatty():
            self._descriptor = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Restore the terminal's settings."""
        if self._before is not None and termios is not None:
            assert self._descriptor is not None
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """Return the keys pressed since the last call, without waiting."""
        if self._descriptor is None:
            return ""
        keys = b""
        while select.select([self._descriptor], [], [], 0.0)[0]:
            got = os.read(self._descriptor, 64)
            if not got:
                break
            keys += got
        return keys.decode("utf-8", "ignore")
