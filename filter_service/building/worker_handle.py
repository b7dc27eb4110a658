"""The service's end of the worker: a queue of builds, one running, crashes repaired."""

from __future__ import annotations

import logging
import os
import pickle
import socket
import subprocess
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from estimator.threads import THREADS_VARIABLE
from filter_service.building.helper_process import (
    end,
    how_it_ended,
    import_path,
    is_stopped,
)
from filter_service.building.jobs import BuildJob, BuiltStore
from filter_service.errors import (
    BuildCancelled,
    FilterError,
    WorkerCrashed,
    error_from_code,
)

RECEIVE_BUDGET_S = 0.004  # the render loop's time for one call of poll
RESTART_DELAY_S = 1.0  # after a worker that never got ready
STOP_GRACE_S = 1.0
WATCH_INTERVAL_S = 0.5
STOPPED_LIMIT_S = 3.0
"""Stopped by a signal for longer, a worker is taken for one that stays so."""

BUILD = "filter_service.building.from_profile:build"
WARM_UP = "filter_service.building.compile_builds:build_a_few_with_help"
NICENESS = 5

log = logging.getLogger("ocufilter.worker")


@dataclass(frozen=True)
class BuildProgress:
    """How far a build is."""

    ticket: int
    fraction: float
    stage: str


@dataclass(frozen=True)
class BuildDone:
    """What a build made."""

    ticket: int
    built: BuiltStore


@dataclass(frozen=True)
class BuildPart:
    """What frames will need of the store that a build has made."""

    ticket: int
    part: Any


@dataclass(frozen=True)
class BuildError:
    """Why a build made nothing."""

    ticket: int
    error: FilterError


BuildEvent = BuildProgress | BuildDone | BuildPart | BuildError


@dataclass(frozen=True)
class _Worker:
    """A process and the pipe to it: there are both or neither."""

    process: subprocess.Popen[bytes]
    pipe: Connection


