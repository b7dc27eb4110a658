"""Python interface of the compiled library."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import RenderFailed
from filter_service.native import records

FOLDER = Path(__file__).parent
FILE = "_loops.so"
LIBRARY_VARIABLE = "OCUFILTER_NATIVE_LIBRARY"
VARIANT_VARIABLE = "OCUFILTER_NATIVE_VARIANT"
VARIANTS = ("auto", "portable")
Between = ctypes.CFUNCTYPE(None)

STAGES = ("pixels", "merge", "place", "blend", "splat")

REMEDY = (
    "install a C compiler (apt-get install gcc libc6-dev) and the package again "
    "(with pip's --no-cache-dir --force-reinstall), or choose the engine gl"
)


class Library:
    """Compiled loops of `source/`, one function per stage.

    Calls release the GIL, so that other threads continue while a frame is rendered.

    Parameters
    ----------
    path : Path
        Path of the shared library.
    portable : bool
        Do not use optional processor features.

    Raises
    ------
    RenderFailed
        If the library cannot be loaded, or is of another version of this package.
    """

    def __init__(self, path: Path, *, portable: bool = False):
        try:
            self._c = ctypes.CDLL(str(path))
        except OSError as error:
            raise RenderFailed(
                f"{path.name} cannot be loaded ({error}); {REMEDY}"
            ) from error
        self._c.ocu_loops.restype = ctypes.c_void_p
        self._c.ocu_name.argtypes = (ctypes.c_void_p,)
        self._c.ocu_name.restype = ctypes.c_char_p
        self._c.ocu_pool_new.restype = ctypes.c_void_p
        self._c.ocu_pool_free.argtypes = (ctypes.c_void_p,)
        self._c.ocu_pool_size.argtypes = (ctypes.c_void_p,)
        self._c.ocu_pool_set_between.argtypes = (
            ctypes.c_void_p,
            Between,
            ctypes.c_double,
        )
        self._check_sizes(path)
        self._own = ctypes.c_void_p(self._c.ocu_loops(int(portable)))
        self.variant = self._c.ocu_name(self._own).decode()
        self._stages = {name: getattr(self._c, f"ocu_{name}") for name in STAGES}

    def _check_sizes(self, path: Path) -> None:
        sizes = (ctypes.c_int32 * len(records.SIZES))()
        self._c.ocu_sizes(sizes)
        if tuple(sizes) != records.SIZES:
            raise RenderFailed(
                f"{path.name} was built from another version (records of "
                f"{tuple(sizes)} bytes, not {records.SIZES}): install the package again"
            )

    def run(self, stage: str, frame: records.Frame) -> None:
        """Run one of `STAGES` on a frame."""
        self._stages[stage](self._own, ctypes.byref(frame))

    def shrink(self, job: records.ShrinkJob) -> None:
        """Downsample kernels of a store."""
        self._c.ocu_shrink(self._own, ctypes.byref(job))

    def psfs(
        self,
        job: records.PsfJob,
        outcome: NDArray[np.int32],
        sizes: NDArray[np.int64],
    ) -> NDArray[np.uint16]:
        """Compute PSFs; return their concatenated kernels.

        Parameters
        ----------
        job : PsfJob
        outcome, sizes : (n,)
            Arrays that the job points to.

        Raises
        ------
        MemoryError
        """
        is_done = self._c.ocu_psfs(self._own, ctypes.byref(job))
        words = None
        try:
            if not is_done or (outcome == records.PSF_NO_MEMORY).any():
                raise MemoryError("no memory for PSFs")
            words = np.empty(int(sizes.sum()), np.uint16)
        finally:
            address = None if words is None else words.ctypes.data
            self._c.ocu_take_psfs(
                self._own, ctypes.byref(job), ctypes.c_void_p(address)
            )
        return words

    def new_threads(self, count: int) -> int:
        """Start a pool of ``count`` threads including the caller; return its handle."""
        threads = self._c.ocu_pool_new(count)
        if not threads:
            raise RenderFailed(f"{count} threads cannot be started: out of memory")
        return int(threads)

    def thread_count(self, threads: int) -> int:
        """Return the actual number of threads in a pool."""
        return int(self._c.ocu_pool_size(threads))

    def call_between(
        self, threads: int, function: Callable[[], None], interval_s: float
    ) -> object:
        """Register a function to be called within loops, while the threads are idle.

        Returns
        -------
        object
            Callback object that must outlive the threads.
        """
        held = Between(function)
        self._c.ocu_pool_set_between(threads, held, interval_s)
        return held

    def end_threads(self, threads: int) -> None:
        """End the threads of a pool."""
        self._c.ocu_pool_free(threads)


def library_path() -> Path | None:
    """Return the path of the compiled library, or None if it was not built.

    The environment variable ``OCUFILTER_NATIVE_LIBRARY`` selects another build.
    """
    if other := os.environ.get(LIBRARY_VARIABLE):
        return Path(other)
    path = FOLDER / FILE
    return path if path.exists() else None


@cache
def compiled_library() -> Library:
    """Return the compiled library, loaded once.

    The environment variable ``OCUFILTER_NATIVE_VARIANT`` selects "portable", the code
    for any processor, or "auto", which uses AVX2 where the processor has it.

    Raises
    ------
    RenderFailed
        If it was not built or cannot be loaded; the message has the remedy.
        If there is no such variant.
    """
    path = library_path()
    if path is None:
        raise RenderFailed(f"the native engine was not built here; {REMEDY}")
    variant = os.environ.get(VARIANT_VARIABLE, "auto")
    if variant not in VARIANTS:
        raise RenderFailed(
            f"{VARIANT_VARIABLE}={variant!r}; allowed: {', '.join(VARIANTS)}"
        )
    return Library(path, portable=variant == "portable")
