"""Warm-up work that a process starts before the first request that needs it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from filter_service.errors import BuildCancelled

COMPILING_STAGE = "compiling"
QUIET_S = 1.0
"""Time without a report; reading compiled code takes less."""

POLL_S = 0.1

Progress = Callable[[float, str], None]

log = logging.getLogger("ocufilter.worker")


class BackgroundWarmUp:
    """Warm-up call that runs in a thread, and for which the first build waits.

    Failures are only logged; the build then does the remaining work.
    """

    def __init__(self, work: Callable[[], None]):
        self._work = work
        self._done = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        late = threading.Timer(QUIET_S, self._say_why)
        late.daemon = True
        late.start()
        try:
            self._work()
        except Exception:
            log.exception("the warm-up for builds failed")
        finally:
            late.cancel()
            self._done.set()

    @staticmethod
    def _say_why() -> None:
        log.info("compiling, which takes up to a minute; the result is cached")

    def before(self, progress: Progress, cancelled: Callable[[], bool]) -> Progress:
        """Return a ``progress`` function that first waits for the warm-up.

        A build that is read from the disk reports no progress, so it does not wait.
        """

        def waited(fraction: float, stage: str) -> None:
            self.wait(progress, cancelled)
            progress(fraction, stage)

        return waited

    def wait(self, progress: Progress, cancelled: Callable[[], bool]) -> None:
        """Wait for the warm-up, and report progress if that takes long.

        Raises
        ------
        BuildCancelled
        """
        if self._done.wait(QUIET_S):
            return
        while not self._done.wait(POLL_S):
            if cancelled():
                raise BuildCancelled("replaced by a newer profile")
            progress(0.0, COMPILING_STAGE)
