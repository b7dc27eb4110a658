"""Filter thread shared by all pages; a newer request replaces an older one.

The page's event loop never filters; it submits a request here and continues. A newer
request replaces one that has not been started. The preview follows at once, and the
full picture after a pause without input; new input cancels it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from clients.web.eye_form import EyeSide
from clients.web.eye_view import EyeView
from clients.web.picture_requests import PictureRequest, SentPicture

PAUSE_S = 0.12
"""Time without a newer request after which the full picture is computed."""

POLL_S = 0.002
"""Interval of polling an eye that is being prepared."""

STALE_S = 0.5
"""Maximum wait for a preview once a newer request has arrived."""


_log = logging.getLogger(__name__)


@dataclass
class _Page:
    """One page: its newest request, the current one, and its eyes."""

    show: Callable[[SentPicture], None]
    newest: PictureRequest | None = None
    arrived_s: float = 0.0
    current: PictureRequest | None = None
    begun_s: float = 0.0
    eyes: dict[EyeSide, EyeView] = field(default_factory=dict)

    def step(self) -> float | None:
        """Do a piece of work; return the time until the next step, in s, or None."""
        now_s = time.monotonic()
        request = self._next_request(now_s)
        if request is None:
            return None
        for side in request.bodies:
            self.eyes.setdefault(side, EyeView(side))
        wanted = [self.eyes[side] for side in request.bodies]
        is_waiting = False
        for eye in wanted:
            if eye.seen["preview"] < request.number:
                is_waiting |= not self._show_if_ready(eye.preview(request))
        if is_waiting:
            return POLL_S
        if request is not self.newest:
            return 0.0
        if all(eye.seen["full"] >= request.number for eye in wanted):
            return None
        pause_s = self.arrived_s + PAUSE_S - now_s
        if pause_s > 0.0:
            return pause_s
        for eye in wanted:
            if eye.seen["full"] < request.number:
                is_waiting |= not self._show_if_ready(eye.full(request))
            if request is not self.newest:
                return 0.0
        return POLL_S if is_waiting else None

    def _next_request(self, now_s: float) -> PictureRequest | None:
        """Return the current request until its previews are shown, then the newest."""
        is_new = self.current is not self.newest
        if is_new and (self._has_all_previews() or now_s > self.begun_s + STALE_S):
            self.current, self.begun_s = self.newest, now_s
        return self.current

    def _has_all_previews(self) -> bool:
        request = self.current
        return request is None or all(
            side in self.eyes and self.eyes[side].seen["preview"] >= request.number
            for side in request.bodies
        )

    def _show_if_ready(self, seen: SentPicture | None) -> bool:
        if seen is not None:
            self.show(seen)
        return seen is not None

    def fail_request(self, reason: str) -> None:
        """Drop the current request and report why."""
        request, self.newest, self.current = self.current, None, None
        for side in request.bodies if request else ():
            assert request is not None
            self.show(
                SentPicture("failed", side, request.number, b"", {"error": reason})
            )

    def close(self) -> None:
        for eye in self.eyes.values():
            eye.close()


class FilterThread:
    """Thread that filters pictures for all pages of a process."""

    def __init__(self) -> None:
        self._pages: dict[str, _Page] = {}
        self._closing_pages: list[_Page] = []
        self._wake = threading.Event()
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name="filter", daemon=True)
        self._thread.start()

    def open(self, page: str, show: Callable[[SentPicture], None]) -> None:
        """Register a page; ``show`` gets its pictures, in the filter thread."""
        self._pages[page] = _Page(show)

    def request(self, page: str, request: PictureRequest) -> None:
        """Request a picture; an older request is dropped."""
        known = self._pages.get(page)
        if known is not None:
            known.newest, known.arrived_s = request, time.monotonic()
            self._wake.set()

    def forget(self, page: str) -> None:
        """Remove a page."""
        known = self._pages.pop(page, None)
        if known is not None:
            self._closing_pages.append(known)
            self._wake.set()

    def close(self) -> None:
        """Stop the thread and close all eyes."""
        self._is_closed = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._is_closed:
            self._wake.clear()
            while self._closing_pages:
                self._closing_pages.pop().close()
            waits_s = list(self._step_all())
            self._wake.wait(min(waits_s, default=None))
        for page in [*self._pages.values(), *self._closing_pages]:
            page.close()

    def _step_all(self) -> Iterator[float]:
        for page in list(self._pages.values()):
            try:
                wait_s = page.step()
            except Exception as error:  # affects one page; the others continue
                _log.exception("A picture failed")
                page.fail_request(f"{type(error).__name__}: {error}")
                continue
            if wait_s is not None:
                yield wait_s
