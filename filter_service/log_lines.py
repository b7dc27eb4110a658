"""Log of the service: one line per event, as text or as JSON."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
from collections import deque
from types import TracebackType

FORMAT_VARIABLE = "OCUFILTER_LOG_FORMAT"
LOG_FORMATS = ("text", "json")
TEXT = "%(asctime)s ocufilter {name} %(levelname)s: %(message)s"

MAX_REPEATS = 10
"""Maximum number of similar lines per second; a hostile client can cause thousands."""

ONCE_A_SECOND = {"max_repeats": 1}
"""`extra` argument of log calls that are written at most once a second."""


MAX_WAITING_LINES = 1000
"""Maximum number of lines that wait to be written; further ones are dropped."""

WRITE_LIMIT_S = 0.02
"""Maximum time that a caller waits until its line is written.  It usually takes 0.1 ms,
so that a line precedes the next action of the process."""

EXIT_LIMIT_S = 0.5
"""Maximum time at exit for writing the lines that wait."""

STDERR = 2


class JsonLines(logging.Formatter):
    """One JSON object per line: time, process, level, message, optional traceback."""

    def __init__(self, process_name: str) -> None:
        super().__init__()
        self._process_name = process_name

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line of JSON."""
        moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        line = {
            "time": f"{moment}.{int(record.msecs):03d}Z",
            "process": self._process_name,
            "pid": record.process,
            "level": record.levelname.lower(),
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


class RepeatFilter(logging.Filter):
    """Drops lines that repeat too often; the next one written reports how many."""

    def __init__(self) -> None:
        super().__init__()
        self._ends_s = 0.0
        self._counts: dict[str, int] = {}
        self._omitted: dict[str, int] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is written."""
        now_s, template = time.monotonic(), str(record.msg)
        if now_s >= self._ends_s:
            self._ends_s = now_s + 1.0
            self._counts.clear()
        count = self._counts[template] = self._counts.get(template, 0) + 1
        if count > getattr(record, "max_repeats", MAX_REPEATS):
            self._omitted[template] = self._omitted.get(template, 0) + 1
            return False
        n_omitted = self._omitted.pop(template, 0)
        if n_omitted:
            text = record.getMessage()
            record.msg = f"{text} ({n_omitted} similar lines omitted)"
            record.args = None
        return True


class LineWriter(logging.Handler):
    """Writes lines from a thread, so that a full pipe or a slow disk stops no caller.

    A caller waits for its line for a moment.  Once that was not enough, callers do not
    wait until all lines are written.  Beyond a number of waiting lines, and after a
    write that fails, lines are dropped; the next one written reports how many.

    Parameters
    ----------
    descriptor : int
        Descriptor to write to.
    """

    def __init__(self, descriptor: int = STDERR) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._lines: deque[bytes] = deque()
        self._n_dropped = 0
        self._is_writing = self._is_behind = False
        self._changed = threading.Condition()
        threading.Thread(target=self._run, name="log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Add a line to those that wait."""
        line = self._line_of(record)
        with self._changed:
            if len(self._lines) >= MAX_WAITING_LINES:
                self._n_dropped += 1
                return
            if self._n_dropped:
                text = f"{self._n_dropped} log lines could not be written"
                warning = logging.WARNING
                note = logging.LogRecord(record.name, warning, "", 0, text, None, None)
                self._lines.append(self._line_of(note))
                self._n_dropped = 0
            self._lines.append(line)
            self._changed.notify_all()
            if not self._is_behind:
                self._is_behind = not self._wait(WRITE_LIMIT_S)

    def flush(self) -> None:
        """Wait for the lines to be written, for a limited time."""
        with self._changed:
            self._wait(EXIT_LIMIT_S)

    def _wait(self, limit_s: float) -> bool:
        """Wait for the lines to be written; return whether they are."""
        return self._changed.wait_for(
            lambda: not self._lines and not self._is_writing, limit_s
        )

    def _line_of(self, record: logging.LogRecord) -> bytes:
        try:
            text = self.format(record)
        except Exception as error:  # the handler of such errors writes to stderr
            text = f"{record.msg!r} could not be formatted: {error}"
        return f"{text}\n".encode("utf-8", "backslashreplace")

    def _run(self) -> None:
        while True:
            with self._changed:
                self._is_writing = False
                self._is_behind &= bool(self._lines)
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._lines)
                line = self._lines.popleft()
                self._is_writing = True
            try:
                while line:
                    line = line[os.write(self._descriptor, line) :]
            except OSError:
                with self._changed:
                    self._n_dropped += 1


def _log_exception(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    """Log an exception that ends the process, in place of printing it."""
    logging.getLogger("ocufilter").critical(
        "the process ends", exc_info=(kind, error, traceback)
    )


def configure_logging(process_name: str, *, level: int = logging.INFO) -> None:
    """Log to stderr, in the format that the environment selects.

    Nothing that this process logs waits for a reader: neither lines nor warnings nor
    the exception that ends it.
    """
    handler = LineWriter()
    if os.environ.get(FORMAT_VARIABLE) == "json":
        handler.setFormatter(JsonLines(process_name))
    else:
        handler.setFormatter(logging.Formatter(TEXT.format(name=process_name)))
    handler.addFilter(RepeatFilter())
    logging.basicConfig(level=level, handlers=[handler])
    logging.captureWarnings(True)
    sys.excepthook = _log_exception
