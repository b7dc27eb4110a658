"""What processes of the service have in common: import path, exit and stops."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path


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
