"""How far long work is: bars for a person, plain lines where output goes to a file.

    with Progress() as progress:
        task = progress.task("Rendering", total=60)
        task.advance()

Lines come when a task begins or its stage changes, and every few seconds besides,
whether or not the work has moved: who reads a log sees that it is alive.
"""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Any, Self, TextIO

INTERVAL_S = 5.0
STAGE_NAMES = {"psfs": "PSFs"}
"""Of stages whose names in messages are not how people write them."""

SURE_AFTER_S = 2.0
"""Sooner, what is done says little of the time that is left."""


class Task:
    """One piece of work with a count; made by `Progress.task`."""

    def __init__(self, progress: Progress, title: str, total: float, unit: str) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.stage = ""
        self.done = 0.0
        self._first: tuple[float, float] | None = None  # done, and when
        self._progress = progress

    def advance(self) -> None:
        """Count one more."""
        self.update(self.done + 1.0)

    def update(self, done: float, stage: str | None = None) -> None:
        """Say what is done of the total, and what is being done."""
        is_new_stage = stage is not None and stage != self.stage
        if self._first is None or is_new_stage:
            self._first = (done, time.monotonic())
        self.done, self.stage = done, self.stage if stage is None else stage
        self._progress._changed(self, is_new_stage)

    @property
    def name(self) -> str:
        """What is being done."""
        stage = STAGE_NAMES.get(self.stage, self.stage)
        return f"{self.title}: {stage}" if stage else self.title

    @property
    def count(self) -> str:
        """How much of it is done, and the time that the rest will take."""
        if not self.total:
            return ""
        if self.unit == "%":
            return f"{100.0 * self.done / self.total:.0f} %{self._time_left()}"
        return f"{self.done:.0f}/{self.total:.0f} {self.unit}{self._time_left()}"

    def _time_left(self) -> str:
        """From the pace since the first count: what precedes it is preparation."""
        if self._first is None:
            return ""
        done, spent_s = self.done - self._first[0], time.monotonic() - self._first[1]
        if done <= 0.0 or self.done >= self.total or spent_s < SURE_AFTER_S:
            return ""
        return f", {spent_s * (self.total - self.done) / done:.0f} s left"


class Progress:
    """Says how far tasks are, one after the other, on stderr.

    Parameters
    ----------
    name : str
        What lines begin with: the program.
    quiet : bool
        Nothing is said.
    as_lines : bool
        Lines on a terminal too: others write there as well.
    stream : file, optional
        In the place of stderr.
    interval_s : float
        Longest silence between lines.
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
        """Return this, with its bars on the screen or its lines on their way."""
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
        """End it; the last task's count is said once more, if it has changed."""
        self._ended.set()
        if self._bars is not None:
            self._bars.close()
        elif self._task is not None and kind is None:
            self._say(self._task)

    def task(self, title: str, *, total: float = 0.0, unit: str = "frames") -> Task:
        """Begin a task; without a total there is nothing to count.

        Parameters
        ----------
        unit : str
            What is counted; of "%" the total counts as a hundred.
        """
        if self._task is not None and self._bars is None:
            self._say(self._task)
        self._task = task = Task(self, title, total, unit)
        if self._bars is not None:
            self._bars.add(task)
        else:
            self._say(task)
        return task

    def _changed(self, task: Task, is_new_stage: bool) -> None:
        if self._bars is not None:
            self._bars.show(task)
        elif is_new_stage and task is self._task:
            self._say(task)

    def _repeat(self) -> None:
        """Say where the task is when nothing has been said for a while."""
        while not self._ended.wait(self._interval_s / 10.0):
            task, silent_s = self._task, time.monotonic() - self._last[1]
            if task is not None and silent_s >= self._interval_s:
                self._say(task, even_the_same=True)

    def _say(self, task: Task, *, even_the_same: bool = False) -> None:
        if self._is_quiet:
            return
        with self._lock:
            text = ", ".join(filter(None, (task.name, task.count)))
            now_s = time.monotonic()
            if text == self._last[0] and not even_the_same:
                return
            self._last = (text, now_s)
            spent_s = now_s - self._started_s
            self._stream.write(f"{self._name}: [{spent_s:.0f} s] {text}\n")
            self._stream.flush()


class _Bars:
    """Bars of rich, which takes 0.1 s to import and is needed by persons only."""

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
        """Draw one more bar, which moves to and fro where nothing is counted."""
        total = task.total or None
        self._numbers[task] = self._bars.add_task(task.title, total=total, count="")
        self.show(task)

    def show(self, task: Task) -> None:
        """Bring a bar up to date."""
        self._bars.update(
            self._numbers[task],
            completed=task.done,
            description=task.name,
            count=task.count,
        )

    def close(self) -> None:
        """Leave the bars as they are."""
        self._bars.stop()
