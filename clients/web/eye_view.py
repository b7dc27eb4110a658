"""One eye as the page shows it: a fast preview, then the full picture.

The preview uses the on-axis wavefront from a formula and takes some hundredths of a
second; the full picture uses the eye ray-traced over its field.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from clients.web.correction_form import depends_on_gaze
from clients.web.eye_form import EyeSide
from clients.web.picture import coarser
from clients.web.picture_files import jpeg_of, png_of
from clients.web.picture_requests import Kind, PictureRequest, SentPicture
from filter_service import (
    EyeFilter,
    Filtered,
    FilterError,
    FilterSettings,
    Preparing,
    RgbdView,
)

MS_PER_S = 1e3
PSF_SLICE_S = 0.05
"""Time limit for computing PSFs between checks for newer requests."""

FULL = FilterSettings()
QUICK = FULL.changed(mode="on-axis", eye_model="wavefront")
MIN_WIDTH_PX = 200
"""If the blur is too wide for the filter, pictures are reduced, down to this width."""


@dataclass
class _ProfiledFilter:
    """A filter and the profile set last."""

    filter: EyeFilter
    profile_key: Any = None

    def set_profile(
        self, body: Mapping[str, Any], settings: FilterSettings, view: RgbdView
    ) -> None:
        """Set the profile if it has changed."""
        profile_key = (body, settings, view.camera)
        if profile_key != self.profile_key:
            self.profile_key = profile_key
            self.filter.set_profile(body, settings=settings, cameras=[view.camera])

    def filter_view(
        self, view: RgbdView, request: PictureRequest, *, gaze_deg: tuple[float, float]
    ) -> Filtered | Preparing:
        """Return the picture through the newest eye, unless it is being prepared."""
        state: dict[str, Any] = {
            "pupil_diameter_mm": request.pupil_diameter_mm,
            "focus_dpt": request.focus_dpt,
        }
        seen = self.filter.try_filter(
            [view],
            **state,
            gaze_deg=gaze_deg,
            newest_only=True,
            until_s=time.monotonic() + PSF_SLICE_S,
        )
        self.filter.advance()  # this frame has requested its PSFs
        return seen


class EyeView:
    """Pictures of one eye of one page; must be used from a single thread.

    Parameters
    ----------
    side : "OD" or "OS"
    """

    def __init__(self, side: EyeSide) -> None:
        self.side = side
        self._quick: _ProfiledFilter | None = None
        self._full: _ProfiledFilter | None = None
        self._merge_factor = 1
        self.seen: dict[Kind, int] = {"preview": 0, "full": 0}

    def preview(self, request: PictureRequest) -> SentPicture | None:
        """Return the preview; None while its eye is being prepared."""
        self._stop_other(request)
        if self._quick is None:
            self._quick = _ProfiledFilter(EyeFilter())
        settings = QUICK.covering(foci_dpt=(request.focus_dpt,))
        if depends_on_gaze(request.bodies[self.side]):
            settings = settings.changed(gaze_deg=request.gaze_deg)
        return self._filter(
            self._quick, "preview", request, settings, request.picture.small
        )

    def full(self, request: PictureRequest) -> SentPicture | None:
        """Return the full picture; None while its eye is being prepared."""
        if self._full is None:
            self._full = _ProfiledFilter(EyeFilter())
        settings = FULL.covering(foci_dpt=(request.focus_dpt,)).changed(
            gaze_deg=request.gaze_deg, pipeline=request.pipeline
        )
        view = request.picture.view
        if self._merge_factor > 1:
            view = coarser(view, self._merge_factor)
        return self._filter(self._full, "full", request, settings, view)

    def _stop_other(self, request: PictureRequest) -> None:
        """Cancel the full eye if it is outdated, to free the worker."""
        full = self._full
        if full is None or full.profile_key is None:
            return
        body, settings, _ = full.profile_key
        wanted = (request.bodies[self.side], request.gaze_deg, request.pipeline)
        if (body, settings.gaze_deg, settings.pipeline) != wanted:
            full.filter.close()
            self._full, self._merge_factor = None, 1

    def _filter(
        self,
        eye_filter: _ProfiledFilter,
        kind: Kind,
        request: PictureRequest,
        settings: FilterSettings,
        view: RgbdView,
    ) -> SentPicture | None:
        start_s = time.monotonic()
        try:
            eye_filter.set_profile(request.bodies[self.side], settings, view)
            seen = eye_filter.filter_view(view, request, gaze_deg=settings.gaze_deg)
        except FilterError as error:
            eye_filter.profile_key = None
            if kind == "full" and view.width_px >= 2 * MIN_WIDTH_PX:
                self._merge_factor *= 2
                return None
            self.seen[kind] = request.number
            return SentPicture(
                "failed", self.side, request.number, b"", {"error": str(error)}
            )
        if not seen:
            return None
        self.seen[kind] = request.number
        encode = png_of if kind == "full" else jpeg_of
        return SentPicture(
            kind,
            self.side,
            request.number,
            encode(seen.color),
            _facts(seen, request, MS_PER_S * (time.monotonic() - start_s)),
        )

    def close(self) -> None:
        """Close the filters."""
        for eye_filter in (self._quick, self._full):
            if eye_filter is not None:
                eye_filter.filter.close()
        self._quick = self._full = None


def _facts(seen: Filtered, request: PictureRequest, took_ms: float) -> dict[str, Any]:
    return {
        "width_px": seen.color.shape[1],
        "height_px": seen.color.shape[0],
        "pupil_diameter_mm": round(seen.pupil_diameter_mm, 3),
        "focus_dpt": round(seen.focus_dpt, 3),
        "wanted_focus_dpt": request.focus_dpt,
        "frame_ms": round(sum(seen.stage_times_ms.values()), 2),
        "took_ms": round(took_ms, 2),
        "notes": list(seen.notes),
    }
