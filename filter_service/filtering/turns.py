"""Turns of the calls of a program and of the thread that prepares its eyes."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

WAIT_S = 0.5
"""Longest wait of the thread for its turn; then it looks whether it shall end."""


class Signal:
    """A descriptor that can be read from while the signal is set."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(self._writer, False)

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return self._reader

    def set(self) -> None:
        """Set the signal."""
        with suppress(OSError):  # it is full, or closed
            os.write(self._writer, b"\0")

    def clear(self) -> None:
        """Clear the signal."""
        with suppress(BlockingIOError):
            os.read(self._reader, 4096)

    def close(self) -> None:
        """Close the descriptors."""
        os.close(self._reader)
        os.close(self._writer)
        self._reader = self._writer = -1


class Turns:
    """Turns of calls and of one thread that works in short pieces.

    Calls go first: the thread begins no piece while a call waits.  A call may contain
    others.
    """

    def __init__(self) -> None:
        self._lock = threading.Condition(threading.RLock())
        self._calls: set[object] = set()  # that have the turn or wait for it
        self._is_free = threading.Event()  # there are none, or one lends its turn
        self._is_free.set()
        self._is_lent = self._wants_turn = False
        self._owed_s = 0.0
        self._is_paid = threading.Event()
        self._is_paid.set()

    @contextmanager
    def call(self) -> Iterator[None]:
        """Exclude the thread during a call."""
        call = object()
        self._calls.add(call)
        self._is_free.clear()
        try:
            with self._lock:
                yield
        finally:
            self._calls.discard(call)
            if not self._calls:
                self._is_free.set()

    @contextmanager
    def work(self) -> Iterator[bool]:
        """Exclude calls during a piece of work; yield whether it has a turn."""
        self._wants_turn = True
        self._is_free.wait(WAIT_S)
        with self._lock:
            if self._calls and not self._is_lent:
                yield False
                return
            self._wants_turn, started_s = False, time.monotonic()
            yield True
            self._owed_s -= time.monotonic() - started_s
            if self._owed_s <= 0.0:
                self._is_paid.set()

    def owe(self, time_s: float) -> None:
        """Set the time that the thread gets before `wait_until_paid` returns."""
        self._owed_s = time_s
        if time_s > 0.0:
            self._is_paid.clear()
        else:
            self._is_paid.set()

    @property
    def has_calls(self) -> bool:
        """Return whether a call has the turn or waits for it."""
        return bool(self._calls)

    def wait_until_paid(self, timeout_s: float) -> None:
        """Wait until the thread has worked for the time that it gets."""
        # Otherwise calls that follow each other at once would leave it no time.
        self._is_paid.wait(timeout_s)

    def lend(self, timeout_s: float) -> None:
        """Let the thread work in the middle of a call, if it has anything to do."""
        if not self._wants_turn:
            return
        with self._lock:
            self._is_lent = True
            self._is_free.set()
            self._lock.wait(timeout_s)
            self._is_lent = False
            self._is_free.clear()

    def end_loan(self) -> None:
        """End `lend`: the thread, which has the turn, has nothing more to do."""
        self._lock.notify_all()
