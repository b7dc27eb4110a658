"""Lock of a program's calls and of the thread that prepares eyes; calls come first."""

from __future__ import annotations

import os
import threading
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
        self._is_paused = False
        self._is_thread_served = threading.Event()  # it does not wait for the lock
        self._is_thread_served.set()

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
        self._is_thread_served.clear()
        self._is_free.wait(WAIT_S)
        with self._lock:
            if self._calls and not self._is_paused:
                yield False
                return
            self._is_thread_served.set()
            yield True

    @property
    def has_foreground(self) -> bool:
        """Return whether a call holds the lock or waits for it."""
        return bool(self._calls)

    def let_thread_step(self, timeout_s: float) -> None:
        """Let the thread take the step that it waits for, before a call.

        Otherwise calls in close succession would leave it no time.
        """
        if not self._calls:  # which do not end before this returns
            self._is_thread_served.wait(timeout_s)

    def pause(self, timeout_s: float) -> None:
        """Let the thread work in the middle of a call, if it is waiting."""
        if self._is_thread_served.is_set():
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
