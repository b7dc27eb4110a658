"""Copies of large images by several threads: one core does not fill the bus."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.threads import thread_count

PART_BYTES = 2 << 20
"""Least that a thread is woken for: beside an H100, parts of half as much took longer
than one thread, of a frame of 1280x720."""

MOST_THREADS = 4
"""Two frames of 1832x1920, state unchanged, on a Xeon of 16 cores beside an H100: 16.0
ms with one thread, 13.8 with two, 12.4 with four, 12.8 with six, 13.7 with eight."""


def copy_bytes(target: NDArray[np.uint8], source: NDArray[np.uint8]) -> None:
    """Copy bytes (n,), in parts side by side where there are many; waits for all."""
    # Half of the cores: the others have streams of their own.
    count = min(source.size // PART_BYTES, thread_count() // 2, MOST_THREADS)
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
    return ThreadPoolExecutor(MOST_THREADS - 1, thread_name_prefix="copy")


os.register_at_fork(after_in_child=_pool.cache_clear)  # no thread goes along
