"""Speed of one core relative to the machine on which costs were measured."""

from __future__ import annotations

import time
from functools import cache

import numpy as np
from scipy import fft

SIDE = 192
ROUNDS = 12

MEASURED_PROBE_MS = 0.28
"""Time of the probe on the machine of the cost constants, an AMD EPYC."""


@cache
def relative_core_time() -> float:
    """Return the time of one core relative to the machine of the cost constants.

    The probe is the fastest of a dozen Fourier transforms, the most common work of a
    PSF, on the calling thread.  It takes 5 ms, once per process.
    """
    samples = np.exp(1j * np.arange(SIDE * SIDE).reshape(SIDE, SIDE))
    times_ms = []
    for _ in range(ROUNDS):
        started_s = time.perf_counter()
        fft.fft2(samples, workers=1)
        times_ms.append(1e3 * (time.perf_counter() - started_s))
    return min(times_ms) / MEASURED_PROBE_MS
