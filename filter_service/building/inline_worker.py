"""Worker without a process, which builds when polled.

For programs that filter one image: starting a process takes longer than most builds.
"""

from __future__ import annotations

import logging
from collections import deque

from filter_service.building.jobs import BuildJob
from filter_service.building.worker_handle import (
    BuildDone,
    BuildError,
    BuildEvent,
    BuildProgress,
)
from filter_service.errors import BuildFailed, FilterError

log = logging.getLogger("ocufilter.worker")


class InlineWorker:
    """`WorkerHandle`'s interface in the calling thread."""

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
            if not isinstance(error, FilterError):
                log.exception("a build failed unexpectedly")
                error = BuildFailed(f"{type(error).__name__}: {error}")
            return [*events, BuildError(ticket, error)]
        return [*events, BuildDone(ticket, built)]
