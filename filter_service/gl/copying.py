"""Multithreaded copies of large arrays: one core does not saturate the memory bus."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.threads import thread_count

MIN_PART_BYTES = 2 << 20
"""Smallest part per thread.  For frames of 1280x720 on the host of an H100, parts of
half the size took longer than a single thread."""

MAX_THREADS = 4
"""Two frames of 1832x1920, state unchanged, on a 16-core Xeon host of an H100: 16.0 ms
with one thread, 13.8 with two, 12.4 with four, 12.8 with six, 13.7 with eight."""


def copy_bytes(target: NDArray[np.uint8], source: NDArray[np.uint8]) -> None:
    """Copy bytes (n,), in several threads if there are many; wait for completion."""
    # Half of the cores; the others are for other streams.
    count = min(source.size // MIN_PART_BYTES, thread_count() // 2, MAX_THREADS)
    if count < 2:
        target[:] = source
        return
    first, *others = pairwise(source.size * k // count for k in range(count + 1))
    waiting = [
        _pool().submit(np.copyto, target[start:end], source[start:end])
        for start, end in others
    ]
    np.copyto(target[: first[1]], source[: first[1]])
    for part in waiting:
        part.result()


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MAX_THREADS - 1, thread_name_prefix="copy")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
