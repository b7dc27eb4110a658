"""Cuts the building of PSFs so that the GPU is held for a stated time at most.

A GPU works off what it was given before it turns to another process, so a frame waits
for whatever the builder has queued.  Here that is never more than some milliseconds: by
times measured on the go it is known how many PSFs of a kind fit in, and after so many
the builder waits until they are done.  One PSF is the least, however long it takes.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator

import numpy as np
from numpy.typing import NDArray

HOLD_S = 0.004
"""Of a batch of PSFs: half the time between two frames of a headset at 120 Hz."""

PLANNED_RATIO = 0.75
"""Of that: what is planned for, since PSFs of a kind are not all alike."""

PROBE_RATIO = 1 / 64
"""Of a chunk: the first batch of a kind whose time is not known."""

KEPT_HOLDS = 4096

LEARNT_RATIO = 0.5
"""How far a new measurement moves what is known: one that was disturbed counts less."""


class Pace:
    """How fast this device builds PSFs, and how much of it it has to do.

    Parameters
    ----------
    hold_s : float
        The longest that it may be held at a time.
    clock : callable
        Seconds.

    Attributes
    ----------
    holds_s : deque of float
        How long it was held by the last batches of kinds whose time was known.
    n_batches : int
    """

    def __init__(
        self,
        hold_s: float = HOLD_S,
        *,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.holds_s: deque[float] = deque(maxlen=KEPT_HOLDS)
        self.n_batches = 0
        self._hold_s = hold_s
        self._clock = clock
        self._rates: dict[Hashable, float] = {}  # seconds for a unit of work
        self._queued: dict[Hashable, float] = {}  # work of this batch
        self._since_s = 0.0

    def parts(
        self, kind: Hashable, works: NDArray, finish: Callable[[], None]
    ) -> Iterator[tuple[int, int]]:
        """Yield first and count of PSFs to queue next; waits where a batch is full.

        Parameters
        ----------
        kind : hashable
            Of passes that take the same time for a unit of work.
        works : (P,)
            Of each PSF, in units of which only the ratios matter.
        finish : callable
            Waits for all that is queued.
        """
        ends = np.cumsum(works, dtype=np.float64)
        first = 0
        while first < ends.size:
            is_known = kind in self._rates
            done = ends[first - 1] if first else 0.0
            room = self._room(kind) if is_known else PROBE_RATIO * ends[-1]
            count = int(np.searchsorted(ends, done + room, "right")) - first
            if self._queued and (count < 1 or not is_known):
                self.flush(finish)
                continue
            count = max(count, 1)
            if not self._queued:
                self._since_s = self._clock()
            yield first, count
            first += count
            work = float(ends[first - 1] - done)
            self._queued[kind] = self._queued.get(kind, 0.0) + work
            if not is_known:
                self.flush(finish)

    def flush(self, finish: Callable[[], None]) -> None:
        """Wait for what is queued, and learn how long it took."""
        if not self._queued:
            return
        finish()
        held_s = self._clock() - self._since_s
        works, self._queued = self._queued, {}
        self.n_batches += 1
        unknown = [kind for kind in works if kind not in self._rates]
        for kind in unknown:  # alone in its batch; shaders may have been compiled
            self._rates[kind] = held_s / works[kind]
        if unknown:
            return
        self.holds_s.append(held_s)
        ratio = held_s / sum(self._rates[kind] * work for kind, work in works.items())
        for kind in works:
            self._rates[kind] *= 1.0 + LEARNT_RATIO * (ratio - 1.0)

    def _room(self, kind: Hashable) -> float:
        """Return how much work of a kind still fits into this batch."""
        queued_s = sum(self._rates[k] * work for k, work in self._queued.items())
        return max(0.0, PLANNED_RATIO * self._hold_s - queued_s) / self._rates[kind]
