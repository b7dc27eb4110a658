"""Startup of the service: signal handlers and readiness."""

from __future__ import annotations

import errno
import logging
import os
import select
import signal
from collections.abc import Callable
from functools import partial

from filter_service.atomic_files import write_atomically
from filter_service.log_lines import FORMAT_VARIABLE, configure_logging
from filter_service.service.config import ServiceConfig
from filter_service.service.supervisor import OPEN_BUILDER, ServiceFailed, Supervisor

STDOUT = 1

log = logging.getLogger("ocufilter")


def run(
    config: ServiceConfig,
    *,
    open_builder: str = OPEN_BUILDER,
    reload_config: Callable[[], ServiceConfig] | None = None,
) -> None:
    """Run the service until SIGINT or SIGTERM; print one line when ready.

    Call it from the main thread.

    Parameters
    ----------
    config : ServiceConfig
    open_builder : str
        ``module:function`` that opens the builder, see `render_worker_process`.
    reload_config : callable, optional
        Returns the current settings; called at SIGHUP.

    Raises
    ------
    OSError
        If the service cannot start, or has failed for too long.
    """
    os.environ[FORMAT_VARIABLE] = config.log_format  # for all processes
    configure_logging("service")
    supervisor = Supervisor(
        config,
        open_builder=open_builder,
        on_ready=ReadyAnnouncement(config).ready,
        on_not_ready=partial(_remove_ready_file, config),
        reload_config=reload_config,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: supervisor.stop())
    signal.signal(signal.SIGHUP, lambda *_: supervisor.request_reload())
    signal.set_wakeup_fd(supervisor.wake_file_descriptor, warn_on_full_buffer=False)
    try:
        supervisor.run()
    except ServiceFailed as error:
        raise OSError(str(error)) from None
    finally:
        signal.set_wakeup_fd(-1)
        _remove_ready_file(config)


class ReadyAnnouncement:
    """Reports that the service is ready: once on stdout, and in the ready file."""

    def __init__(self, config: ServiceConfig) -> None:
        self._config = config
        self._is_printed = False

    def ready(self, endpoint: str) -> None:
        """Print one line the first time, and write the ready file.

        A service that cannot print the line runs; one that cannot write the file does
        not start.

        Raises
        ------
        OSError
            If the ready file cannot be written.
        """
        if not self._is_printed:
            self._is_printed = True
            try:
                _print_line(f"ocufilter: serving on {endpoint}\n")
            except OSError as error:
                log.warning("stdout cannot be written: %s", error.strerror)
        if self._config.ready_file is not None:
            write_atomically(self._config.ready_file, endpoint + "\n")


def _print_line(line: str) -> None:
    """Write a line to stdout, unbuffered: otherwise Python fails again at exit.

    Raises
    ------
    OSError
        If the line cannot be written at once.
    """
    if not select.select([], [STDOUT], [], 0.0)[1]:
        raise BlockingIOError(errno.EAGAIN, "its reader does not read")
    os.write(STDOUT, line.encode())


def _remove_ready_file(config: ServiceConfig) -> None:
    if config.ready_file is not None:
        config.ready_file.unlink(missing_ok=True)
