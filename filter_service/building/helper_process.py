"""A Python program that runs beside this one, if that takes long, and ends with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Self


class HelperProcess:
    """Starts ``python -m`` with arguments a while after it is entered.

    Parameters
    ----------
    after_s : float
        Left sooner, it starts nothing.
    """

    def __init__(self, *arguments: str, after_s: float) -> None:
        self._arguments = arguments
        self._process: subprocess.Popen[bytes] | None = None
        self._timer = threading.Timer(after_s, self._start)
        self._timer.daemon = True

    def __enter__(self) -> Self:
        """Begin to wait."""
        self._timer.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        """End it, done or not."""
        self._timer.cancel()
        self._timer.join()
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def _start(self) -> None:
        self._process = start_module(*self._arguments)


def start_module(*arguments: str) -> subprocess.Popen[bytes]:
    """Start ``python -m`` with what this process imports from.

    Its standard input ends with this process; see `end_with_parent`.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", *arguments],
        stdin=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(import_path())},
    )


def import_path() -> list[str]:
    """Return where this process imports from; what is no text it skips, too."""
    return [entry or os.getcwd() for entry in sys.path if isinstance(entry, str)]


def end(process: subprocess.Popen[bytes], patience_s: float) -> int:
    """Wait for a process that is to end, then end it by force; return its code."""
    try:
        return process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def how_it_ended(exit_code: int) -> str:
    """Return what a process's exit code says, in words."""
    if exit_code >= 0:
        return f"ended with code {exit_code}"
    try:
        return f"was killed by {signal.Signals(-exit_code).name}"
    except ValueError:
        return f"was killed by signal {-exit_code}"


def is_stopped(pid: int) -> bool:
    """Return whether a signal has stopped a process (Linux; elsewhere never)."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (OSError, IndexError):
        return False
    return state == "T"


def end_with_parent() -> None:
    """End this process when whoever started it by `start_module` is gone."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
