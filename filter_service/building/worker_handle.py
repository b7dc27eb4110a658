"""Interface to the build worker: queues builds and recovers from crashes.

`InlineWorker` has the same interface, without a process.
"""

from __future__ import annotations

import atexit
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from estimator.threads import THREADS_VARIABLE, call_after_fork
from filter_service.building.jobs import (
    BuildDone,
    BuildError,
    BuildEvent,
    BuildJob,
    BuildPart,
    BuildProgress,
    to_build_error,
)
from filter_service.errors import (
    BuildCancelled,
    FilterError,
    WorkerCrashed,
    error_from_code,
)

if TYPE_CHECKING:
    from filter_service.view_state import State

RECEIVE_BUDGET_S = 0.004
"""Time limit of one call of `poll`, which delays frames."""

RESTART_DELAY_S = 1.0
"""Delay of a restart after a worker that never became ready."""

STOP_GRACE_S = 1.0
WATCH_INTERVAL_S = 0.5
STOPPED_LIMIT_S = 3.0
"""Time after which a worker stopped by a signal is killed."""

BUILD = "filter_service.building.from_profile:build"
NICENESS = 5

log = logging.getLogger("ocufilter.worker")


@dataclass
class _Worker:
    """A running process and the pipe to it.

    Attributes
    ----------
    started_as : tuple
        Command and environment.
    next_ticket : int
        Ticket after those that it knows, once it is kept.
    """

    process: subprocess.Popen[bytes]
    pipe: Connection
    started_as: tuple[list[str], dict[str, str]]
    is_killed: bool = False
    next_ticket: int = 1

    def kill(self) -> None:
        """Kill the process; it gets no more jobs."""
        self.process.kill()
        self.is_killed = True

    def end(self) -> None:
        """Terminate the process, and kill it after a grace period."""
        self.pipe.close()
        self.process.terminate()
        wait_or_kill(self.process, STOP_GRACE_S)


