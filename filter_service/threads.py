"""Check of numba's threading layer.

Without OpenMP (libgomp1) or TBB, numba falls back to its work queue, which aborts the
process when two threads start parallel kernels at the same time.
"""

import numba
from numba import njit, prange, threading_layer

from filter_service.errors import RenderFailed

UNSAFE_THREADING_LAYER = "workqueue"


@njit(parallel=True, cache=True)
def _count(n: int) -> int:
    total = 0
    for _ in prange(n):
        total += 1
    return total


def require_safe_threading_layer() -> str:
    """Start numba's threads and return the name of the threading layer.

    Raises
    ------
    RenderFailed
        If only the work queue is available; the message says what to install.
    """
    numba.config.THREADING_LAYER = "threadsafe"
    try:
        _count(8)
    except ValueError as error:
        raise RenderFailed(
            "numba has no thread-safe threading layer; "
            "install libgomp1 (apt-get install libgomp1) or tbb (pip install tbb)"
        ) from error
    return str(threading_layer())
