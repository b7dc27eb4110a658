"""Log of the service: one line per event, as text or as JSON."""

from __future__ import annotations

import json
import logging
import os
import time

FORMAT_VARIABLE = "OCUFILTER_LOG_FORMAT"
LOG_FORMATS = ("text", "json")
TEXT = "%(asctime)s ocufilter {name} %(levelname)s: %(message)s"

MAX_REPEATS = 10
"""Maximum number of similar lines per second; a hostile client can cause thousands."""

ONCE_A_SECOND = {"max_repeats": 1}
"""`extra` argument of log calls that are written at most once a second."""


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


def configure_logging(process_name: str) -> None:
    """Log to stderr, in the format that the environment selects."""
    handler = logging.StreamHandler()
    if os.environ.get(FORMAT_VARIABLE) == "json":
        handler.setFormatter(JsonLines(process_name))
    else:
        handler.setFormatter(logging.Formatter(TEXT.format(name=process_name)))
    handler.addFilter(RepeatFilter())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
