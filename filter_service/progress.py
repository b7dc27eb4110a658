"""Progress of long tasks: bars on a terminal, plain lines elsewhere.

    with Progress() as progress:
        task = progress.task("Rendering", total=60)
        task.advance()

Lines are written when a task starts or its stage changes, and every few seconds.
"""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Any, Self, TextIO

INTERVAL_S = 5.0
STAGE_NAMES = {"psfs": "PSFs"}
"""Display names of stages, where they differ from the names in messages."""

MIN_ESTIMATE_S = 2.0
"""Minimum duration for an estimate of the remaining time."""


class Task:
    """A task with a count; created by `Progress.task`."""

    def __init__(self, progress: Progress, title: str, total: float, unit: str) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.stage = ""
        self.done = 0.0
        self._first: tuple[float, float] | None = None  # done, and when
        self._progress = progress

    def advance(self) -> None:
        """Add one to the count."""
        self.update(self.done + 1.0)

    def update(self, done: float, stage: str | None = None) -> None:
        """Set the completed part of the total, and the current stage."""
        is_new_stage = stage is not None and stage != self.stage
        if self._first is None or is_new_stage:
            self._first = (done, time.monotonic())
        self.done, self.stage = done, self.stage if stage is None else stage
        self._progress._changed(self, is_new_stage)

    @property
    def name(self) -> str:
        """Return the title and the stage."""
        stage = STAGE_NAMES.get(self.stage, self.stage)
        return f"{self.title}: {stage}" if stage else self.title

    @property
    def count(self) -> str:
        """Return the completed part and the estimated remaining time."""
        if not self.total:
            return ""
        if self.unit == "%":
            return f"{100.0 * self.done / self.total:.0f} %{self._time_left()}"
        return f"{self.done:.0f}/{self.total:.0f} {self.unit}{self._time_left()}"

    def _time_left(self) -> str:
        """Estimate the remaining time from the rate since the first update."""
        if self._first is None:
            return ""
        done, spent_s = self.done - self._first[0], time.monotonic() - self._first[1]
        if done <= 0.0 or self.done >= self.total or spent_s < MIN_ESTIMATE_S:
            return ""
        return f", {spent_s * (self.total - self.done) / done:.0f} s left"


class Progress:
    """Reports the progress of successive tasks on stderr.

    Parameters
    ----------
    name : str
        Prefix of lines: the name of the program.
    quiet : bool
        Whether to write nothing.
    as_lines : bool
        Whether to write lines on a terminal, too.
    stream : file, optional
        Stream in place of stderr.
    interval_s : float
        Longest time between lines.
    """

    def __init__(
        self,
        name: str = "ocufilter",
        *,
        quiet: bool = False,
        as_lines: bool = False,
        stream: TextIO | None = None,
        interval_s: float = INTERVAL_S,
    ) -> None:
        self._name, self._interval_s = name, interval_s
        self._stream = sys.stderr if stream is None else stream
        self._is_quiet = quiet
        self._has_bars = not (quiet or as_lines) and self._stream.isatty()
        self._bars: _Bars | None = None
        self._task: Task | None = None
        self._last = ("", 0.0)  # line and when
        self._started_s = time.monotonic()
        self._lock = threading.Lock()
        self._ended = threading.Event()

    def __enter__(self) -> Self:
        """Start the output."""
        if self._has_bars:
            self._bars = _Bars(self._stream)
        elif not self._is_quiet:
            threading.Thread(target=self._repeat, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the output; write the final count."""
        self._ended.set()
        if self._bars is not None:
            self._bars.close()
        elif self._task is not None and kind is None:
            self._write_line(self._task)

    def task(self, title: str, *, total: float = 0.0, unit: str = "frames") -> Task:
        """Start a task; a total of 0 shows no count.

        Parameters
        ----------
        unit : str
            Unit of the count; "%" shows a percentage of the total.
        """
        if self._task is not None and self._bars is None:
            self._write_line(self._task)
        self._task = task = Task(self, title, total, unit)
        if self._bars is not None:
            self._bars.add(task)
        else:
            self._write_line(task)
        return task

    def _changed(self, task: Task, is_new_stage: bool) -> None:
        if self._bars is not None:
            self._bars.show(task)
        elif is_new_stage and task is self._task:
            self._write_line(task)

    def _repeat(self) -> None:
        """Write a line whenever none has been written for the interval."""
        while not self._ended.wait(self._interval_s / 10.0):
            task, silent_s = self._task, time.monotonic() - self._last[1]
            if task is not None and silent_s >= self._interval_s:
                self._write_line(task, force=True)

    def _write_line(self, task: Task, *, force: bool = False) -> None:
        if self._is_quiet:
            return
        with self._lock:
            text = ", ".join(filter(None, (task.name, task.count)))
            now_s = time.monotonic()
            if text == self._last[0] and not force:
                return
            self._last = (text, now_s)
            spent_s = now_s - self._started_s
            self._stream.write(f"{self._name}: [{spent_s:.0f} s] {text}\n")
            self._stream.flush()


class _Bars:
    """Bars by rich, imported only on terminals because that takes 0.1 s."""

    def __init__(self, stream: TextIO) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress

        self._bars = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
            TimeElapsedColumn(),
            console=Console(file=stream),
        )
        self._numbers: dict[Task, Any] = {}
        self._bars.start()

    def add(self, task: Task) -> None:
        """Add a bar; without a total it is indeterminate."""
        total = task.total or None
        self._numbers[task] = self._bars.add_task(task.title, total=total, count="")
        self.show(task)

    def show(self, task: Task) -> None:
        """Update a bar."""
        self._bars.update(
            self._numbers[task],
            completed=task.done,
            description=task.name,
            count=task.count,
        )

    def close(self) -> None:
        """Stop the bars; they stay on the screen."""
        self._bars.stop()
