"""Filter thread shared by all pages; a newer request replaces an older one.

The page's event loop never filters; it submits a request here and continues. A newer
request replaces one that has not been started. The preview follows at once, and the
full picture after a pause without input; new input cancels it.  A single step after a
rest is usually the only one, so the eye of its full picture is estimated in the pause.

The preview uses the on-axis wavefront from a formula and takes some hundredths of a
second; the full picture uses the eye ray-traced over its field.
"""

from __future__ import annotations

import json
import logging
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

from clients.web.comparison import EyeName
from clients.web.eye_form import depends_on_gaze
from clients.web.picture import Picture, coarser, jpeg_of, png_of
from filter_service import EyeFilter, FilterError, FilterSettings, RgbdView
from filter_service.messages import State, WithState
from filter_service.settings import Pipeline

PAUSE_S = 0.12
"""Time without a newer request after which the full picture is computed."""

POLL_S = 0.002
"""Interval of polling an eye that is being prepared."""

STALE_S = 0.5
"""Maximum wait for a preview once a newer request has arrived."""

PSF_SLICE_S = 0.05
"""Time limit for computing PSFs between checks for newer requests."""

MS_PER_S = 1e3
FULL = FilterSettings()
QUICK = FULL.changed(mode="on-axis", eye_model="wavefront")
MIN_WIDTH_PX = 200
"""If the blur is too wide for the filter, pictures are reduced, down to this width."""

