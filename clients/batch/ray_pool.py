"""Workers on many machines with Ray, which share the input and output folders."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, cast

import ray

from clients.batch.job import Job
from clients.batch.process_pool import MAX_DEATHS, THREADS_VARIABLE
from clients.batch.work import Record, Unit, UnitRunner, failed_records

LOCAL = "local"


@ray.remote
class _RayWorker:
    """Ray actor that runs units."""

    def __init__(self, job: Job, out: Path) -> None:
        self._runner = UnitRunner(job, out)

    def run(self, unit: Unit) -> list[Record]:
        """Run a unit, which writes its files, and return its records."""
        return list(self._runner.run(unit))


class RayPool:
    """Pool of Ray actors that run units.

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
        self._setup = job, out
        self._address, self._n_workers = address, n_workers
        self._n_threads = n_threads

    def run(self, units: Sequence[Unit]) -> Generator[Record, None, None]:
        """Yield the records of units as units are finished, in any order."""
        if not units:
            return
        started = not ray.is_initialized()
        if started:
            ray.init(
                address=None if self._address == LOCAL else self._address,
                num_cpus=self._own_cores(),
                include_dashboard=False if self._address == LOCAL else None,
                log_to_driver=False,
            )
        try:
            with redirect_stdout(sys.stderr):  # Ray prints messages about dead workers
                yield from self._run(deque((unit, 0) for unit in units))
        finally:
            if started:
                ray.shutdown()

    def _own_cores(self) -> int | None:
        if self._address != LOCAL or self._n_workers is None:
            return None
        return self._n_workers * self._n_threads

    def _run(self, waiting: deque[tuple[Unit, int]]) -> Iterator[Record]:
        cores = int(ray.cluster_resources().get("CPU", 1))
        wanted = self._n_workers or max(1, cores // self._n_threads)
        running: dict[Any, tuple[Any, Unit, int]] = {}
        for _ in range(min(wanted, len(waiting))):
            self._begin(self._worker(), waiting, running)
        while running:
            (ended,), _ = ray.wait(list(running))
            worker, unit, n_deaths = running.pop(ended)
            try:
                yield from ray.get(ended)
            except ray.exceptions.RayActorError as error:
                if n_deaths + 1 < MAX_DEATHS:
                    waiting.appendleft((unit, n_deaths + 1))
                else:
                    names = [frame.name for frame in unit.frames]
                    reason = f"its worker process died {MAX_DEATHS} times: {error}"
                    yield from failed_records(unit, names, reason)
                worker = self._worker() if waiting else None
            if waiting:
                self._begin(worker, waiting, running)

    def _worker(self) -> Any:
        variables = {"env_vars": {THREADS_VARIABLE: str(self._n_threads)}}
        options = {"num_cpus": self._n_threads, "runtime_env": variables}
        return cast(Any, _RayWorker).options(**options).remote(*self._setup)

    def _begin(
        self,
        worker: Any,
        waiting: deque[tuple[Unit, int]],
        running: dict[Any, tuple[Any, Unit, int]],
    ) -> None:
        unit, n_deaths = waiting.popleft()
        running[worker.run.remote(unit)] = worker, unit, n_deaths
