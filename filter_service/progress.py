"""Progress of long tasks: bars on a terminal, plain lines elsewhere.

    with Progress() as progress:
        task = progress.task("Rendering", total=60)
        task.advance()

Lines are written when a task starts or its stage changes, and every few seconds.  They
contain the remaining time once the counted items take equally long: see `Task.count`.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from bisect import bisect_right
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self, TextIO

INTERVAL_S = 5.0
STAGE_NAMES = {"psfs": "PSFs"}
"""Display names of stages, where they differ from the names in messages."""

MIN_ESTIMATE_S = 2.0
"""Minimum duration for an estimate of the remaining time."""

MIN_ITEMS = 6
"""Smallest number of items that gives a rate."""

MAX_RATIO = 1.5
"""Largest ratio of the estimates from the newest items and from all, so that their mean
is right within a factor of two whichever of them holds."""

MAX_SAMPLES = 512
"""Updates that a task remembers; of more, every other one is dropped."""


_open: set[Progress] = set()


def is_progress_open() -> bool:
    """Return whether the program reports progress now, or has been told to be quiet."""
    return bool(_open)


class Task:
    """A task with a count; created by `Progress.task`."""

    def __init__(self, progress: Progress, title: str, total: float, unit: str) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.stage = ""
        self.done = 0.0
        self._samples: list[tuple[float, float]] = []  # done, and when
        self._began_s = progress.clock()
        self._progress = progress

    def advance(self) -> None:
        """Add one to the count."""
        self.update(self.done + 1.0)

    def update(self, done: float, stage: str | None = None) -> None:
        """Set the completed part of the total, and the current stage."""
        is_new_stage = stage is not None and stage != self.stage
        if not self._samples:  # a resumed task begins with more than one
            self._samples.append((done if done > 1.0 else 0.0, self._began_s))
        if done > self._samples[-1][0]:
            self._samples.append((done, self._progress.clock()))
        if len(self._samples) > MAX_SAMPLES:
            del self._samples[1:-1:2]
        self.done, self.stage = done, self.stage if stage is None else stage
        self._progress._changed(self, is_new_stage)

    @property
    def name(self) -> str:
        """Return the title and the stage."""
        stage = STAGE_NAMES.get(self.stage, self.stage)
        return f"{self.title}: {stage}" if stage else self.title

    @property
    def count(self) -> str:
        """Return the completed part and, once it is known, the remaining time.

        Percentages have no remaining time, because their stages advance at rates of
        their own.
        """
        if not self.total:
            return ""
        if self.unit == "%":
            return f"{100.0 * self.done / self.total:.0f} %"
        left_s = self._left_s()
        left = "" if left_s is None else f", {left_s:.0f} s left"
        return f"{self.done:.0f}/{self.total:.0f} {self.unit}{left}"

    def _left_s(self) -> float | None:
        """Estimate the remaining time; None unless old and new items agree.

        The rates of all items, including the time before the first, and of the newest
        half, quarter and so on differ while something is prepared, and after it.  The
        fewer items remain, the fewer of the newest count.
        """
        if not self._samples or self.done >= self.total:
            return None
        (first, began_s), (done, last_s) = self._samples[0], self._samples[-1]
        now_s = self._progress.clock()
        n_items = done - first
        if n_items <= MIN_ITEMS or now_s - began_s < MIN_ESTIMATE_S:
            return None
        left_s, least = [], max(MIN_ITEMS, min(n_items, self.total - done) / 4.0)
        while n_items >= least:
            at = bisect_right(self._samples, (done - n_items, math.inf)) - 1
            before, since_s = self._samples[at]
            left_s.append((last_s - since_s) * (self.total - done) / (done - before))
            is_last = n_items == least
            n_items = 0.0 if is_last else max(n_items / 2.0, least)
        low_s, high_s = min(left_s), max(left_s)
        silent_s, item_s = now_s - last_s, high_s / (self.total - done)
        if high_s > MAX_RATIO * low_s or silent_s > MIN_ITEMS * item_s:
            return None
        return max(math.sqrt(low_s * high_s) - silent_s, 0.0)


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
    is_removed : bool
        Whether bars are removed at the end.
    stream : file, optional
        Stream in place of stderr.
    interval_s : float
        Longest time between lines.
    clock : callable
        Returns the time in seconds.
    """

    def __init__(
        self,
        name: str = "ocufilter",
        *,
        quiet: bool = False,
        as_lines: bool = False,
        is_removed: bool = False,
        stream: TextIO | None = None,
        interval_s: float = INTERVAL_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.clock = clock
        self._name, self._interval_s = name, interval_s
        self._stream = sys.stderr if stream is None else stream
        self._is_quiet, self._is_removed = quiet, is_removed
        self._has_bars = not (quiet or as_lines) and self._stream.isatty()
        self._bars: _Bars | None = None
        self._task: Task | None = None
        self._last = ("", 0.0)  # line and when
        self._started_s = clock()
        self._lock = threading.Lock()
        self._ended = threading.Event()

    def __enter__(self) -> Self:
        """Start the output."""
        _open.add(self)
        if self._has_bars:
            self._bars = _Bars(self._stream, is_removed=self._is_removed)
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
        _open.discard(self)
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
            task, silent_s = self._task, self.clock() - self._last[1]
            if task is not None and silent_s >= self._interval_s:
                self._write_line(task, force=True)

    def _write_line(self, task: Task, *, force: bool = False) -> None:
        if self._is_quiet:
            return
        with self._lock:
            text = ", ".join(filter(None, (task.name, task.count)))
            now_s = self.clock()
            if text == self._last[0] and not force:
                return
            self._last = (text, now_s)
            spent_s = now_s - self._started_s
            self._stream.write(f"{self._name}: [{spent_s:.0f} s] {text}\n")
            self._stream.flush()


class _Bars:
    """Bars by rich, imported only on terminals because that takes 0.1 s."""

    def __init__(self, stream: TextIO, *, is_removed: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress

        self._bars = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
            TimeElapsedColumn(),
            console=Console(file=stream),
            transient=is_removed,
            # The caller of a wait may replace the streams meanwhile.
            redirect_stdout=not is_removed,
            redirect_stderr=not is_removed,
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
            total=task.total or None,
            completed=task.done,
            description=task.name,
            count=task.count,
        )

    def close(self) -> None:
        """Stop the bars."""
        self._bars.stop()
