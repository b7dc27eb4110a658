"""Effects of the ocular media and of spectacles, if a profile requests them.

Spectacles resample the view before it is filtered; the media change the filtered image.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.media.absorption import channel_gains
from estimator.media.straylight import Straylight
from estimator.profiles.parse import EyeProfile
from filter_service.displays import display_wavelengths_nm
from filter_service.rendering.engine import FrameEngine, Pending, ViewRequest
from filter_service.rendering.filtered_view import FilteredView
from filter_service.rendering.haze import add_haze, run_in_threads
from filter_service.rendering.spectacles import (
    Matrix,
    seen_through,
    spectacle_magnification,
)
from filter_service.rendering.srgb import half_from_linear, srgb_from_linear
from filter_service.rgbd_view import RgbdView

UNCHANGED = (1.0, 1.0, 1.0)
ENCODE_STEPS = 1 << 16


@dataclass(frozen=True)
class MediaEffects:
    """Effects of one eye's media and spectacles on an image.

    Attributes
    ----------
    straylight : Straylight or None
    gain_ratio : (red, green, blue)
        Transmittance of the media relative to the eye that images are made for.
    magnification_ratio : (2, 2) or None
        Spectacle magnification, see `spectacles`.
    """

    straylight: Straylight | None
    gain_ratio: tuple[float, float, float] = UNCHANGED
    magnification_ratio: Matrix | None = None

    @classmethod
    def of(cls, profile: EyeProfile, display: str) -> MediaEffects | None:
        """Return the effects of a profile, or None if it has none."""
        gain_ratio = UNCHANGED
        if profile.yellowing is not None and profile.age_years is not None:
            red, green, blue = channel_gains(
                display_wavelengths_nm(display),
                age_years=profile.age_years,
                yellowing=profile.yellowing,
            ).tolist()
            gain_ratio = red, green, blue
        found = cls(profile.straylight, gain_ratio, spectacle_magnification(profile))
        return None if found == cls(None) else found

    @property
    def need_arrays(self) -> str | None:
        """Return the effect that frames in textures lack, in words, or None."""
        if self.magnification_ratio is not None:
            return "spectacle magnification"
        return "straylight" if self.straylight is not None else None

    def apply(self, color: NDArray[np.float32], view: RgbdView) -> None:
        """Apply the media to linear light (height, width, 3) of a view, in place."""
        if self.straylight is not None:
            add_haze(color, view.camera, self.straylight, self.gain_ratio)
        elif self.gain_ratio != UNCHANGED:
            color *= np.array(self.gain_ratio, np.float32)


def begin_through_media(
    engine: FrameEngine, request: ViewRequest, effects: MediaEffects | None
) -> Pending:
    """Start filtering a view with media effects; see `FrameEngine.begin`."""
    if effects is None:
        return engine.begin(request)
    started_s = time.perf_counter()
    output, view = request.output, request.view
    if effects.magnification_ratio is not None:
        view = seen_through(view, effects.magnification_ratio)
    before_s = time.perf_counter() - started_s
    begun = engine.begin(replace(request, view=view, output="linear", out=None))
    return partial(_finish, begun, effects, view, output, before_s)


def _finish(
    begun: Pending,
    effects: MediaEffects,
    view: RgbdView,
    output: str,
    before_s: float,
) -> FilteredView:
    rendered = begun()
    started_s = time.perf_counter()
    color = np.ascontiguousarray(rendered.color, dtype=np.float32)
    effects.apply(color, view)
    color = encoded(color, output)
    media_ms = 1e3 * (time.perf_counter() - started_s + before_s)
    stages_ms = {**rendered.stage_times_ms, "media_ms": media_ms}
    return replace(rendered, color=color, stage_times_ms=stages_ms)


def encoded(color: NDArray[np.float32], output: str) -> NDArray[Any]:
    """Return linear light in the encoding of an output."""
    if output == "linear":
        return color
    if output == "linear16":
        return half_from_linear(color)
    from filter_service.rendering.haze_loops import encode_srgb

    found = np.empty(color.shape, np.uint8)
    run_in_threads(
        encode_srgb, color.size, color.reshape(-1), _encoding(), found.reshape(-1)
    )
    return found


@lru_cache(maxsize=1)
def _encoding() -> NDArray[np.uint8]:
    return srgb_from_linear(np.linspace(0.0, 1.0, ENCODE_STEPS))
