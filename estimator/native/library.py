"""Python interface of compiled libraries."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from estimator.native import records
from estimator.native.functions import FUNCTIONS
from estimator.native.records import pointer_to
from estimator.threads import call_after_fork, thread_count

PATH = Path(__file__).parent / "_core.so"
FOLDER_VARIABLE = "OCUFILTER_LIBRARY_DIR"
VARIANT_VARIABLE = "OCUFILTER_NATIVE_VARIANT"
VARIANTS = ("auto", "portable")

ABI = 1
"""``OCU_ABI`` of `source/variant.h`."""

REMEDY = (
    "install a C compiler (apt-get install gcc libc6-dev) and the package again "
    "(with pip's --no-cache-dir --force-reinstall)"
)

Between = ctypes.CFUNCTYPE(None)

NUMBERS: Mapping[str, type] = {"i8": ctypes.c_int64, "f8": ctypes.c_double}


class LibraryUnavailable(RuntimeError):
    """A compiled library is missing, cannot be loaded or is of another version."""


class Library:
    """Compiled functions that are called by name and release the GIL.

    Parameters
    ----------
    path : Path
        Path of the shared library.
    signatures : dict
        See `estimator.native.functions`.
    sizes : tuple of int
        Expected sizes of the records.
    portable : bool
        Do not use optional processor features.

    Raises
    ------
    LibraryUnavailable
    """

    def __init__(
        self,
        path: Path,
        signatures: Mapping[str, str],
        sizes: tuple[int, ...],
        *,
        portable: bool = False,
    ):
        self.path = path
        try:
            self._c = ctypes.CDLL(str(path))
        except OSError as error:
            raise LibraryUnavailable(
                f"{path.name} cannot be loaded ({error}); {REMEDY}"
            ) from error
        self._c.ocu_variant.restype = ctypes.c_void_p
        self._c.ocu_name.argtypes = (ctypes.c_void_p,)
        self._c.ocu_name.restype = ctypes.c_char_p
        self._c.ocu_function.argtypes = (ctypes.c_void_p, ctypes.c_char_p)
        self._c.ocu_function.restype = ctypes.c_void_p
        self._check_version(sizes)
        self._own = ctypes.c_void_p(self._c.ocu_variant(int(portable)))
        self.variant = self._c.ocu_name(self._own).decode()
        self._functions = {
            name: self._find(name, text) for name, text in signatures.items()
        }

    def _check_version(self, sizes: tuple[int, ...]) -> None:
        found = (ctypes.c_int32 * len(sizes))()
        self._c.ocu_sizes(found)
        versions = self._c.ocu_abi(), *found
        if versions != (ABI, *sizes):
            raise LibraryUnavailable(
                f"{self.path.name} was built from another version (interface and "
                f"records {versions}, not {(ABI, *sizes)}): install the package again"
            )

    def _find(self, name: str, signature: str) -> _Function:
        address = self._c.ocu_function(self._own, name.encode())
        if not address:
            raise LibraryUnavailable(
                f"{self.path.name} has no function {name}: install the package again"
            )
        return _Function(name, address, signature)

    def call(self, name: str, *arguments: Any) -> int:
        """Call a function with the arguments of its signature; return its result.

        Raises
        ------
        TypeError
            If an argument does not match the signature.
        """
        return self._functions[name](*arguments)


def function_at(address: int, result: type | None, parameters: list[type]) -> Any:
    """Return the function at an address."""
    return ctypes.CFUNCTYPE(result, *parameters)(address)


class _Function:
    """A function with checked arguments."""

    def __init__(self, name: str, address: int, signature: str):
        self._name = name
        head, arrow, _ = signature.partition("->")
        self._parameters = [_converter(word) for word in head.split()]
        types = [NUMBERS.get(word, ctypes.c_void_p) for word in head.split()]
        self._call = function_at(address, ctypes.c_int64 if arrow else None, types)

    def __call__(self, *arguments: Any) -> int:
        if len(arguments) != len(self._parameters):
            raise TypeError(
                f"{self._name} takes {len(self._parameters)} arguments, "
                f"not {len(arguments)}"
            )
        words = []
        for number, (convert, value) in enumerate(
            zip(self._parameters, arguments, strict=True)
        ):
            try:
                words.append(convert(value))
            except TypeError as error:
                raise TypeError(f"{self._name}, argument {number}: {error}") from error
        return self._call(*words) or 0


def _converter(word: str) -> Callable[[Any], Any]:
    """Return the function that converts an argument of a kind for ctypes."""
    if word.endswith("[]"):
        dtype = np.dtype(word[:-2])
        return lambda value: _address(value, dtype)
    if word == "record":
        return ctypes.addressof
    return {"i8": int, "f8": float, "pool": int}[word]


def _address(array: Any, dtype: np.dtype) -> int | None:
    if array is None:
        return None
    if not isinstance(array, np.ndarray):
        raise TypeError(f"expected an array of {dtype}, got {type(array).__name__}")
    if array.dtype != dtype or not array.flags.c_contiguous:
        raise TypeError(
            f"expected a contiguous array of {dtype}, got {array.dtype} "
            f"of shape {array.shape}, strides {array.strides}"
        )
    return pointer_to(array)


class Core(Library):
    """The library of `source/`, which has the thread pool of the process."""

    def __init__(self, path: Path, *, portable: bool = False):
        super().__init__(path, FUNCTIONS, records.SIZES, portable=portable)
        self._c.ocu_pool_new.restype = ctypes.c_void_p
        self._c.ocu_pool_free.argtypes = (ctypes.c_void_p,)
        self._c.ocu_pool_size.argtypes = (ctypes.c_void_p,)
        self._c.ocu_pool_set_between.argtypes = (
            ctypes.c_void_p,
            Between,
            ctypes.c_double,
        )

    def new_threads(self, count: int) -> int:
        """Return a handle of the pool, for loops on ``count`` threads with the caller.

        Raises
        ------
        MemoryError
        """
        threads = self._c.ocu_pool_new(count)
        if not threads:
            raise MemoryError(f"no memory for {count} threads")
        return int(threads)

    def thread_count(self, threads: int) -> int:
        """Return the actual number of threads of a handle's loops."""
        return int(self._c.ocu_pool_size(threads))

    def call_between(
        self, threads: int, function: Callable[[], None], interval_s: float
    ) -> object:
        """Register a function that the caller of a handle's loops calls within them.

        Returns
        -------
        object
            Callback object that must outlive the handle.
        """
        held = Between(function)
        self._c.ocu_pool_set_between(threads, held, interval_s)
        return held

    def end_threads(self, threads: int) -> None:
        """Release a handle; the threads end with the last one."""
        self._c.ocu_pool_free(threads)


