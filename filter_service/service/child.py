"""What the processes of the service have in common when they start."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Any

from filter_service.log_lines import start_log
from filter_service.service.config import ServiceConfig
from filter_service.service.link import Link

PR_SET_PDEATHSIG = 1


def begin(name: str) -> tuple[Link, ServiceConfig, list[tuple[Any, list[int]]]]:
    """Return the link to the keeper, the settings, and what was said besides.

    The descriptor of the link is the first argument of the program.
    """
    _end_with_parent()
    # Ctrl-C goes to the whole group; the keeper ends its processes in its own time.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    start_log(name)
    keeper = Link.from_descriptor(int(sys.argv[1]))
    (first, _), *others = keeper.wait()
    kind, config = first
    assert kind == "config"
    return keeper, config, others


def _end_with_parent() -> None:
    """Have this process killed when the one that started it dies (Linux)."""
    parent = os.getppid()
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    except (OSError, AttributeError):
        return  # the end of the link says so, too
    if os.getppid() != parent:
        sys.exit(1)
