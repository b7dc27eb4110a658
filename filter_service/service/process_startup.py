"""Startup code shared by the processes of the service."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Any

from filter_service.log_lines import configure_logging
from filter_service.service.config import ServiceConfig
from filter_service.service.process_channel import Link

PR_SET_PDEATHSIG = 1


def start_process(name: str) -> tuple[Link, ServiceConfig, list[tuple[Any, list[int]]]]:
    """Set up signals and the log, and wait for the settings.

    The first argument of the program is the descriptor of the link to the supervisor.

    Parameters
    ----------
    name : str
        Name of the process in the log.

    Returns
    -------
    supervisor : Link
    config : ServiceConfig
    others : list of (message, descriptors)
        Messages that arrived after the settings.
    """
    _end_with_parent()
    # Ctrl-C signals the whole process group; the supervisor stops its processes itself.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    configure_logging(name)
    supervisor = Link.from_descriptor(int(sys.argv[1]))
    (first, _), *others = supervisor.wait()
    kind, config = first
    assert kind == "config"
    return supervisor, config, others


def _end_with_parent() -> None:
    """Make the kernel kill this process when its parent dies (Linux)."""
    parent = os.getppid()
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    except (OSError, AttributeError):
        return  # then the closed link ends this process
    if os.getppid() != parent:
        sys.exit(1)
