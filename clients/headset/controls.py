"""The viewer's run-time switches, set by keys or by controller buttons."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from clients.headset.runtime import EYES, Eye

PRESETS = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)
HELP = (
    "keys: 1 to 6 both eyes: "
    + ", ".join(f"{n} {name}" for n, name in enumerate(PRESETS, 1))
    + "; l, r the next one for the left, the right eye; f filter on, off; "
    "s split, before and after; q ends"
)


@dataclass
class Controls:
    """The viewer's switches.

    Attributes
    ----------
    profiles : of each eye
    change : callable
        ``change(eye, profile)`` is called when an eye changes.
    say : callable
        Called with each message for the user, one line.
    is_on : bool
        False: the scene is shown unfiltered.
    is_split : bool
        Left half unfiltered, right half filtered.
    is_over : bool
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
        self.say(f"filter {'on' if self.is_on else 'off: the scene as it is'}")

    def _set(self, eye: Eye, number: int) -> None:
        self._numbers[eye] = number
        self.profiles[eye] = {"kind": "preset", "name": PRESETS[number]}
        self.change(eye, self.profiles[eye])
