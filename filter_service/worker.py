"""The worker process: computes PSF stores and sends them back over a pipe.

A process, not a thread: OpenGL calls hold the interpreter lock of the render loop.

Parent to worker: ``("build", ticket, job)``, ``("cancel", ticket)``.  Worker to parent:
``("ready",)``, ``("progress", ticket, fraction, stage)``, ``("failed", ticket, code,
message, field, allowed)``, and ``("result", ticket, head, sizes)`` followed by the
arrays in chunks.  Chunks, because the render loop takes a few milliseconds' worth at a
time and never waits for 100 MB.  The pipe joins two processes of ours, so it may carry
pickles; nothing from outside does.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from filter_service.errors import BuildCancelled, BuildFailed, FilterError

CHUNK_BYTES = 64 * 1024  # what a socket pair holds, so a chunk is rarely waited for
PROGRESS_INTERVAL_S = 0.1

log = logging.getLogger("ocufilter.worker")


class ParentGone(Exception):
    """The service has ended; so does the worker."""


def worker_main(pipe: Connection, build: Callable[..., Any], niceness: int) -> None:
    """Build what is asked for until the pipe closes; the process's entry point."""
    # Ctrl-C goes to the whole group; the service ends the worker in its own time.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(niceness)
    logging.basicConfig(level=logging.INFO, format="ocufilter worker: %(message)s")
    try:
        pipe.send(("ready",))
        while True:
            message = pipe.recv()
            if message[0] == "build":
                _build_one(pipe, build, ticket=message[1], job=message[2])
    except (EOFError, OSError, ParentGone):
        return


def _build_one(
    pipe: Connection, build: Callable[..., Any], *, ticket: int, job: object
) -> None:
    try:
        built = build(
            job,
            progress=_throttled_progress(pipe, ticket),
            cancelled=lambda: _is_cancelled(pipe, ticket),
        )
    except ParentGone:
        raise
    except Exception as error:
        _send_failure(pipe, ticket, error)
        return
    _send_result(pipe, ticket, built)


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


def _send_result(pipe: Connection, ticket: int, built: object) -> None:
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(built, protocol=5, buffer_callback=buffers.append)
    arrays = [buffer.raw() for buffer in buffers]
    pipe.send(("result", ticket, head, [array.nbytes for array in arrays]))
    for array in arrays:
        for start in range(0, array.nbytes, CHUNK_BYTES):
            pipe.send_bytes(array[start : start + CHUNK_BYTES])
