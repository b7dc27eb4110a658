"""Workers on this machine, of which those that die are replaced, or on many with Ray.

    python -m clients.batch.pools DESCRIPTOR

runs a worker, which receives units through a pipe and returns records.  It exits when
the pipe closes: between two frames, or after `GRACE_S` in the midst of one.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, cast

from clients.batch.manifest import Record
from clients.batch.work import (
    EngineUnusable,
    Job,
    Unit,
    UnitRunner,
    failed_records,
)
from filter_service.waiting import PROGRESS_VARIABLE

THREADS_VARIABLE = "OCUFILTER_THREADS"
MAX_DEATHS = 2
"""Worker deaths at the same frame, after which the frame is considered the cause."""

END_LIMIT_S = 5.0
GRACE_S = 1.0
"""Time to finish a frame after the pipe has closed.  A batch that resumes a killed one
waits longer for the lock, which the workers hold."""

LOCAL = "local"


@dataclass(eq=False)
class _Worker:
    """A worker process, its pipe and its current work."""

    process: subprocess.Popen[bytes]
    pipe: Connection
    unit: Unit | None = None
    pending: list[str] = field(default_factory=list)


class ProcessPool:
    """Pool of processes that run units, each with a given number of engine threads.

    Parameters
    ----------
    job : Job
        Parameters of the batch.
    out : Path
        Output folder.
    n_workers, n_threads : int
        Number of processes, and of engine threads in each.
    lock : int, optional
        Descriptor that the workers inherit: the folder stays locked until they exit,
        even if this process is killed.
    """

    def __init__(
        self,
        job: Job,
        out: Path,
        *,
        n_workers: int,
        n_threads: int,
        lock: int | None = None,
    ) -> None:
        self._setup = job, out
        self._locks = () if lock is None else (lock,)
        self._n_workers, self._n_threads = n_workers, n_threads
        self._workers: list[_Worker] = []
        self._deaths: Counter[tuple[str, str]] = Counter()

    def run(self, units: Sequence[Unit]) -> Generator[Record, None, None]:
        """Yield the records of units as frames are finished, in any order.

        Raises
        ------
        EngineUnusable
            If the engine does not work on this machine.
        """
        waiting = deque(units)
        try:
            while True:
                self._assign(waiting)
                busy = {w.pipe: w for w in self._workers if w.unit is not None}
                if not busy:
                    return
                for pipe in wait(list(busy)):
                    yield from self._receive(busy[cast(Connection, pipe)], waiting)
        finally:
            self.close()

    def close(self) -> None:
        """Stop the workers; kill them after `END_LIMIT_S`."""
        for worker in self._workers:
            worker.pipe.close()
        for worker in self._workers:
            try:
                worker.process.wait(END_LIMIT_S)
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()
        self._workers = []

    def _assign(self, waiting: deque[Unit]) -> None:
        while waiting:
            worker = next((w for w in self._workers if w.unit is None), None)
            if worker is None:
                if len(self._workers) == self._n_workers:
                    return
                worker = self._start()
            unit = waiting.popleft()
            worker.unit, worker.pending = unit, [frame.name for frame in unit.frames]
            try:
                worker.pipe.send(unit)
            except OSError:  # it has died, which the next read reports
                return

    def _start(self) -> _Worker:
        ours, theirs = socket.socketpair()
        descriptor = str(theirs.fileno())
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "clients.batch.pools", descriptor],
            pass_fds=[theirs.fileno(), *self._locks],
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches only this process, which stops it
            env={
                **os.environ,
                THREADS_VARIABLE: str(self._n_threads),
                PROGRESS_VARIABLE: "0",  # this process reports it
                "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path),
            },
        )
        theirs.close()
        worker = _Worker(process, Connection(ours.detach()))
        worker.pipe.send(self._setup)
        self._workers.append(worker)
        return worker

    def _receive(self, worker: _Worker, waiting: deque[Unit]) -> Iterator[Record]:
        try:
            kind, content = worker.pipe.recv()
        except (EOFError, OSError):
            yield from self._after_death(worker, waiting)
            return
        if kind == "unusable":
            raise EngineUnusable(content)
        if kind == "record":
            worker.pending.remove(content["frame"])
            yield content
        else:
            worker.unit, worker.pending = None, []

    def _after_death(self, worker: _Worker, waiting: deque[Unit]) -> Iterator[Record]:
        """Queue the rest of a unit; fail a frame that repeatedly kills workers."""
        worker.pipe.close()
        how = _how_it_ended(worker.process.wait())
        self._workers.remove(worker)
        unit, pending = worker.unit, worker.pending
        if unit is None or not pending:
            return
        key = unit.profile, pending[0]
        self._deaths[key] += 1
        if self._deaths[key] >= MAX_DEATHS:
            # A segment fails with all of its frames.
            names = pending if unit.segment is not None else pending[:1]
            reason = f"its worker process {how}, {MAX_DEATHS} times"
            yield from failed_records(unit, names, reason)
            pending = pending[len(names) :]
        if pending:
            rest = tuple(frame for frame in unit.frames if frame.name in pending)
            waiting.appendleft(Unit(unit.number, unit.profile, rest, unit.segment))


def _how_it_ended(code: int) -> str:
    if code >= 0:
        return f"ended with code {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"


def serve(descriptor: int) -> None:
    """Run the units that arrive through a pipe until it closes."""
    pipe = Connection(descriptor)
    threading.Thread(target=_exit_after, args=(descriptor,), daemon=True).start()
    try:
        runner = UnitRunner(*pipe.recv())
        while True:
            unit = pipe.recv()
            # While a unit runs, nothing is sent: a readable pipe has been closed.
            for record in runner.run(unit, lambda: not pipe.poll()):
                pipe.send(("record", record))
            pipe.send(("done", unit.number))
    except EngineUnusable as error:
        pipe.send(("unusable", str(error)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _exit_after(descriptor: int) -> None:
    """Exit soon after the other end of a pipe is closed, whatever this process does."""
    closed = select.poll()
    closed.register(descriptor, 0)  # reports only that the other end is closed
    closed.poll()
    time.sleep(GRACE_S)
    os._exit(1)


class _RayWorker(UnitRunner):
    """Ray actor that runs units."""

    def run_whole(self, unit: Unit) -> list[Record]:
        """Run a unit, which writes its files, and return its records."""
        return list(self.run(unit))


class RayPool:
    """Pool of Ray actors on many machines, which share the input and output folders.

    Parameters
    ----------
    job : Job
        Parameters of the batch.
    out : Path
        Output folder.
    address : str
        Address of the cluster; ``auto`` for Ray's default, or ``local`` for a new
        cluster on this machine.
    n_workers : int, optional
        Number of actors; by default, as many as the cluster has cores for.
    n_threads : int
        Threads of each actor, and cores that it requests.
    """

    def __init__(
        self,
        job: Job,
        out: Path,
        *,
        address: str,
        n_workers: int | None,
        n_threads: int,
    ) -> None:
        import ray

        self._ray: Any = ray
        self._setup = job, out
        self._address, self._n_workers = address, n_workers
        self._n_threads = n_threads

    def run(self, units: Sequence[Unit]) -> Generator[Record, None, None]:
        """Yield the records of units as units are finished, in any order."""
        if not units:
            return
        is_local = self._address == LOCAL
        own_cores = None
        if is_local and self._n_workers is not None:
            own_cores = self._n_workers * self._n_threads
        started = not self._ray.is_initialized()
        if started:
            self._ray.init(
                address=None if is_local else self._address,
                num_cpus=own_cores,
                include_dashboard=False if is_local else None,
                log_to_driver=False,
            )
        try:
            with redirect_stdout(sys.stderr):  # Ray prints messages about dead workers
                yield from self._run(deque((unit, 0) for unit in units))
        finally:
            if started:
                self._ray.shutdown()

    def _run(self, waiting: deque[tuple[Unit, int]]) -> Iterator[Record]:
        cores = int(self._ray.cluster_resources().get("CPU", 1))
        wanted = self._n_workers or max(1, cores // self._n_threads)
        actor = self._ray.remote(_RayWorker).options(
            num_cpus=self._n_threads,
            runtime_env={"env_vars": {THREADS_VARIABLE: str(self._n_threads)}},
        )
        running: dict[Any, tuple[Any, Unit, int]] = {}

        def begin(worker: Any) -> None:
            unit, n_deaths = waiting.popleft()
            running[worker.run_whole.remote(unit)] = worker, unit, n_deaths

        for _ in range(min(wanted, len(waiting))):
            begin(actor.remote(*self._setup))
        while running:
            (ended,), _ = self._ray.wait(list(running))
            worker, unit, n_deaths = running.pop(ended)
            try:
                yield from self._ray.get(ended)
            except self._ray.exceptions.RayActorError as error:
                if n_deaths + 1 < MAX_DEATHS:
                    waiting.appendleft((unit, n_deaths + 1))
                else:
                    names = [frame.name for frame in unit.frames]
                    reason = f"its worker process died {MAX_DEATHS} times: {error}"
                    yield from failed_records(unit, names, reason)
                worker = actor.remote(*self._setup) if waiting else None
            if waiting:
                begin(worker)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
