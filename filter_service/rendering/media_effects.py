"""Effects of the ocular media and of spectacles, if a profile requests them.

Spectacles resample the view before it is filtered; the media change the filtered image.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.media import Straylight, channel_gains
from estimator.native import shared_threads
from estimator.profiles.parse import EyeProfile
from filter_service.constants import RGB
from filter_service.displays import display_wavelengths_nm
from filter_service.native import loops
from filter_service.rendering.edge_light import EdgeLight
from filter_service.rendering.engine import FrameEngine, Pending, ViewRequest
from filter_service.rendering.filtered_view import FilteredView
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.haze import add_haze
from filter_service.rendering.light_planes import add_plane
from filter_service.rendering.spectacles import (
    Matrix,
    seen_through,
    spectacle_magnification,
)
from filter_service.rendering.srgb import half_from_linear
from filter_service.rendering.white_level import white_level
from filter_service.rgbd_view import RgbdView

UNCHANGED = (1.0, 1.0, 1.0)
NOTHING = np.empty((0, 0, RGB), np.float32)


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


class _Stages:
    """Wall times of stages, ms."""

    def __init__(self) -> None:
        self.times_ms: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Start the next stage."""
        self._started_s = time.perf_counter()

    def end(self, name: str) -> None:
        """Add the time since the last end or start to a stage, and start the next."""
        elapsed_ms = 1e3 * (time.perf_counter() - self._started_s)
        self.times_ms[name] = self.times_ms.get(name, 0.0) + elapsed_ms
        self.start()


def begin_through_media(
    engine: FrameEngine, request: ViewRequest, effects: MediaEffects | None
) -> Pending:
    """Start filtering a view, with the media and with light beyond the kernels.

    See `FrameEngine.begin`.
    """
    stages = _Stages()
    view = request.view
    if effects is not None and effects.magnification_ratio is not None:
        view = seen_through(view, effects.magnification_ratio)
        request = replace(request, view=view)
        stages.end("media_ms")
    edge_light: EdgeLight | MissingPsfs | None = None
    if view.color.dtype != np.uint8:
        request = replace(request, white_level=white_level(view.color))
        edge_light = EdgeLight.of(engine, request)
    if isinstance(edge_light, MissingPsfs):
        missing = edge_light
        return lambda: missing
    if edge_light is not None:
        request = replace(request, view=edge_light.view)
        stages.end("edge_light_ms")
    elif effects is None:
        return engine.begin(request)
    begun = engine.begin(replace(request, output="linear", out=None))

    def finish() -> FilteredView | MissingPsfs:
        rendered = begun()
        if isinstance(rendered, MissingPsfs):
            return rendered
        stages.start()
        color = np.ascontiguousarray(rendered.color, dtype=np.float32)
        coarse = NOTHING
        if edge_light is not None:
            coarse = edge_light.add(color)
        if coarse.size and (effects is not None or request.output != "srgb8"):
            add_plane(coarse, color)
            coarse = NOTHING
        if edge_light is not None:
            stages.end("edge_light_ms")
        if effects is not None:
            effects.apply(color, view)
        color = encoded(color, request.output, coarse)
        stages.end("edge_light_ms" if effects is None else "media_ms")
        times_ms = {**rendered.stage_times_ms, **stages.times_ms}
        return replace(rendered, color=color, stage_times_ms=times_ms)

    return finish


def encoded(
    color: NDArray[np.float32], output: str, coarse: NDArray[np.float32] = NOTHING
) -> NDArray[Any]:
    """Return linear light in the encoding of an output.

    Parameters
    ----------
    coarse : (rows, columns, 3), optional
        Light on pixels of twice the size, added before the encoding as sRGB.
    """
    if output == "linear":
        return color
    if output == "linear16":
        return half_from_linear(color)
    found = np.empty(color.shape, np.uint8)
    loops().call(
        "add_and_encode",
        *(shared_threads(), coarse, *coarse.shape[:2]),
        *(np.ascontiguousarray(color), *color.shape[:2], found),
    )
    return found
