"""Main program of a render worker, run with ``python -m``.

Its arguments are the link's descriptor, the ``module:function`` that opens the builder,
and the process's name in the log.  ``function(config, closing)`` returns the builder, a
function that parses profiles, and a function to call when the worker is ready.  Tests
replace it.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from estimator.threads import THREADS_VARIABLE
from filter_service.building.worker_handle import WorkerHandle
from filter_service.errors import FilterError
from filter_service.gl_device import AUTO, GL_DEVICE_VARIABLE
from filter_service.service.config import ServiceConfig
from filter_service.service.process_channel import Link, start_process

if TYPE_CHECKING:
    from estimator.profiles.parse import EyeProfile
    from filter_service.filtering.builder import Builder
    from filter_service.service.render_worker import RenderWorker

    ReadProfile = Callable[[dict[str, Any]], EyeProfile]
    Opened = tuple[Builder, ReadProfile, Callable[[], None]]

log = logging.getLogger("ocufilter")


def open_configured_builder(config: ServiceConfig, closing: ExitStack) -> Opened:
    """Open the build worker and the engine that the settings select."""
    if config.threads:
        os.environ[THREADS_VARIABLE] = str(
            config.threads
        )  # inherited by the build worker
    if config.gl_device != AUTO:
        os.environ[GL_DEVICE_VARIABLE] = config.gl_device  # likewise
    worker = WorkerHandle(
        cancel_grace_s=config.cancel_grace_s,
        build_limit_s=config.build_limit_s,
        niceness=config.build_niceness,
    )
    closing.callback(worker.close)
    worker.start()  # imports take long; both processes run them at the same time
    from filter_service.filtering.shared_builder import open_builder, preload
    from filter_service.service.profile_reader import read_profile

    builder = open_builder(worker, config.build_limits, closing, engine=config.engine)
    return builder, read_profile, preload


def main() -> None:
    """Filter frames until the supervisor sends stop."""
    supervisor, config, others = start_process(sys.argv[3])
    module, _, function = sys.argv[2].partition(":")
    open_builder = getattr(importlib.import_module(module), function)
    with ExitStack() as closing:
        try:
            builder, read_profile, on_ready = open_builder(config, closing)
        except (FilterError, ValueError, OSError) as error:
            supervisor.send(("failed", str(error)))
            raise SystemExit(1) from None
        from filter_service.service.render_worker import RenderWorker

        loop = RenderWorker(builder, read_profile, max_cameras=config.max_cameras)
        supervisor.send(("ready", ""))
        on_ready()
        loop.run(supervisor, lambda *message: handle_control(loop, *message), others)


def handle_control(
    loop: RenderWorker, message: tuple[Any, ...], descriptors: list[int]
) -> bool:
    """Handle a message of the supervisor; return whether to continue."""
    if message[0] == "link":
        loop.connect(Link.from_descriptor(descriptors[0]))
    return bool(message[0] != "stop")


if __name__ == "__main__":
    main()