Kind = Literal["scene", "preview", "full", "failed"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PictureRequest(WithState):
    """One requested state of the page.

    Attributes
    ----------
    number : increases with each request
    bodies : profile of each eye shown
    """

    number: int
    picture: Picture
    bodies: Mapping[EyeName, Mapping[str, Any]]
    state: State
    pipeline: Pipeline = "exact"


@dataclass(frozen=True)
class SentPicture:
    """A picture to be sent to the browser.

    Attributes
    ----------
    kind : "scene" without the eye; "preview" or "full" through it; or "failed"
    number : of the request
    data : the encoded picture, empty on failure
    facts : further values for the page, plain types
    """

    kind: Kind
    eye: EyeName | None
    number: int
    data: bytes
    facts: Mapping[str, Any] = field(default_factory=dict)

    def packed(self) -> bytes:
        """Return the message: length of a JSON header, the header, the picture."""
        header = {"kind": self.kind, "eye": self.eye, "number": self.number}
        text = json.dumps({**header, **self.facts}).encode()
        return struct.pack("<I", len(text)) + text + self.data


class EyeView:
    """Pictures of one eye of one page; must be used from a single thread.

    Attributes
    ----------
    side : name of the eye or state
    seen : number of the last request that each kind of picture was returned for
    """

    def __init__(self, side: EyeName) -> None:
        self.side = side
        self.seen: dict[Kind, int] = {"preview": 0, "full": 0}
        self._filters: dict[Kind, EyeFilter] = {}
        self._profiles: dict[Kind, Any] = {}  # set last: body, settings and camera
        self._merge_factor = 1

    def picture(self, kind: Kind, request: PictureRequest) -> SentPicture | None:
        """Return a preview or a full picture; None while its eye is being prepared."""
        start_s = time.monotonic()
        if kind == "preview":
            self._stop_full(request)
        settings, view = self._seen_with(kind, request)
        try:
            eye_filter = self._prepared(kind, request, settings, view)
            seen = eye_filter.try_filter(
                [view],
                pupil_diameter_mm=request.pupil_diameter_mm,
                focus_dpt=request.focus_dpt,
                gaze_deg=settings.gaze_deg,
                newest_only=True,
                until_s=time.monotonic() + PSF_SLICE_S,
            )
        except FilterError as error:
            self._profiles.pop(kind, None)
            if kind == "full" and view.width_px >= 2 * MIN_WIDTH_PX:
                self._merge_factor *= 2
                return None
            self.seen[kind] = request.number
            return failed(self.side, request, str(error))
        if not seen:
            return None
        self.seen[kind] = request.number
        data = png_of(seen.color) if kind == "full" else jpeg_of(seen.color)
        facts = {
            "width_px": seen.color.shape[1],
            "height_px": seen.color.shape[0],
            "pupil_diameter_mm": round(seen.pupil_diameter_mm, 3),
            "focus_dpt": round(seen.focus_dpt, 3),
            "wanted_focus_dpt": request.focus_dpt,
            "frame_ms": round(sum(seen.stage_times_ms.values()), 2),
            "took_ms": round(MS_PER_S * (time.monotonic() - start_s), 2),
            "notes": list(seen.notes),
        }
        return SentPicture(kind, self.side, request.number, data, facts)

    def estimate(self, request: PictureRequest) -> None:
        """Start to estimate the eye of a full picture; errors follow in `picture`."""
        with suppress(FilterError):
            self._prepared("full", request, *self._seen_with("full", request))

    def _seen_with(
        self, kind: Kind, request: PictureRequest
    ) -> tuple[FilterSettings, RgbdView]:
        """Return the settings and the view of a kind of picture."""
        if kind == "preview":
            settings, view = QUICK, request.picture.small
            if depends_on_gaze(request.bodies[self.side]):
                settings = settings.changed(gaze_deg=request.gaze_deg)
        else:
            view = request.picture.view
            settings = FULL.changed(
                gaze_deg=request.gaze_deg, pipeline=request.pipeline
            )
            if self._merge_factor > 1:
                view = coarser(view, self._merge_factor)
        return settings.covering(foci_dpt=(request.focus_dpt,)), view

    def _prepared(
        self,
        kind: Kind,
        request: PictureRequest,
        settings: FilterSettings,
        view: RgbdView,
    ) -> EyeFilter:
        """Return the filter of a kind of picture, with the requested eye."""
        body = request.bodies[self.side]
        if kind not in self._filters:
            # A preview's eye is a formula, prepared in this thread within milliseconds.
            # In the worker it would wait for the estimate of an outdated full picture,
            # or for a new process if that had to be killed: up to 6 s.
            self._filters[kind] = EyeFilter(worker=kind != "preview")
        profile = body, settings, view.camera
        if profile != self._profiles.get(kind):
            self._filters[kind].set_profile(body, settings=settings, views=view.camera)
            self._profiles[kind] = profile
        return self._filters[kind]

    def _stop_full(self, request: PictureRequest) -> None:
        """Cancel the full eye if it is outdated, to free the worker."""
        if "full" not in self._profiles:
            return
        body, settings, _ = self._profiles["full"]
        wanted = (request.bodies[self.side], request.gaze_deg, request.pipeline)
        if (body, settings.gaze_deg, settings.pipeline) != wanted:
            self._filters.pop("full").close()
            del self._profiles["full"]
            self._merge_factor = 1

    def close(self) -> None:
        """Close the filters."""
        for eye_filter in self._filters.values():
            eye_filter.close()


def failed(side: EyeName, request: PictureRequest, reason: str) -> SentPicture:
    """Return a message that a picture failed, and why."""
    return SentPicture("failed", side, request.number, b"", {"error": reason})


@dataclass
class _Page:
    """One page: its newest request, the current one, and its eyes."""

    show: Callable[[SentPicture], Any]
    newest: PictureRequest | None = None
    arrived_s: float = 0.0
    is_single: bool = False  # the newest request came after a rest
    current: PictureRequest | None = None
    begun_s: float = 0.0
    eyes: dict[EyeName, EyeView] = field(default_factory=dict)

    def step(self) -> float | None:
        """Do a piece of work; return the time until the next step, in s, or None."""
        now_s = time.monotonic()
        if self.current is not self.newest and (
            self._has_all("preview") or now_s > self.begun_s + STALE_S
        ):
            self.current, self.begun_s = self.newest, now_s
        request = self.current
        if request is None:
            return None
        self._show("preview", request)
        if not self._has_all("preview"):
            return POLL_S
        if request is not self.newest:
            return 0.0
        if self._has_all("full"):
            return None
        pause_s = self.arrived_s + PAUSE_S - now_s
        if pause_s > 0.0:
            if self.is_single:
                self.is_single = False
                for side in request.bodies:
                    self.eyes[side].estimate(request)
            return pause_s
        self._show("full", request)
        if request is not self.newest:
            return 0.0
        return None if self._has_all("full") else POLL_S

    def _has_all(self, kind: Kind) -> bool:
        """Return whether the current request has all pictures of a kind."""
        request = self.current
        return request is None or all(
            side in self.eyes and self.eyes[side].seen[kind] >= request.number
            for side in request.bodies
        )

    def _show(self, kind: Kind, request: PictureRequest) -> None:
        """Show the missing pictures of a kind that are ready."""
        for side in request.bodies:
            eye = self.eyes.setdefault(side, EyeView(side))
            if kind == "full" and request is not self.newest:
                return
            if eye.seen[kind] < request.number:
                seen = eye.picture(kind, request)
                if seen is not None:
                    self.show(seen)

    def fail_request(self, reason: str) -> None:
        """Drop the current request and report why."""
        request, self.newest, self.current = self.current, None, None
        if request is not None:
            for side in request.bodies:
                self.show(failed(side, request, reason))

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

    def open(self, page: str, show: Callable[[SentPicture], Any]) -> None:
        """Register a page; ``show`` gets its pictures, in the filter thread."""
        self._pages[page] = _Page(show)

    def request(self, page: str, request: PictureRequest) -> None:
        """Request a picture; an older request is dropped."""
        known = self._pages.get(page)
        if known is not None:
            now_s = time.monotonic()
            known.is_single = now_s > known.arrived_s + PAUSE_S
            known.newest, known.arrived_s = request, now_s
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
        # The worker process ends with the last filter that uses it, and starting
        # another takes seconds.
        keeper: EyeFilter | None = None
        while not self._is_closed:
            if keeper is None and self._pages:
                with suppress(FilterError):  # the pages' own filters report it
                    keeper = EyeFilter()
            self._wake.clear()
            while self._closing_pages:
                self._closing_pages.pop().close()
            waits_s = list(self._step_all())
            self._wake.wait(min(waits_s, default=None))
        for page in [*self._pages.values(), *self._closing_pages]:
            page.close()
        if keeper is not None:
            keeper.close()

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
