"""Read single keys from a terminal without blocking."""

from __future__ import annotations

import os
import select
import sys
from typing import Any, cast

try:  # not on every system
    import termios
    import tty
except ImportError:
    termios = tty = cast("Any", None)


class TerminalKeys:
    """Keys pressed while this is open; none if stdin is not a terminal."""

    def __init__(self) -> None:
        self._before: list[Any] | None = None
        self._descriptor: int | None = None

    def __enter__(self) -> TerminalKeys:
        """Switch the terminal to single keys."""
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
        """Return the keys pressed since the last call."""
        if self._descriptor is None:
            return ""
        keys = b""
        while select.select([self._descriptor], [], [], 0.0)[0]:
            got = os.read(self._descriptor, 64)
            if not got:
                break
            keys += got
        return keys.decode("utf-8", "ignore")
