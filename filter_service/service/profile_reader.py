"""Reads the bodies of profiles, the larger ones in a separate process.

Reading 100 measurements takes 5 ms of a processor and 20 surfaces in 8 states 40 ms.
The interpreter's lock is held meanwhile: in a thread, it would stop the frame loop as
well.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from estimator.eye.checked_fields import ProfileError
from estimator.profiles.bodies import TRACED_KINDS
from estimator.profiles.parse import EyeProfile, parse_profile
from filter_service.building.jobs import BuildDone, BuildError, unknown_profile
from filter_service.building.worker_handle import WorkerHandle
from filter_service.errors import FilterError
from filter_service.messages import ProfileRequest
from filter_service.view_state import body_of_eye

MAX_AT_ONCE_BYTES = 2048
"""Size up to which a body is read in the frame loop: 0.1 ms, 0.4 ms if refused."""

READ_LIMIT_S = 10.0

Read = Callable[[dict[str, Any]], EyeProfile]

log = logging.getLogger("ocufilter")


@dataclass(frozen=True)
class ReadJob:
    """A profile to read, and the function that reads its body."""

    read: Read
    request: ProfileRequest


@dataclass(frozen=True)
class ReadProfile:
    """A profile, or why it was refused, and the processor time that this took."""

    found: EyeProfile | FilterError
    used_s: float

    def parts_ahead(self, job: ReadJob) -> tuple[()]:
        """Return no parts, unlike a build."""
        return ()


def read_profile(body: dict[str, Any]) -> EyeProfile:
    """Parse the body of a profile.

    Raises
    ------
    UnknownProfile
        If the body is invalid; the error names the field and the allowed values.
    """
    try:
        return parse_profile(body)
    except ProfileError as error:
        raise unknown_profile(error) from error


def read(job: ReadJob, **_build: Any) -> ReadProfile:
    """Read a profile; the other arguments of a build are not used."""
    start_s = time.thread_time()
    found: EyeProfile | FilterError
    try:
        request = job.request.unpacked()
        assert isinstance(request.body, dict)
        found = job.read(body_of_eye(request.body, request.eye))
    except FilterError as error:
        found = error.with_traceback(None)
        found.__cause__ = None
    except Exception as error:
        log.exception("a profile could not be processed")
        found = FilterError(f"{type(error).__name__}: {error}")
    return ReadProfile(found, time.thread_time() - start_s)


class ProfileReader:
    """Reads profiles one at a time, in the order of requests, or at once if small.

    Parameters
    ----------
    read_profile : callable
        ``read_profile(body)`` returns a parsed profile, or raises `FilterError`; a
        function of a module, which the process imports.
    """

    def __init__(self, read_profile: Read) -> None:
        self._read_profile = read_profile
        self._worker = WorkerHandle(
            f"{__name__}:read",
            build_limit_s=READ_LIMIT_S,
            task="reads profiles",
        )
        self._reading: dict[int, tuple[str, ProfileRequest]] = {}  # by ticket

    @property
    def file_descriptor(self) -> int | None:
        """Return the descriptor to poll for reading; None without a process."""
        return self._worker.file_descriptor

    @property
    def needs_poll(self) -> bool:
        """Return whether `poll` has work to do although the process is silent."""
        return bool(self._reading) and self._worker.needs_poll

    def is_reading(self, key: str) -> bool:
        """Return whether a profile of a session is being read."""
        return any(owner == key for owner, _ in self._reading.values())

    def submit(self, key: str, request: ProfileRequest) -> ReadProfile | None:
        """Read a small profile and return it, or leave a larger one to the process."""
        job = ReadJob(self._read_profile, request)
        if _is_small(request):
            return read(job)
        self._worker.start()
        self._reading[self._worker.submit(job)] = key, request
        return None

    def poll(self) -> list[tuple[str, ProfileRequest, ReadProfile]]:
        """Return the profiles that have been read, with session and request."""
        if not self._reading and self._worker.file_descriptor is None:
            return []
        found = []
        for event in self._worker.poll():
            if event.ticket not in self._reading:
                continue  # of a session that has ended
            if isinstance(event, BuildDone):
                outcome: Any = event.built
            elif isinstance(event, BuildError):
                outcome = ReadProfile(event.error, 0.0)
            else:
                continue
            found.append((*self._reading.pop(event.ticket), outcome))
        return found

    def forget(self, key: str) -> None:
        """Forget the profiles of a session that has ended."""
        for ticket in [n for n, (owner, _) in self._reading.items() if owner == key]:
            del self._reading[ticket]
            self._worker.cancel(ticket)

    def close(self) -> None:
        """End the process."""
        self._worker.close()


def _is_small(request: ProfileRequest) -> bool:
    """Return whether to read a profile at once."""
    if len(request.parts()[0]) > MAX_AT_ONCE_BYTES:
        return False
    try:
        body = request.unpacked().body
    except FilterError:
        return True
    kind = body.get("kind") if isinstance(body, dict) else None
    return not (isinstance(kind, str) and kind in TRACED_KINDS)
