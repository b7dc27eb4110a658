"""Main program of the build worker.

It is a process, not a thread, because a build holds the GIL for tenths of a second,
which would delay frames.

Messages from the parent:

- ``("build", ticket, job)``, ``("cancel", ticket)``
- ``("near", ticket, state)``, to plan the nodes near a state of a built store next

Messages to the parent:

- ``("ready",)``, the first one
- ``("progress", ticket, fraction, stage)``
- ``("result", ticket, built)``, 0.3 to 2 MB
- ``("part", ticket, part)``, 0.2 to 1 MB each, while there is nothing else to do
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
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

from filter_service import one_blas_thread  # noqa: F401  (before any numpy)
from filter_service.building.jobs import Build, BuildJob, BuiltStore, to_build_error
from filter_service.errors import BuildCancelled
from filter_service.heap import trim_heap
from filter_service.log_lines import configure_logging

PROGRESS_INTERVAL_S = 0.1

MAX_STORES = 4
"""Number of built stores whose nodes the worker still plans ahead."""

URGENT_PARTS, REST_RATIO = 3, 2.0
"""Number of parts near a state that are planned without a rest, and the rests after the
others relative to their duration, which leave the cores to frames."""

TRIM_AFTER_S = 0.2
"""Idle time after which freed memory is returned to the system: 20 MB after a build."""

log = logging.getLogger("ocufilter.worker")


class ParentExited(Exception):
    """The parent has exited."""


def main() -> None:
    """Run the worker; arguments are BUILD NICENESS DESCRIPTOR."""
    build_name, niceness, descriptor = sys.argv[1:]
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
        requests = _Requests(pipe)
        built: dict[int, tuple[BuiltStore, BuildJob]] = {}
        parts: Iterator[tuple[Any, ...]] = iter(())
        n_parts, rest_s = 0, 0.0
        while True:
            started_s = time.monotonic()
            part = None if requests.has_next(rest_s) else next(parts, None)
            if part is not None:
                pipe.send(part)
                n_parts += 1
                took_s = time.monotonic() - started_s - rest_s
                rest_s = REST_RATIO * took_s if n_parts > URGENT_PARTS else 0.0
                if n_parts == URGENT_PARTS:
                    trim_heap()  # of the build; the other parts take seconds
                continue
            n_parts, rest_s = 0, 0.0
            if not requests.has_next(TRIM_AFTER_S):
                trim_heap()
            kind, ticket, *arguments = requests.next()
            if kind == "build":
                found = _build_one(requests, build, ticket=ticket, job=arguments[0])
                if isinstance(found, BuiltStore):
                    kept = ticket, (replace(found, parts=()), arguments[0])
                    built = dict([*built.items(), kept][-MAX_STORES:])
                    parts = _parts_ahead(found, ticket, arguments[0])
            elif kind == "near" and ticket in built:
                found, job = built[ticket]
                job = replace(job, near=arguments[0])
                parts = _parts_ahead(found, ticket, job)
            elif kind == "forget":  # the next messages are of another builder
                built, parts = {}, iter(())
    except (EOFError, OSError, ParentExited):
        return


class _Requests:
    """Messages from the parent, in order; a build looks for its cancellation."""

    def __init__(self, pipe: Connection) -> None:
        self.pipe = pipe
        self._waiting: deque[Any] = deque()

    def has_next(self, timeout_s: float) -> bool:
        """Return whether a message arrives before a timeout."""
        return bool(self._waiting) or self.pipe.poll(timeout_s)

    def next(self) -> tuple[Any, ...]:
        """Return the next message, which may cancel a build that has ended."""
        message = self._waiting.popleft() if self._waiting else self.pipe.recv()
        return tuple(message)

    def is_cancelled(self, ticket: int) -> bool:
        """Return whether the parent has canceled a build; takes 2 us if not."""
        while self.pipe.poll(0):
            try:
                message = self.pipe.recv()
            except (EOFError, OSError):
                raise ParentExited from None
            if message == ("cancel", ticket):
                return True
            self._waiting.append(message)
        return False


def _parts_ahead(
    built: BuiltStore, ticket: int, job: BuildJob
) -> Iterator[tuple[Any, ...]]:
    """Yield messages with parts of a store, those near the job's state first."""
    try:
        for part in built.parts_ahead(job):
            yield "part", ticket, part
    except Exception as error:  # a frame that needs the part reports it
        log.info("nodes could not be planned ahead: %s", error)


def _import_function(name: str) -> Callable[..., Any]:
    module, _, function = name.partition(":")
    named: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return named


def _build_one(
    requests: _Requests,
    build: Build,
    *,
    ticket: int,
    job: Any,
) -> Any:
    """Build, and send the result, which is also returned, or the failure."""
    pipe = requests.pipe
    progress = _throttled_progress(pipe, ticket)

    def cancelled() -> bool:
        return requests.is_cancelled(ticket)

    try:
        built = build(job, progress=progress, cancelled=cancelled)
    except ParentExited:
        raise
    except Exception as error:
        _send_failure(pipe, ticket, error)
        return None
    pipe.send(("result", ticket, built))
    return built


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


def _send_failure(pipe: Connection, ticket: int, error: Exception) -> None:
    error = to_build_error(error)
    if not isinstance(error, BuildCancelled):
        log.info("build %d failed: %s", ticket, error)
    pipe.send(("failed", ticket, error.code, error.message, error.field, error.allowed))


if __name__ == "__main__":
    main()
