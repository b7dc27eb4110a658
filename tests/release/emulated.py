"""The compiled libraries for another processor, called from this process.

Only the compiled C code is emulated (`qemu-user`): a child process runs the functions
of the libraries and fetches the data that they use from this process, see `emulated.c`.
"""

from __future__ import annotations

import ctypes
import os
import struct
import subprocess
from pathlib import Path
from typing import Any

PAGE = 4096
HEADER = struct.Struct("<qQ")
CALL = struct.Struct("<32sQQ16Q8d")
MOST_INTEGERS, MOST_DOUBLES = 16, 8
NAME = "ocu_name"
ADDRESSES = ("ocu_variant", "ocu_function", "ocu_pool_new")
"""Functions that return addresses; the others return int or nothing."""

IGNORED = ("ocu_pool_set_between",)  # a callback into this process


class Emulator:
    """Process that runs the functions of libraries.

    Parameters
    ----------
    *command : str
        The emulator with its options, and the compiled emulated.c.
    libraries : list of Path
    """

    def __init__(self, *command: str | Path, libraries: list[Path]):
        self._paths = [str(path) for path in libraries]
        self._process = subprocess.Popen(
            [*(str(word) for word in command), *self._paths],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=1 << 20,
        )
        self._memory = os.open("/proc/self/mem", os.O_RDONLY)
        self.call_count = 0

    def library(self, path: str) -> EmulatedLibrary:
        """Stand in for `ctypes.CDLL`."""
        return EmulatedLibrary(self, self._paths.index(path))

    def function_at(
        self, address: int, result: type | None, parameters: list[type]
    ) -> Any:
        """Stand in for `estimator.native.library.function_at`."""

        def call(*values: Any) -> int | None:
            found = self.call("", values, address=address)
            return None if result is None else ctypes.c_int32(found).value

        return call

    def call(
        self, name: str, values: Any, *, library: int = 0, address: int = 0
    ) -> int:
        """Run a function on integers, addresses and doubles; return its result."""
        self.call_count += 1
        kept = list(values)  # alive during the call
        doubles = [value for value in kept if isinstance(value, float)]
        words = [
            _word(value) & (1 << 64) - 1
            for value in kept
            if not isinstance(value, float)
        ]
        if len(words) > MOST_INTEGERS or len(doubles) > MOST_DOUBLES:
            raise TypeError(f"{name}: {len(words)} integers, {len(doubles)} doubles")
        words += [0] * (MOST_INTEGERS - len(words))
        doubles += [0.0] * (MOST_DOUBLES - len(doubles))
        self._send(CALL.pack(name.encode(), library, address, *words, *doubles))
        while True:
            kind, value = HEADER.unpack(self._receive(HEADER.size))
            if kind == ord("R"):
                return value
            if kind == ord("F"):
                try:
                    page = os.pread(self._memory, PAGE, value)
                except OSError:
                    page = b""
                self._send(struct.pack("<Q", bool(page)) + page)
            else:
                (length,) = struct.unpack("<Q", self._receive(8))
                ctypes.memmove(value, self._receive(length), length)

    def close(self) -> None:
        """End the emulator."""
        os.close(self._memory)
        self._process.communicate()

    def _send(self, data: bytes) -> None:
        self._process.stdin.write(data)
        self._process.stdin.flush()

    def _receive(self, length: int) -> bytes:
        data = self._process.stdout.read(length)
        if len(data) < length:
            raise RuntimeError(f"the emulator ended ({self._process.wait()})")
        return data


class EmulatedLibrary:
    """One of an emulator's libraries, in place of a `ctypes.CDLL`."""

    def __init__(self, emulator: Emulator, number: int):
        self._emulator, self._number = emulator, number
        self._functions: dict[str, _Function] = {}

    def __getattr__(self, name: str) -> _Function:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._functions.setdefault(
            name, _Function(self._emulator, self._number, name)
        )


class _Function:
    """An exported function; `Library` sets its types, which are not needed here."""

    def __init__(self, emulator: Emulator, library: int, name: str):
        self._emulator, self._library, self._name = emulator, library, name

    def __call__(self, *arguments: Any) -> Any:
        if self._name in IGNORED:
            return None
        kept = [
            ctypes.create_string_buffer(value) if isinstance(value, bytes) else value
            for value in arguments
        ]
        result = self._emulator.call(self._name, kept, library=self._library)
        if self._name == NAME:
            return struct.pack("<Q", result).rstrip(b"\0")
        return result if self._name in ADDRESSES else ctypes.c_int32(result).value


def _word(value: Any) -> int:
    if value is None:
        return 0
    if isinstance(value, int):
        return value
    if isinstance(value, ctypes.c_void_p):
        return value.value or 0
    return ctypes.addressof(value)  # an array
