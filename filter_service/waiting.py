"""Timeouts and progress bars for blocking calls of the Python API.

    with Wait("Preparing the eye", timeout_s) as wait:
        while not is_ready():
            wait.update(n_steps_done, fraction, stage)
            if wait.remaining_s <= 0.0:
                raise ServiceTimeout("timed out while waiting for the eye")

A wait that takes longer than `SHOWN_AFTER_S` shows a bar on stderr if that is a
terminal, and removes it at the end.  There is none while the program shows a `Progress`
of its own, or if the environment variable ``OCUFILTER_PROGRESS`` is 0.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from typing import Any, Self

from filter_service.progress import Progress, Task, is_progress_open

SHOWN_AFTER_S = 2.0
WATCH_S = 0.5
"""Interval at which the watcher thread checks for long waits."""

PROGRESS_VARIABLE = "OCUFILTER_PROGRESS"


class Wait:
    """Timeout and progress bar of one blocking call.

    Parameters
    ----------
    title : str
        Name of the work, for the bar.
    timeout_s : float
        Maximum time without progress; unlimited by default.
    is_shown : bool
        Whether to show a bar; not if the caller reports the progress itself.
    """

    def __init__(
        self, title: str, timeout_s: float = math.inf, *, is_shown: bool = True
    ) -> None:
        self._title, self._timeout_s = title, timeout_s
        self._is_shown = is_shown
        self._mark: Any = None
        self._fraction: float | None = None
        self._stage = ""
        self._end_s = time.monotonic() + timeout_s
        self._is_overdue = False
        self._began_s = time.monotonic()
        self._is_watched = False
        self._lock = threading.Lock()
        self._has_ended = False
        self._bar: tuple[Progress, Task] | None = None

    def __enter__(self) -> Self:
        """Start watching, so that a bar appears if the wait is long."""
        if self._is_shown and _has_terminal():
            self._is_watched = True
            _watcher.watch(self)
        return self

    def __exit__(self, *exc_info: Any) -> None:
        """Remove the bar."""
        if not self._is_watched:
            return
        _watcher.waits.discard(self)
        with self._lock:
            self._has_ended = True
            if self._bar is not None:
                self._bar[0].__exit__(None, None, None)

    @property
    def remaining_s(self) -> float:
        """Return the time left until the timeout, unless the work progresses."""
        return self._end_s - time.monotonic()

    def is_over(self) -> bool:
        """Return whether the timeout has expired, now and at the previous call.

        Requiring two calls lets a program that was suspended read the messages that
        have arrived in the meantime.
        """
        was_overdue, self._is_overdue = self._is_overdue, self.remaining_s <= 0.0
        return was_overdue and self._is_overdue

    def advance(self) -> None:
        """Restart the timeout, because the work has progressed."""
        self._end_s = time.monotonic() + self._timeout_s

    def update(self, mark: Any, fraction: float | None = None, stage: str = "") -> None:
        """Restart the timeout if the work has progressed, and update the bar.

        Parameters
        ----------
        mark : object
            Any value that changes whenever the work progresses.
        fraction : float, optional
            Completed fraction, 0 to 1, if it is known.
        stage : str
        """
        if mark != self._mark:
            self._mark = mark
            self.advance()
        if not self._is_watched or (fraction, stage) == (self._fraction, self._stage):
            return
        with self._lock:
            self._fraction, self._stage = fraction, stage
            self._show()

    @property
    def is_long(self) -> bool:
        """Return whether the wait has taken long enough for a bar."""
        return time.monotonic() - self._began_s > SHOWN_AFTER_S

    def open_bar(self) -> None:
        """Open the bar, unless the wait has ended or another bar is open."""
        with self._lock:
            if self._has_ended or is_progress_open():
                return
            progress = Progress(is_removed=True).__enter__()
            self._bar = progress, progress.task(self._title, unit="%")
            self._show()

    def _show(self) -> None:
        if self._bar is None:
            return
        task = self._bar[1]
        task.total = 0.0 if self._fraction is None else 1.0
        task.update(self._fraction or 0.0, self._stage)


class _Watcher:
    """Thread that opens the bars of long waits.

    It is a thread because the waiting thread may compute for seconds.  All waits share
    it because starting a thread for each frame took 0.2 ms.
    """

    def __init__(self) -> None:
        self.waits: set[Wait] = set()
        self._thread: threading.Thread | None = None

    def watch(self, wait: Wait) -> None:
        """Watch a wait; start the thread, which a forked process lacks."""
        self.waits.add(wait)
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def _run(self) -> None:
        never = threading.Event()
        while not never.wait(WATCH_S):
            for wait in list(self.waits):
                if wait.is_long:
                    wait.open_bar()
                    self.waits.discard(wait)


_watcher = _Watcher()


def _has_terminal() -> bool:
    """Return whether stderr is a terminal on which bars are allowed."""
    try:
        if sys.stderr is None or not sys.stderr.isatty():
            return False
    except ValueError:  # it is closed
        return False
    return os.environ.get(PROGRESS_VARIABLE) != "0"
