"""Lock of a program's calls and of the thread that prepares eyes; calls come first."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

WAIT_S = 0.5
"""Longest wait of the background thread, which then checks whether it has to end."""


class Signal:
    """A descriptor that is readable while the signal is set."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(self._writer, False)

    def fileno(self) -> int:
        """Return the descriptor to poll."""
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


class PriorityLock:
    """Lock of foreground calls and one background thread, which works in short steps.

    The thread starts no step while a call holds the lock or waits for it.  Calls may be
    nested.
    """

    def __init__(self) -> None:
        self._lock = threading.Condition(threading.RLock())
        self._calls: set[object] = set()  # that hold the lock or wait for it
        self._is_free = threading.Event()  # for the thread
        self._is_free.set()
        self._is_paused = self._is_thread_waiting = False
        self._reserved_s = 0.0
        self._is_used = threading.Event()  # the reserved time
        self._is_used.set()

    @contextmanager
    def foreground(self) -> Iterator[None]:
        """Hold the lock during a call."""
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
    def background(self) -> Iterator[bool]:
        """Hold the lock during a step of the thread; yield whether it may work."""
        self._is_thread_waiting = True
        self._is_free.wait(WAIT_S)
        with self._lock:
            if self._calls and not self._is_paused:
                yield False
                return
            self._is_thread_waiting, started_s = False, time.monotonic()
            yield True
            self._reserved_s -= time.monotonic() - started_s
            if self._reserved_s <= 0.0:
                self._is_used.set()

    def reserve(self, time_s: float) -> None:
        """Reserve time for the thread, which `wait_for_reserved` waits for."""
        self._reserved_s = time_s
        if time_s > 0.0:
            self._is_used.clear()
        else:
            self._is_used.set()

    @property
    def has_foreground(self) -> bool:
        """Return whether a call holds the lock or waits for it."""
        return bool(self._calls)

    def wait_for_reserved(self, timeout_s: float) -> None:
        """Wait until the thread has used its reserved time.

        Otherwise calls in close succession would leave it no time.
        """
        self._is_used.wait(timeout_s)

    def pause(self, timeout_s: float) -> None:
        """Let the thread work in the middle of a call, if it is waiting."""
        if not self._is_thread_waiting:
            return
        with self._lock:
            self._is_paused = True
            self._is_free.set()
            self._lock.wait(timeout_s)
            self._is_paused = False
            self._is_free.clear()

    def resume(self) -> None:
        """End `pause`, from the thread, when it has no more work."""
        self._lock.notify_all()
