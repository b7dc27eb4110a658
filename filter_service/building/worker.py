"""The worker process: estimates eyes and plans the nodes of their PSFs.

A process, not a thread: estimating holds the interpreter lock for tenths of a second,
which frames would wait for.

Parent to worker: ``("build", ticket, job)``, ``("cancel", ticket)``.  Worker to parent:
``("ready",)``, ``("progress", ticket, fraction, stage)``; at the end ``("result",
ticket, built)`` or ``("failed", ticket, code, message, field, allowed)``.  After a
result come its parts, ``("part", ticket, part)``, until a new message does.  A result
has 0.3 to 2 MB, a part 0.2 to 1.  The pipe joins two processes of ours, so it may carry
pickles; nothing from outside does.
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
from filter_service.building.head_start import HeadStart
from filter_service.building.jobs import Build, BuildJob
from filter_service.errors import BuildCancelled, BuildFailed, FilterError
from filter_service.log_lines import start_log

PROGRESS_INTERVAL_S = 0.1
IDLE_S = 3.0
"""Without a job for so long, the worker prepares for those that will come."""

log = logging.getLogger("ocufilter.worker")


class ParentGone(Exception):
    """The service has ended; so does the worker."""


def main() -> None:
    """Run as ``python -m``: DESCRIPTOR BUILD NICENESS WARM_UP; the entry point."""
    descriptor, build_name, niceness, warm_up_name = sys.argv[1:]
    os.nice(int(niceness))
    serve_builds(Connection(int(descriptor)), build_name, warm_up_name)


def serve_builds(pipe: Connection, build_name: str, warm_up_name: str = "") -> None:
    """Build what is asked for until the pipe closes."""
    # Ctrl-C goes to the whole group; the service ends the worker in its own time.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    start_log("worker")
    try:
        build, head_start = _named(build_name), None
        pipe.send(("ready",))
        # A client that knows a restarted service comes at once, and maybe for a store
        # from the disk: it shall not share the processor with what it does not need.
        if warm_up_name and not pipe.poll(IDLE_S):
            head_start = HeadStart(_named(warm_up_name))
        while True:
            message = pipe.recv()
            if message[0] == "build":
                ticket, job = message[1:]
                _build_one(pipe, build, head_start, ticket=ticket, job=job)
    except (EOFError, OSError, ParentGone):
        return


def _named(name: str) -> Callable[..., Any]:
    module, _, function = name.partition(":")
    named: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return named


def _build_one(
    pipe: Connection,
    build: Build,
    head_start: HeadStart | None,
    *,
    ticket: int,
    job: BuildJob,
) -> None:
    progress = _throttled_progress(pipe, ticket)

    def cancelled() -> bool:
        return _is_cancelled(pipe, ticket)

    if head_start is not None:
        progress = head_start.before(progress, cancelled)
    try:
        built = build(job, progress=progress, cancelled=cancelled)
    except ParentGone:
        raise
    except Exception as error:
        _send_failure(pipe, ticket, error)
        return
    pipe.send(("result", ticket, built))
    try:
        for part in built.parts_ahead(job):
            if pipe.poll(0):  # something newer is asked for
                return
            pipe.send(("part", ticket, part))
    except OSError:
        raise ParentGone from None
    except Exception as error:  # a frame that needs it fails, and says so to its client
        log.info("nodes ahead of frames: %s", error)


def _throttled_progress(pipe: Connection, ticket: int) -> Callable[[float, str], None]:
    next_s, last_stage = 0.0, None

    def progress(fraction: float, stage: str) -> None:
        nonlocal next_s, last_stage
        now_s = time.monotonic()
        # The first word of a stage is never held back: a short one has no second.
        if now_s >= next_s or stage != last_stage:
            next_s, last_stage = now_s + PROGRESS_INTERVAL_S, stage
            pipe.send(("progress", ticket, min(max(float(fraction), 0.0), 1.0), stage))

    return progress


def _is_cancelled(pipe: Connection, ticket: int) -> bool:
    """Return whether the parent cancelled this ticket (2 us when it did not)."""
    while pipe.poll(0):
        try:
            message = pipe.recv()
        except (EOFError, OSError):
            raise ParentGone from None
        if message == ("cancel", ticket):
            return True
    return False


def _send_failure(pipe: Connection, ticket: int, error: Exception) -> None:
    if not isinstance(error, FilterError):
        log.exception("a build failed in a way that is not foreseen")
        error = BuildFailed(f"{type(error).__name__}: {error}")
    if not isinstance(error, BuildCancelled):
        log.info("build %d failed: %s", ticket, error)
    pipe.send(("failed", ticket, error.code, error.message, error.field, error.allowed))


if __name__ == "__main__":
    main()
