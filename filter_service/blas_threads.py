"""Limits the BLAS of NumPy to one thread for a while; see `one_blas_thread`.

A program that has imported NumPy cannot be limited by environment variables.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

OPENBLAS_NAMES = ("scipy_openblas_{}64_", "scipy_openblas_{}", "openblas_{}")
"""Names of OpenBLAS functions in NumPy's packages and in the system's library."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit NumPy's OpenBLAS to one thread; other libraries are not affected."""
    functions = _openblas()
    if functions is None:
        yield
        return
    get_count, set_count = functions
    count = get_count()
    set_count(1)
    try:
        yield
    finally:
        set_count(count)


@cache
def _openblas() -> tuple[Callable[[], int], Callable[[int], Any]] | None:
    """Return the functions that get and set the number of threads, if they exist."""
    from numpy.linalg import _umath_linalg

    library = ctypes.CDLL(_umath_linalg.__file__)  # which depends on the BLAS
    for name in OPENBLAS_NAMES:
        get, set_ = (name.format(f"{verb}_num_threads") for verb in ("get", "set"))
        if hasattr(library, get) and hasattr(library, set_):
            return getattr(library, get), getattr(library, set_)
    return None
