"""Number of threads that this process should use, and the speed of one core."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

THREADS_VARIABLE = "OCUFILTER_THREADS"
MAX_THREADS = 256

_CGROUP = Path("/sys/fs/cgroup")


@cache
def thread_count() -> int:
    """Return the number of usable cores, capped by the container's CPU quota.

    It is 1 in a process that `multiprocessing` started, such as a worker of a PyTorch
    `DataLoader`: as a rule, others run beside it, and several processes with a thread
    each need less processor time than one with several threads.  The environment
    variable ``OCUFILTER_THREADS`` overrides both.

    Raises
    ------
    ValueError
        The variable is not a number from 1 to 256.
    """
    wanted = os.environ.get(THREADS_VARIABLE, "")
    if wanted:
        if not wanted.isdecimal() or not 1 <= int(wanted) <= MAX_THREADS:
            raise ValueError(
                f"{THREADS_VARIABLE} is {wanted!r}; allowed: 1 to {MAX_THREADS}"
            )
        return int(wanted)
    if _is_child():
        return 1
    return max(1, min(_core_count(), _quota_cores(_CGROUP)))


def call_after_fork(function: Callable[[], object]) -> None:
    """Call a function in each forked process; Windows has no fork."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=function)


call_after_fork(thread_count.cache_clear)  # a child of `multiprocessing` has another


def _is_child() -> bool:
    """Return whether `multiprocessing`, which it then imports, started this process."""
    processes = sys.modules.get("multiprocessing.process")
    return processes is not None and processes.parent_process() is not None


def _core_count() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _quota_cores(folder: Path) -> int:
    """Return a control group's CPU quota in cores, rounded up; `MAX_THREADS` if none.

    Version 2 has ``cpu.max``: quota and period in microseconds, or ``max``.  Version 1
    has two files, with -1 for no quota.
    """
    try:
        quota, period = (folder / "cpu.max").read_text(encoding="utf-8").split()[:2]
    except (OSError, ValueError):
        try:
            old = folder / "cpu"
            quota = (old / "cpu.cfs_quota_us").read_text(encoding="utf-8").strip()
            period = (old / "cpu.cfs_period_us").read_text(encoding="utf-8").strip()
        except OSError:
            return MAX_THREADS
    if not (quota.isdecimal() and period.isdecimal() and int(period) > 0):
        return MAX_THREADS
    return max(1, math.ceil(int(quota) / int(period)))


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
    import numpy as np  # whoever counts threads needs no scientific stack
    from scipy import fft

    samples = np.exp(1j * np.arange(SIDE * SIDE).reshape(SIDE, SIDE))
    times_ms = []
    for _ in range(ROUNDS):
        started_s = time.perf_counter()
        fft.fft2(samples, workers=1)
        times_ms.append(1e3 * (time.perf_counter() - started_s))
    return min(times_ms) / MEASURED_PROBE_MS
