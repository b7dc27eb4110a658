"""Runs a step with a limit: one that fails or takes too long ends nothing else."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

DONE, FAILED, TOO_LONG = "done", "failed", "too long"
LEFT_OUT, NOT_BEGUN = "left out", "not begun"

LEAST_S = 10.0
"""With less time left a step is not begun."""

GRACE_S = 2.0
"""From the asking to end until the end."""

TAIL_LINES = 5


@dataclass(frozen=True)
class Outcome:
    """How a step went.

    Attributes
    ----------
    name, what, state : str
    seconds, limit_s : float
    command : tuple of str
    content : dict
        What it printed as JSON, or the rows that it had kept; may be empty.
    tail : tuple of str
        Last lines of its log, or why it did not run.
    """

    name: str
    what: str
    state: str
    seconds: float = 0.0
    limit_s: float = 0.0
    command: tuple[str, ...] = ()
    content: dict = field(default_factory=dict)
    tail: tuple[str, ...] = ()


class Budget:
    """Time that all steps share.

    Parameters
    ----------
    seconds : float
    clock : callable
        Tells seconds.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic):
        self.seconds = seconds
        self._clock = clock
        self._start_s = clock()

    @property
    def spent_s(self) -> float:
        """Time since the start."""
        return self._clock() - self._start_s

    def limit_s(self, wanted_s: float) -> float:
        """What a step gets of the time that it wants; 0 where too little is left."""
        left_s = self.seconds - self.spent_s
        return 0.0 if left_s < min(LEAST_S, wanted_s) else min(wanted_s, left_s)


def run_program(
    command: list[str],
    *,
    name: str,
    limit_s: float,
    logs: Path,
    cwd: Path,
    environment: Mapping[str, str],
) -> tuple[str, float]:
    """Run a program to its end or its limit; its state, and the seconds it took.

    What it prints goes to NAME.out and NAME.log in ``logs``.  Processes that it left
    in its group end with it.
    """
    start_s = time.monotonic()
    out, log = logs / f"{name}.out", logs / f"{name}.log"
    with out.open("wb") as out_file, log.open("wb") as log_file:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=out_file,
            stderr=log_file,
            cwd=cwd,
            env=environment,
            start_new_session=True,
        )
        state = TOO_LONG
        try:
            state = FAILED if process.wait(timeout=limit_s) else DONE
        except subprocess.TimeoutExpired:
            pass
        finally:
            _end_group(process)
    return state, time.monotonic() - start_s


def _end_group(process: subprocess.Popen) -> None:
    """End a program and what it started; the group outlives its leader."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
        except ProcessLookupError:
            break
        try:
            process.wait(timeout=GRACE_S)
        except subprocess.TimeoutExpired:
            continue
    process.wait()


def printed_json(path: Path) -> dict:
    """Return the object that a program printed; empty where it printed none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def kept_rows(path: Path, since_s: float) -> dict:
    """Return rows that a program kept as they came, since a time of the clock."""
    if not path.is_file() or path.stat().st_mtime < since_s:
        return {}
    *lines, _ = path.read_text(encoding="utf-8").split("\n")  # the last may be half
    return {"rows": [json.loads(line)["row"] for line in lines]} if lines else {}


def last_lines(*paths: Path) -> tuple[str, ...]:
    """Return the last lines of logs that say something, the later file's last."""
    lines = [
        line.strip()
        for path in paths
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines()
        if line.strip()
    ]
    return tuple(lines[-TAIL_LINES:])
