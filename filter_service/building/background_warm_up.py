"""Warm-up that runs in a thread before the first build."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from filter_service.errors import BuildCancelled

COMPILING_STAGE = "compiling"
QUIET_S = 1.0
"""Delay before the warm-up is reported; reading compiled code takes less."""

POLL_S = 0.1

Progress = Callable[[float, str], None]

log = logging.getLogger("ocufilter.worker")


class BackgroundWarmUp:
    """Runs a warm-up function in a thread; the first build waits for it.

    Failures are only logged; the build then does the remaining work.

    Parameters
    ----------
    work : callable
    """

    def __init__(self, work: Callable[[], None]):
        self._work = work
        self._done = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        late = threading.Timer(QUIET_S, self._log_reason)
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
    def _log_reason() -> None:
        log.info("compiling loops, which takes up to a minute; the result is cached")

    def wrap_progress(
        self, progress: Progress, cancelled: Callable[[], bool]
    ) -> Progress:
        """Return a ``progress`` function that first waits for the warm-up.

        A build that finds its result in the on-disk cache reports no progress, so it
        does not wait.
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
            If the build is canceled meanwhile.
        """
        if self._done.wait(QUIET_S):
            return
        while not self._done.wait(POLL_S):
            if cancelled():
                raise BuildCancelled("replaced by a newer profile")
            progress(0.0, COMPILING_STAGE)