@dataclass
class WorkerHandle:
    """Runs builds in a process of its own, one at a time, in the order asked for.

    Parameters
    ----------
    build : str
        ``module:function`` of ``build(job, *, progress, cancelled)``, which returns a
        `BuiltStore`.  A name, because to import the function here would keep the new
        process waiting.
    cancel_grace_s : float
        A cancelled build that goes on longer is ended with its process.
    build_limit_s : float
        A build that takes longer is ended with its process.
    warm_up : str
        ``module:function`` of what the process does until the first job comes.
    niceness : int
        Of the process.  While a new eye is estimated on two busy cores, 0 and 5 make
        91 to 96 and 95 to 98 % of a stream's frames whole; with 10, eyes that take long
        to estimate hardly come.
    """

    build: str = BUILD
    cancel_grace_s: float = 3.0
    build_limit_s: float = 600.0
    warm_up: str = WARM_UP
    niceness: int = NICENESS
    n_restarts: int = 0
    _queue: deque[tuple[int, BuildJob]] = field(default_factory=deque)
    _next_ticket: int = 1
    _running: int | None = None
    _kill_at_s: float | None = None
    _start_at_s: float = 0.0
    _is_ready: bool = False
    _worker: _Worker | None = None
    _began_s: float = 0.0
    _next_watch_s: float = 0.0
    _stopped_since_s: float | None = None

    def start(self) -> None:
        """Start the process, if there is none; it gets ready on its own time."""
        if self._worker is not None:
            return
        ours, theirs = socket.socketpair()
        # A plain process: one that multiprocessing spawns would run the main module
        # again, which a script without a guard does not survive.  Without -P a file
        # of the current folder would come before every module of its name.
        process = subprocess.Popen(
            [
                *(sys.executable, "-P", "-m", "filter_service.building.worker"),
                *(str(theirs.fileno()), self.build, str(self.niceness), self.warm_up),
            ],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            # One thread: a second one saved no time, and took 0.4 s from the frames.
            env=os.environ
            | {"PYTHONPATH": os.pathsep.join(import_path()), THREADS_VARIABLE: "1"},
        )
        theirs.close()
        self._worker = _Worker(process, Connection(ours.detach()))

    def close(self) -> None:
        """End the process, with patience first."""
        if self._worker is None:
            return
        self._worker.pipe.close()
        self._worker.process.terminate()
        end(self._worker.process, STOP_GRACE_S)
        self._worker = None

    @property
    def file_descriptor(self) -> int | None:
        """Return what to poll for reading; it changes when the worker restarts."""
        return None if self._worker is None else self._worker.pipe.fileno()

    @property
    def is_busy(self) -> bool:
        """Return whether a build runs or waits."""
        return self._running is not None or bool(self._queue)

    @property
    def needs_attention_soon(self) -> bool:
        """Return whether poll has something to do although the pipe is silent."""
        return self._worker is None or self._kill_at_s is not None

    def submit(self, job: BuildJob) -> int:
        """Put a job at the end of the queue; return its ticket."""
        ticket = self._next_ticket
        self._next_ticket += 1
        self._queue.append((ticket, job))
        self._start_next()
        return ticket

    def cancel(self, ticket: int) -> None:
        """Stop a build; no event follows for a ticket that only waited."""
        self._queue = deque(item for item in self._queue if item[0] != ticket)
        if ticket == self._running and self._kill_at_s is None:
            self._kill_at_s = time.monotonic() + self.cancel_grace_s
            self._tell(("cancel", ticket))

    def poll(self) -> list[BuildEvent]:
        """Return what happened, in at most a few milliseconds."""
        events: list[BuildEvent] = []
        now_s = time.monotonic()
        worker = self._worker
        if worker is None:
            if now_s >= self._start_at_s:
                self.start()
            return events
        if self._kill_at_s is not None and now_s > self._kill_at_s:
            log.warning("a cancelled build did not stop; its process is ended")
            worker.process.kill()
        self._watch(worker, now_s)
        try:
            while worker.pipe.poll(0):
                self._receive(worker.pipe, events)
                if time.monotonic() - now_s > RECEIVE_BUDGET_S:
                    break
        except (EOFError, OSError, pickle.UnpicklingError):
            events += self._after_crash(worker)
        self._start_next()
        return events

    def _watch(self, worker: _Worker, now_s: float) -> None:
        """End a worker that stands still, or whose build has no end."""
        if now_s < self._next_watch_s:
            return
        self._next_watch_s = now_s + WATCH_INTERVAL_S
        if self._running is not None and now_s - self._began_s > self.build_limit_s:
            log.error("a build took longer than %g s; it is ended", self.build_limit_s)
            worker.process.kill()
        if not is_stopped(worker.process.pid):
            self._stopped_since_s = None
        elif self._stopped_since_s is None:
            self._stopped_since_s = now_s
        elif now_s - self._stopped_since_s > STOPPED_LIMIT_S:
            log.error("the process that computes PSFs stands still; it is ended")
            worker.process.kill()

    def _receive(self, pipe: Connection, events: list[BuildEvent]) -> None:
        message = pipe.recv()
        kind = message[0]
        if kind == "ready":
            self._is_ready = True
        elif kind == "progress":
            events.append(BuildProgress(*message[1:]))
        elif kind == "failed":
            ticket, code, text, at_field, allowed = message[1:]
            error = error_from_code(code, text, field=at_field, allowed=allowed)
            self._end_running()
            events.append(BuildError(ticket, error))
        elif kind == "result":
            self._end_running()
            events.append(BuildDone(*message[1:]))
        elif kind == "part":
            events.append(BuildPart(*message[1:]))

    def _end_running(self) -> None:
        self._running = None
        self._kill_at_s = None

    def _start_next(self) -> None:
        """Hand the next job over; a worker that starts up would not read it yet."""
        if self._running is None and self._is_ready and self._queue:
            ticket, job = self._queue.popleft()
            self._running = ticket
            self._began_s = time.monotonic()
            self._tell(("build", ticket, job))

    def _tell(self, message: tuple[Any, ...]) -> None:
        if self._worker is None:
            return  # closed: nobody will read it
        try:
            self._worker.pipe.send(message)
        except OSError:
            log.debug("the worker is gone; poll will find out")

    def _after_crash(self, worker: _Worker) -> list[BuildEvent]:
        """Start a new process; the build that ran is lost, those that wait are not."""
        how = how_it_ended(end(worker.process, STOP_GRACE_S))
        was_cancelled = self._kill_at_s is not None
        was_ready = self._is_ready
        tickets = [] if self._running is None else [self._running]
        worker.pipe.close()
        self._worker = None
        self._is_ready = False
        self._end_running()
        self.n_restarts += 1
        if was_cancelled:
            error: FilterError = BuildCancelled("the build was stopped by force")
        else:
            error = WorkerCrashed(f"the process that computes PSFs {how}")
            log.error("%s; a new one is started", error.message)
        if not was_ready:
            # No job was the reason, so those that wait would wait for ever.
            tickets += [ticket for ticket, _ in self._queue]
            self._queue.clear()
            self._start_at_s = time.monotonic() + RESTART_DELAY_S
        else:
            self.start()
        return [BuildError(ticket, error) for ticket in tickets]
