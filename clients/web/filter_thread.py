"""Filter thread of the pages; the newest request wins.

The page's event loop never filters; it submits a request here and continues. A newer
request replaces one that has not been started. The preview comes at once; the full
picture once the input has rested, and it is canceled by the next input.
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

REST_S = 0.12
"""Time without a newer request after which the full picture is made."""

POLL_S = 0.002
"""Interval of polling an eye that is being prepared."""

STALE_S = 0.5
"""If the request has changed, a preview is awaited no longer than this."""


_log = logging.getLogger(__name__)


@dataclass
class _Page:
    """One page: its newest request, the current one, and its eyes."""

    show: Callable[[SentPicture], None]
    newest: PictureRequest | None = None
    arrived_s: float = 0.0
    in_hand: PictureRequest | None = None
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
        waits = False
        for eye in wanted:
            if eye.seen["preview"] < request.number:
                waits |= not self._showed(eye.preview(request))
        if waits:
            return POLL_S
        if request is not self.newest:
            return 0.0
        if all(eye.seen["full"] >= request.number for eye in wanted):
            return None
        rest_s = self.arrived_s + REST_S - now_s
        if rest_s > 0.0:
            return rest_s
        for eye in wanted:
            if eye.seen["full"] < request.number:
                waits |= not self._showed(eye.full(request))
            if request is not self.newest:
                return 0.0
        return POLL_S if waits else None

    def _next_request(self, now_s: float) -> PictureRequest | None:
        """Return the current request until its previews are shown, then the newest."""
        is_new = self.in_hand is not self.newest
        if is_new and (self._is_previewed() or now_s > self.begun_s + STALE_S):
            self.in_hand, self.begun_s = self.newest, now_s
        return self.in_hand

    def _is_previewed(self) -> bool:
        request = self.in_hand
        return request is None or all(
            side in self.eyes and self.eyes[side].seen["preview"] >= request.number
            for side in request.bodies
        )

    def _showed(self, seen: SentPicture | None) -> bool:
        if seen is not None:
            self.show(seen)
        return seen is not None

    def give_up(self, reason: str) -> None:
        """Drop the current request and report why."""
        request, self.newest, self.in_hand = self.in_hand, None, None
        for side in request.bodies if request else ():
            assert request is not None
            self.show(
                SentPicture("failed", side, request.number, b"", {"error": reason})
            )

    def close(self) -> None:
        for eye in self.eyes.values():
            eye.close()


class FilterThread:
    """Filters for all pages of a process, in a thread of its own."""

    def __init__(self) -> None:
        self._pages: dict[str, _Page] = {}
        self._ended: list[_Page] = []
        self._wake = threading.Event()
        self._is_over = False
        self._thread = threading.Thread(target=self._run, name="seeing", daemon=True)
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
            self._ended.append(known)
            self._wake.set()

    def close(self) -> None:
        """Stop the thread and close all eyes."""
        self._is_over = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._is_over:
            self._wake.clear()
            while self._ended:
                self._ended.pop().close()
            waits_s = list(self._step_all())
            self._wake.wait(min(waits_s, default=None))
        for page in [*self._pages.values(), *self._ended]:
            page.close()

    def _step_all(self) -> Iterator[float]:
        for page in list(self._pages.values()):
            try:
                wait_s = page.step()
            except Exception as error:  # of one page; the others continue
                _log.exception("A picture failed")
                page.give_up(f"{type(error).__name__}: {error}")
                continue
            if wait_s is not None:
                yield wait_s
