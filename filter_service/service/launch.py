"""Starts the service: signals, the line that says it is ready, the real parts."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from estimator.threads import THREADS_VARIABLE
from filter_service.building.worker_handle import WorkerHandle
from filter_service.service.config import ServiceConfig

if TYPE_CHECKING:
    from estimator.profiles.parse import EyeProfile
    from filter_service.filtering.workshop import Workshop


def serve(
    config: ServiceConfig,
    *,
    workshop: Workshop,
    read_profile: Callable[[dict[str, Any]], EyeProfile],
    when_ready: Callable[[], None] | None = None,
) -> None:
    """Serve until SIGINT or SIGTERM; prints one line when ready.

    Must run in the main thread of a process that owns the engine's GL context.

    Parameters
    ----------
    when_ready : callable, optional
        Called once that line is printed; must not take long.
    """
    from filter_service.service.server import FilterServer

    server = FilterServer(config, workshop=workshop, read_profile=read_profile)
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: server.stop())
        signal.set_wakeup_fd(server.wake_file_descriptor, warn_on_full_buffer=False)
    try:
        _announce(config, server.endpoint)
        if when_ready is not None:
            when_ready()
        server.run()
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.set_wakeup_fd(-1)
        if config.ready_file is not None:
            config.ready_file.unlink(missing_ok=True)


def _announce(config: ServiceConfig, endpoint: str) -> None:
    """Say that the service is ready; the file appears complete or not at all."""
    if config.ready_file is not None:
        unfinished = config.ready_file.with_suffix(".unfinished")
        unfinished.write_text(endpoint + "\n", encoding="utf-8")
        unfinished.replace(config.ready_file)
    print(f"ocufilter: serving on {endpoint}", flush=True)


def run(config: ServiceConfig) -> None:
    """Serve with the real engine and the real PSFs."""
    logging.basicConfig(level=logging.INFO, format="ocufilter: %(message)s")
    if config.threads:
        os.environ[THREADS_VARIABLE] = str(config.threads)  # the worker's, too
    worker = WorkerHandle(
        niceness=config.build_niceness, cancel_grace_s=config.cancel_grace_s
    )
    with ExitStack() as closing:
        closing.callback(worker.close)
        worker.start()  # it imports what takes long while this process does the same
        from filter_service.building.read_profile import read_profile
        from filter_service.filtering.load_ahead import load_ahead
        from filter_service.filtering.shared_workshop import open_workshop

        workshop = open_workshop(
            worker, config.build_limits, closing, engine=config.engine
        )
        serve(
            config,
            workshop=workshop,
            read_profile=read_profile,
            when_ready=load_ahead,
        )
