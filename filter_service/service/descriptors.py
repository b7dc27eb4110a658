"""File descriptors of the front end: a limit for connections and a reserve.

libzmq accepts connections until the process runs out of descriptors.  The soft limit is
therefore kept below the maximum, and raised briefly to open shared memory and links to
new processes.
"""

from __future__ import annotations

import errno
import resource
from collections.abc import Iterator
from contextlib import contextmanager

TARGET_COUNT = 4096
"""Soft limit to request, up to the hard limit."""

RESERVE = 32
"""Descriptors that only the front end itself may open."""

BASE_COUNT = 96
"""The reserve, plus the descriptors that are open without clients (30), rounded up."""

OUT_OF_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Errors of the system when descriptors or kernel memory are exhausted."""


class DescriptorLimit:
    """Limit of the descriptors of this process.

    Parameters
    ----------
    max_sessions : int
        Number of sessions that must fit.

    Attributes
    ----------
    max_connections : int
        Maximum number of simultaneous connections, with or without a session.
    max_slots : int
        Maximum number of open shared-memory slots.

    Raises
    ------
    OSError
        If the hard limit is too low for that many sessions.
    """

    def __init__(self, max_sessions: int) -> None:
        soft, self._hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        most = max(soft, TARGET_COUNT) if soft >= 0 else TARGET_COUNT
        self._most = most if self._hard < 0 else min(most, self._hard)
        least = BASE_COUNT + 3 * max_sessions
        if self._most < least:
            raise OSError(
                f"this process may open {self._most} files; expected at least {least} "
                f"for {max_sessions} sessions: raise the limit (ulimit -n {least}, or "
                f"LimitNOFILE={least} of a systemd unit), or lower max_sessions"
            )
        free = self._most - BASE_COUNT
        self.max_slots = max(max_sessions, free // 4)
        self.max_connections = free - self.max_slots
        self._set(self._most - RESERVE)

    def _set(self, soft: int) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, self._hard))

    @contextmanager
    def reserve(self) -> Iterator[None]:
        """Return a context in which the reserve may be used."""
        self._set(self._most)
        try:
            yield
        finally:
            self._set(self._most - RESERVE)
