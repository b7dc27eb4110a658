"""A store on its way to the GPU, a slice at a time, so that frames go on meanwhile."""

from __future__ import annotations

import time
from collections.abc import Generator

from filter_service.rendering.engine import LoadedStore


class Upload:
    """One store that is being loaded.

    Parameters
    ----------
    steps : generator
        Of the renderer's ``load_steps``: None after each slice, in the end the loaded
        store.
    """

    def __init__(self, steps: Generator[LoadedStore | None]) -> None:
        self._steps = steps
        self.loaded: LoadedStore | None = None

    def advance(self, deadline_s: float) -> LoadedStore | None:
        """Copy slices until the time is over, one at least; return the loaded store.

        None where there is more to copy.

        Parameters
        ----------
        deadline_s : float
            Of ``time.monotonic()``.
        """
        while self.loaded is None:
            self.loaded = next(self._steps)
            if time.monotonic() >= deadline_s:
                break
        return self.loaded

    def give_up(self) -> None:
        """Free what has been copied."""
        self._steps.close()
        if self.loaded is not None:
            self.loaded.release()
