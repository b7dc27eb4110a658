"""Starts the service: signals, the line that says it is ready, the real parts.

What takes long to import is imported while the worker process does the same.
"""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable
from typing import Any

from filter_service.service.config import ServiceConfig
from filter_service.service.worker_handle import WorkerHandle

BUILD = "filter_service.service.profile_build:build"
WARM_UP = "filter_service.service.worker_warm_up:build_a_few"


def serve(
    config: ServiceConfig,
    *,
    renderer: Any,
    worker: WorkerHandle,
    check_profile: Callable[[dict, Any], object],
    gl_renderer: str = "unknown",
) -> None:
    """Serve until SIGINT or SIGTERM; prints one line when ready.

    Must run in the main thread of a process that owns the renderer's GL context.
    """
    from filter_service.service.server import FilterServer

    server = FilterServer(
        config,
        renderer=renderer,
        worker=worker,
        check_profile=check_profile,
        gl_renderer=gl_renderer,
    )
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: server.stop())
        signal.set_wakeup_fd(server.wake_file_descriptor, warn_on_full_buffer=False)
    try:
        _announce(config, server.endpoint)
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
    """Serve with the real renderer and the real PSFs."""
    logging.basicConfig(level=logging.INFO, format="ocufilter: %(message)s")
    worker = WorkerHandle(
        BUILD, config.build_niceness, config.cancel_grace_s, warm_up=WARM_UP
    )
    worker.start()
    try:
        _run_beside(worker, config)
    finally:
        worker.close()


def _run_beside(worker: WorkerHandle, config: ServiceConfig) -> None:
    from filter_service.gl.gpu import Gpu
    from filter_service.rendering.renderer import FilterRenderer
    from filter_service.rendering.warm_up import warm_up
    from filter_service.service.profile_build import check_profile
    from filter_service.service.threads import require_safe_threading_layer

    require_safe_threading_layer()
    gpu = Gpu()
    try:
        renderer = FilterRenderer(gpu)
        warm_up(renderer)
        serve(
            config,
            renderer=renderer,
            worker=worker,
            check_profile=check_profile,
            gl_renderer=gpu.info["renderer"],
        )
    finally:
        gpu.close()
