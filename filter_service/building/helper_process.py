"""Python subprocesses that end with their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Self


class HelperProcess:
    """Context manager that runs ``python -m`` while its body takes long.

    Parameters
    ----------
    *arguments : str
        Module and its arguments.
    after_s : float
        Delay after which the process starts, unless the body has finished.
    """

    def __init__(self, *arguments: str, after_s: float) -> None:
        self._arguments = arguments
        self._process: subprocess.Popen[bytes] | None = None
        self._timer = threading.Timer(after_s, self._start)
        self._timer.daemon = True

    def __enter__(self) -> Self:
        """Start the timer of the process."""
        self._timer.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Kill the process, if it was started."""
        self._timer.cancel()
        self._timer.join()
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def _start(self) -> None:
        self._process = start_module(*self._arguments)


def start_module(*arguments: str) -> subprocess.Popen[bytes]:
    """Start ``python -m`` with the import path of this process.

    Its standard input closes when this process ends; see `end_with_parent`.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", *arguments],
        stdin=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(import_path())},
    )


def import_path() -> list[str]:
    """Return the import path of this process, for PYTHONPATH."""
    return [entry or os.getcwd() for entry in sys.path if isinstance(entry, str)]


def wait_or_kill(process: subprocess.Popen[bytes], timeout_s: float) -> int:
    """Wait for a process to end, and kill it after a timeout; return its exit code."""
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def describe_exit(exit_code: int) -> str:
    """Describe an exit code, as in "exited with code 1"."""
    if exit_code >= 0:
        return f"exited with code {exit_code}"
    try:
        return f"was killed by {signal.Signals(-exit_code).name}"
    except ValueError:
        return f"was killed by signal {-exit_code}"


def is_stopped(pid: int) -> bool:
    """Return whether a process is stopped by a signal (Linux only; otherwise False)."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (OSError, IndexError):
        return False
    return state == "T"


def end_with_parent() -> None:
    """Exit when the parent that ran `start_module` exits."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
