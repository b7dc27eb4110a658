"""The native library for another processor, called from this process.

Only the compiled C code is emulated (`qemu-user`): a child process runs the functions
of the library and fetches the data that they use from this process, see `emulated.c`.
"""

from __future__ import annotations

import ctypes
import os
import struct
import subprocess
from pathlib import Path

PAGE = 4096
HEADER = struct.Struct("<qQ")
NAME = "ocu_name"
ADDRESSES = ("ocu_loops", "ocu_pool_new")  # the other functions return int or nothing
IGNORED = ("ocu_pool_set_between",)  # a callback into this process


class EmulatedLibrary:
    """Stands in for `ctypes.CDLL`; calls run in an emulator.

    Parameters
    ----------
    *command : str
        The emulator with its options, the compiled emulated.c, and the library.
    """

    def __init__(self, *command: str | Path):
        self._process = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=1 << 20,
        )
        self._memory = os.open("/proc/self/mem", os.O_RDONLY)
        self._functions: dict[str, _Function] = {}
        self.call_count = 0

    def __getattr__(self, name: str) -> _Function:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._functions.setdefault(name, _Function(self, name))

    def call(self, name: str, values: list[int]) -> int:
        """Run a function on up to four integers and addresses; return its result."""
        self.call_count += 1
        values = [value & (1 << 64) - 1 for value in values] + [0] * (4 - len(values))
        self._send(struct.pack("<32s4Q", name.encode(), *values))
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


class _Function:
    """One function; `Library` sets its types, which are not needed here."""

    def __init__(self, library: EmulatedLibrary, name: str):
        self._library, self._name = library, name

    def __call__(self, *arguments):
        if self._name in IGNORED:
            return None
        kept = list(arguments)  # alive during the call
        result = self._library.call(self._name, [_word(value) for value in kept])
        if self._name == NAME:
            return struct.pack("<Q", result).rstrip(b"\0")
        return result if self._name in ADDRESSES else ctypes.c_int32(result).value


def _word(value) -> int:
    if value is None:
        return 0
    if isinstance(value, int):
        return value
    if isinstance(value, ctypes.c_void_p):
        return value.value or 0
    if isinstance(value, ctypes.Array):
        return ctypes.addressof(value)
    return ctypes.addressof(value._obj)  # ctypes.byref
