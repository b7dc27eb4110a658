"""The service's log: a line an event, for people or, as JSON, for programs."""

from __future__ import annotations

import json
import logging
import os
import time

FORMAT_VARIABLE = "OCUFILTER_LOG_FORMAT"
LOG_FORMATS = ("text", "json")
TEXT = "%(asctime)s ocufilter {name} %(levelname)s: %(message)s"


class JsonLines(logging.Formatter):
    """One JSON object a line: time, process, level, message, maybe a traceback."""

    def __init__(self, process_name: str) -> None:
        super().__init__()
        self._process_name = process_name

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
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


def start_log(process_name: str) -> None:
    """Log to the standard error stream, in the format that the environment names."""
    handler = logging.StreamHandler()
    if os.environ.get(FORMAT_VARIABLE) == "json":
        handler.setFormatter(JsonLines(process_name))
    else:
        handler.setFormatter(logging.Formatter(TEXT.format(name=process_name)))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