def in_use(path: Path) -> Path:
    """Return the path of an installed library, or of the build in use instead.

    The environment variable ``OCUFILTER_LIBRARY_DIR`` selects a folder with another
    build.
    """
    return Path(os.environ.get(FOLDER_VARIABLE) or path.parent) / path.name


def selected(path: Path) -> tuple[Path, bool]:
    """Return the path of a library in use, and whether to use the portable variant.

    The environment variable ``OCUFILTER_NATIVE_VARIANT`` selects the variant:
    "portable", the code for any processor, or "auto", which uses AVX2 where the
    processor has it.

    Raises
    ------
    LibraryUnavailable
        If it was not built, or there is no such variant.
    """
    path = in_use(path)
    if not path.exists():
        raise LibraryUnavailable(f"{path.name} was not built here; {REMEDY}")
    variant = os.environ.get(VARIANT_VARIABLE, "auto")
    if variant not in VARIANTS:
        raise LibraryUnavailable(
            f"{VARIANT_VARIABLE}={variant!r}; allowed: {', '.join(VARIANTS)}"
        )
    return path, variant == "portable"


@cache
def shared_threads() -> int:
    """Return a handle for loops on all threads; the process keeps it.

    Raises
    ------
    LibraryUnavailable
    """
    return core().new_threads(thread_count())


call_after_fork(shared_threads.cache_clear)  # it may use fewer


@cache
def core() -> Core:
    """Return the compiled core, loaded once; see `selected`.

    Raises
    ------
    LibraryUnavailable
        The message has the remedy.
    """
    path, portable = selected(PATH)
    return Core(path, portable=portable)
