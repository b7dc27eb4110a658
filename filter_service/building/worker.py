"""Main program of the build worker.

It is a process, not a thread, because a build holds the GIL for tenths of a second,
which would delay frames.

Messages from the parent:

- ``("build", ticket, job)``, ``("cancel", ticket)``

Messages to the parent:

- ``("ready",)``, the first one
- ``("progress", ticket, fraction, stage)``
- ``("result", ticket, built)``, 0.3 to 2 MB, followed by ``("part", ticket, part)``,
  0.2 to 1 MB each, until a new message arrives
- ``("failed", ticket, code, message, field, allowed)``

Messages are pickled, which is safe because both processes belong to the service.
"""

from __future__ import annotations

import importlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from filter_service import one_blas_thread  # noqa: F401  (before any numpy)
from filter_service.building.jobs import Build, BuildJob, to_build_error
from filter_service.errors import BuildCancelled
from filter_service.log_lines import configure_logging

PROGRESS_INTERVAL_S = 0.1

log = logging.getLogger("ocufilter.worker")


class ParentExited(Exception):
    """The parent has exited."""


def main() -> None:
    """Run the worker; arguments are DESCRIPTOR BUILD NICENESS."""
    descriptor, build_name, niceness = sys.argv[1:]
    os.nice(int(niceness))
    serve_builds(Connection(int(descriptor)), build_name)


def serve_builds(pipe: Connection, build_name: str) -> None:
    """Serve build requests until the pipe closes."""
    # Ctrl-C signals the whole process group; the parent stops the worker itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    configure_logging("worker")
    try:
        build = _import_function(build_name)
        pipe.send(("ready",))
        while True:
            message = pipe.recv()
            if message[0] == "build":
                ticket, job = message[1:]
                _build_one(pipe, build, ticket=ticket, job=job)
    except (EOFError, OSError, ParentExited):
        return


def _import_function(name: str) -> Callable[..., Any]:
    module, _, function = name.partition(":")
    named: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return named


def _build_one(
    pipe: Connection,
    build: Build,
    *,
    ticket: int,
    job: BuildJob,
) -> None:
    progress = _throttled_progress(pipe, ticket)

    def cancelled() -> bool:
        return _is_cancelled(pipe, ticket)

    try:
        built = build(job, progress=progress, cancelled=cancelled)
    except ParentExited:
        raise
    except Exception as error:
        _send_failure(pipe, ticket, error)
        return
    pipe.send(("result", ticket, built))
    try:
        for part in built.parts_ahead(job):
            if pipe.poll(0):  # a newer request has arrived
                return
            pipe.send(("part", ticket, part))
    except OSError:
        raise ParentExited from None
    except Exception as error:  # a frame that needs the part reports it
        log.info("nodes could not be planned ahead: %s", error)


def _throttled_progress(pipe: Connection, ticket: int) -> Callable[[float, str], None]:
    next_s, last_stage = 0.0, None

    def progress(fraction: float, stage: str) -> None:
        nonlocal next_s, last_stage
        now_s = time.monotonic()
        # Always send the first message of a stage; a short stage has no other one.
        if now_s >= next_s or stage != last_stage:
            next_s, last_stage = now_s + PROGRESS_INTERVAL_S, stage
            pipe.send(("progress", ticket, min(max(float(fraction), 0.0), 1.0), stage))

    return progress


def _is_cancelled(pipe: Connection, ticket: int) -> bool:
    """Return whether the parent has canceled a build; takes 2 us if not."""
    while pipe.poll(0):
        try:
            message = pipe.recv()
        except (EOFError, OSError):
            raise ParentExited from None
        if message == ("cancel", ticket):
            return True
    return False


def _send_failure(pipe: Connection, ticket: int, error: Exception) -> None:
    error = to_build_error(error)
    if not isinstance(error, BuildCancelled):
        log.info("build %d failed: %s", ticket, error)
    pipe.send(("failed", ticket, error.code, error.message, error.field, error.allowed))


if __name__ == "__main__":
    main()