class _KeptProcess:
    """The process of the handle that was closed last, for the next one.

    A thread ends it after a while.
    """

    def __init__(self) -> None:
        self._worker: _Worker | None = None
        self._timer: threading.Timer | None = None
        self._lock = threading.Lock()

    def keep(self, worker: _Worker, keep_s: float) -> None:
        """Keep a process that has nothing to do; end the one that was kept before."""
        self.end()
        timer = threading.Timer(keep_s, self.end)
        timer.daemon = True
        with self._lock:
            self._worker, self._timer = worker, timer
        try:
            timer.start()
        except RuntimeError:  # the interpreter exits
            self.end()

    def taken(self, started_as: tuple[list[str], dict[str, str]]) -> _Worker | None:
        """Return the process if it was started with this command and environment."""
        with self._lock:
            found = self._worker
            if found is None or found.started_as != started_as:
                return None
            self._forget()
        if found.process.poll() is None:
            return found
        found.end()
        return None

    def end(self) -> None:
        """End the process, if there is one."""
        with self._lock:
            found = self._worker
            self._forget()
        if found is not None:
            found.end()

    def _forget(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._worker = self._timer = None

    def abandon(self) -> None:
        """Abandon the process in a forked process: it belongs to the parent."""
        self._parents = self._worker, self._timer  # so that nothing is freed
        self._worker, self._timer, self._lock = None, None, threading.Lock()


_kept = _KeptProcess()
atexit.register(_kept.end)
call_after_fork(_kept.abandon)


@dataclass
class WorkerHandle:
    """Runs builds in a separate process, one at a time, in the order of requests.

    Parameters
    ----------
    build : str
        ``module:function`` of ``build(job, *, progress, cancelled)``, which returns a
        `BuiltStore`; a name, because importing the function here would delay the start
        of the process.
    cancel_grace_s : float
        Time after which a canceled build that is still running is killed with its
        process.
    build_limit_s : float
        Time without progress after which a build is killed with its process.
    niceness : int
        Niceness of the process.  While a new eye is estimated on two busy cores, 91 to
        96 % of a stream's frames are complete with 0, and 95 to 98 % with 5; with 10,
        eyes that take long to estimate hardly ever finish.
    task : str
        Task of the process, for error messages.
    keep_s : float
        Time for which `close` keeps a process that has nothing to do, for the next
        handle in this process: a new one takes 0.4 s of processor time to start.
    """

    build: str = BUILD
    cancel_grace_s: float = 3.0
    build_limit_s: float = 600.0
    niceness: int = NICENESS
    task: str = "computes PSFs"
    keep_s: float = 0.0
    n_restarts: int = 0
    has_process: ClassVar[bool] = True
    _queue: deque[tuple[int, Any]] = field(default_factory=deque)
    _next_ticket: int = 1
    _running: int | None = None
    _kill_at_s: float | None = None
    _start_at_s: float = 0.0
    _is_ready: bool = False
    _worker: _Worker | None = None
    _advanced_s: float = 0.0
    _progress: BuildProgress | None = None
    _next_watch_s: float = 0.0
    _stopped_since_s: float | None = None

    def start(self) -> None:
        """Start the process if there is none, without waiting until it is ready."""
        if self._worker is not None:
            return
        command = [sys.executable, "-P", "-m", "filter_service.building.worker"]
        command += [self.build, str(self.niceness)]
        # A second thread saved no time, and delayed frames by 0.4 s.
        variables = os.environ | {
            "PYTHONPATH": os.pathsep.join(import_path()),
            THREADS_VARIABLE: "1",
        }
        started_as = command, variables
        self._worker = _kept.taken(started_as) if self.keep_s else None
        if self._worker is not None:
            self._is_ready, self._next_ticket = True, self._worker.next_ticket
            return
        ours, theirs = socket.socketpair()
        for end_of_pipe in (ours, theirs):  # PsychoPy sets a default timeout
            end_of_pipe.setblocking(True)
        # A plain subprocess: multiprocessing's spawn would run the main module again,
        # which fails in scripts without a __main__ guard.  Without -P, files in the
        # current folder would shadow modules of the same name.
        process = subprocess.Popen(
            [*command, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=variables,
        )
        theirs.close()
        self._worker = _Worker(process, Connection(ours.detach()), started_as)

    def close(self) -> None:
        """End the process, or keep it for a while if it has nothing to do."""
        worker = self._worker
        if worker is None:
            return
        if self.keep_s and self._is_ready and not (self.is_busy or worker.is_killed):
            worker.next_ticket = self._next_ticket
            self._send(("forget", 0))  # what it has built
            _kept.keep(worker, self.keep_s)
        else:
            worker.end()
        self._worker, self._is_ready = None, False

    @property
    def file_descriptor(self) -> int | None:
        """Return the descriptor to poll for reading; it changes with a restart."""
        return None if self._worker is None else self._worker.pipe.fileno()

    @property
    def is_busy(self) -> bool:
        """Return whether a build is running or queued."""
        return self._running is not None or bool(self._queue)

    @property
    def needs_poll(self) -> bool:
        """Return whether `poll` has work to do even if the pipe is silent."""
        return self._worker is None or self._kill_at_s is not None

    def submit(self, job: Any) -> int:
        """Queue a job, the argument of ``build``; return its ticket."""
        ticket = self._next_ticket
        self._next_ticket += 1
        self._queue.append((ticket, job))
        self._start_next()
        return ticket

    def cancel(self, ticket: int) -> None:
        """Cancel a build; a build that was still queued causes no event."""
        self._queue = deque(item for item in self._queue if item[0] != ticket)
        if ticket == self._running and self._kill_at_s is None:
            self._kill_at_s = time.monotonic() + self.cancel_grace_s
            self._send(("cancel", ticket))

    def plan_near(self, ticket: int, state: State) -> None:
        """Ask for the nodes near a state of a built store, as `BuildPart` events."""
        self._send(("near", ticket, state))

    def poll(self) -> list[BuildEvent]:
        """Return new events, within a few milliseconds."""
        events: list[BuildEvent] = []
        now_s = time.monotonic()
        worker = self._worker
        if worker is None:
            if now_s >= self._start_at_s:
                self.start()
            return events
        try:
            while worker.pipe.poll(0):
                self._receive(worker.pipe, events)
                if time.monotonic() - now_s > RECEIVE_BUDGET_S:
                    break
        except (EOFError, OSError, pickle.UnpicklingError):
            events += self._recover(worker)
        else:
            self._watch(worker, now_s)
        self._start_next()
        return events

    def _watch(self, worker: _Worker, now_s: float) -> None:
        """Kill a worker that a signal has stopped, or whose build does not end.

        Messages were read before: nobody may have polled since the build has ended.
        """
        if self._kill_at_s is not None and now_s > self._kill_at_s:
            log.warning("a canceled build did not stop; killing its process")
            worker.kill()
        if now_s < self._next_watch_s:
            return
        self._next_watch_s = now_s + WATCH_INTERVAL_S
        if self._running is not None and now_s - self._advanced_s > self.build_limit_s:
            log.error(
                "a build has not advanced for %g s; killing its process",
                self.build_limit_s,
            )
            worker.kill()
        if not is_stopped(worker.process.pid):
            self._stopped_since_s = None
        elif self._stopped_since_s is None:
            self._stopped_since_s = now_s
        elif now_s - self._stopped_since_s > STOPPED_LIMIT_S:
            log.error("the build worker does not respond; killing it")
            worker.kill()

    def _receive(self, pipe: Connection, events: list[BuildEvent]) -> None:
        message = pipe.recv()
        kind = message[0]
        if kind == "ready":
            self._is_ready = True
        elif kind == "progress":
            progress = BuildProgress(*message[1:])
            if progress != self._progress:
                self._progress, self._advanced_s = progress, time.monotonic()
            events.append(progress)
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
        """Send the next job, unless the worker is busy or not yet ready."""
        worker = self._worker
        if worker is None or worker.is_killed:
            return
        if self._running is None and self._is_ready and self._queue:
            ticket, job = self._queue.popleft()
            self._running = ticket
            self._advanced_s = time.monotonic()
            self._send(("build", ticket, job))

    def _send(self, message: tuple[Any, ...]) -> None:
        if self._worker is None:
            return  # closed
        try:
            self._worker.pipe.send(message)
        except OSError:
            log.debug("the worker exited; poll will report it")

    def _recover(self, worker: _Worker) -> list[BuildEvent]:
        """Start a new process; report the running build as failed, keep queued ones."""
        how = describe_exit(wait_or_kill(worker.process, STOP_GRACE_S))
        was_cancelled = self._kill_at_s is not None
        was_ready = self._is_ready
        tickets = [] if self._running is None else [self._running]
        self._worker = None
        self._is_ready = False
        self._end_running()
        self.n_restarts += 1
        if was_cancelled:
            error: FilterError = BuildCancelled("the build was terminated")
        else:
            error = WorkerCrashed(f"the process that {self.task} {how}")
            log.error("%s; starting a new one", error.message)
        if not was_ready:
            # The cause was not a job; queued ones would wait forever.
            tickets += [ticket for ticket, _ in self._queue]
            self._queue.clear()
            self._start_at_s = time.monotonic() + RESTART_DELAY_S
        else:
            self.start()
        # After the start: under the same number, selectors would miss the new pipe.
        worker.pipe.close()
        return [BuildError(ticket, error) for ticket in tickets]


class InlineWorker:
    """`WorkerHandle`'s interface in the calling thread, which builds when polled.

    For programs that filter one image: starting a process takes longer than a build.
    """

    has_process = False
    file_descriptor = None
    is_busy = False
    needs_poll = False
    n_restarts = 0

    def __init__(self) -> None:
        self._queue: deque[tuple[int, BuildJob]] = deque()
        self._next_ticket = 1

    def start(self) -> None:
        """Do nothing: there is no process."""

    def close(self) -> None:
        """Discard queued jobs."""
        self._queue.clear()

    def submit(self, job: BuildJob) -> int:
        """Queue a job; return its ticket."""
        ticket = self._next_ticket
        self._next_ticket += 1
        self._queue.append((ticket, job))
        return ticket

    def cancel(self, ticket: int) -> None:
        """Remove a queued job."""
        self._queue = deque(item for item in self._queue if item[0] != ticket)

    def plan_near(self, ticket: int, state: State) -> None:
        """Do nothing: frames plan the nodes that they need."""

    def poll(self) -> list[BuildEvent]:
        """Run the first queued job and return its events."""
        from filter_service.building.from_profile import build

        if not self._queue:
            return []
        ticket, job = self._queue.popleft()
        events: list[BuildEvent] = []

        def progress(fraction: float, stage: str) -> None:
            events.append(BuildProgress(ticket, fraction, stage))

        try:
            built = build(job, progress=progress, cancelled=lambda: False)
        except Exception as error:
            return [*events, BuildError(ticket, to_build_error(error))]
        return [*events, BuildDone(ticket, built)]


def import_path() -> list[str]:
    """Return the import path of this process, for PYTHONPATH."""
    return [entry or os.getcwd() for entry in sys.path if isinstance(entry, str)]


def wait_or_kill(process: subprocess.Popen[bytes], timeout_s: float) -> int:
    """Wait for a process to end, and kill it after a timeout; return its exit code."""
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def describe_exit(exit_code: int) -> str:
    """Describe an exit code, as in "exited with code 1"."""
    if exit_code >= 0:
        return f"exited with code {exit_code}"
    try:
        return f"was killed by {signal.Signals(-exit_code).name}"
    except ValueError:
        return f"was killed by signal {-exit_code}"


def is_stopped(pid: int) -> bool:
    """Return whether a process is stopped by a signal (Linux only; otherwise False)."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (OSError, IndexError):
        return False
    return state == "T"
