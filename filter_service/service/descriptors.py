"""File descriptors of the front end: a limit for connections, a reserve for itself.

libzmq accepts connections until the process has no descriptor left.  The soft limit of
this process therefore stands below what it may have: memory for images and links to
new processes are opened while the limit is raised for a moment.
"""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager

WANTED = 4096
"""Descriptors to ask for where the hard limit allows more than the soft one."""

RESERVE = 32
"""Only the front end itself opens these."""

BASE = 96
"""The reserve, and what is open before the first client connects (30 of them)."""

OUT_OF_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""What the system says where descriptors or kernel memory are used up."""


class DescriptorLimit:
    """The descriptors that this process may have.

    Parameters
    ----------
    max_sessions : int
        Clients that must be served: two descriptors each.

    Attributes
    ----------
    max_connections : int
        Clients that may be connected at once, with a session or without.
    max_slots : int
        Pieces of shared memory that may be open at once.

    Raises
    ------
    OSError
        The hard limit is too low to serve that many.
    """

    def __init__(self, max_sessions: int) -> None:
        soft, self._hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        most = max(soft, WANTED) if soft >= 0 else WANTED
        self._most = most if self._hard < 0 else min(most, self._hard)
        least = BASE + 3 * max_sessions
        if self._most < least:
            raise OSError(
                f"this process may open {self._most} files; expected at least {least} "
                f"for {max_sessions} sessions: raise the limit (ulimit -n {least}, or "
                f"LimitNOFILE={least} of a systemd unit), or lower max_sessions"
            )
        free = self._most - BASE
        self.max_slots = max(max_sessions, free // 4)
        self.max_connections = free - self.max_slots
        self._set(self._most - RESERVE)

    def _set(self, soft: int) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, self._hard))

    @contextmanager
    def reserve(self) -> Iterator[None]:
        """Let this process open descriptors that no connection can take."""
        self._set(self._most)
        try:
            yield
        finally:
            self._set(self._most - RESERVE)


def open_count() -> int:
    """Return the number of open descriptors of this process (Linux)."""
    return len(os.listdir("/proc/self/fd")) - 1
