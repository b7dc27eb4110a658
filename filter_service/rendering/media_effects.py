"""Effects of the ocular media and of spectacles, if a profile requests them.

Spectacles resample the view before it is filtered; the media change the filtered image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.media import Straylight, channel_gains
from estimator.native import shared_threads
from estimator.profiles.parse import EyeProfile
from filter_service.constants import RGB
from filter_service.displays import display_wavelengths_nm
from filter_service.errors import BadMessage
from filter_service.native import loops
from filter_service.rendering.edge_light import EdgeLight
from filter_service.rendering.engine import (
    FrameEngine,
    Pending,
    ViewRequest,
    ViewResult,
)
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
from filter_service.texture_view import TextureView

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

    def check_textures(self) -> None:
        """Raise BadMessage for an effect that frames in textures lack."""
        for name, effect in (
            ("spectacle magnification", self.magnification_ratio),
            ("straylight", self.straylight),
        ):
            if effect is not None:
                raise BadMessage(
                    f"it has {name}",
                    field="profile",
                    allowed="none for frames in textures; filter frames of arrays",
                )

    def apply(self, color: NDArray[np.float32], view: RgbdView) -> None:
        """Apply the media to linear light (height, width, 3) of a view, in place."""
        if self.straylight is not None:
            add_haze(color, view.camera, self.straylight, self.gain_ratio)
        elif self.gain_ratio != UNCHANGED:
            color *= np.array(self.gain_ratio, np.float32)


def begin_through_media(
    engine: FrameEngine, request: ViewRequest, effects: MediaEffects | None
) -> Pending:
    """Start filtering a view, with the media and with light beyond the kernels.

    See `FrameEngine.begin`.

    Raises
    ------
    BadMessage
        In addition to its errors: effects need arrays, and the view is in textures.
    """
    view, times = request.view, request.times
    if isinstance(view, TextureView):
        if effects is not None:
            effects.check_textures()
            request = replace(request, gain_ratio=effects.gain_ratio)
        return engine.begin(request)
    if effects is not None and effects.magnification_ratio is not None:
        with times.wall("media_ms"):
            view = seen_through(view, effects.magnification_ratio)
        request = replace(request, view=view)
    edge_light: EdgeLight | MissingPsfs | None = None
    if view.color.dtype != np.uint8:
        request = replace(request, white_level=white_level(view.color))
        edge_light = EdgeLight.of(request, view)
    if isinstance(edge_light, MissingPsfs):
        missing = edge_light
        return lambda: missing
    if edge_light is not None:
        request = replace(request, view=edge_light.view)
    elif effects is None:
        return engine.begin(request)
    begun = engine.begin(replace(request, output="linear", out=None))

    def finish() -> ViewResult | MissingPsfs:
        rendered = begun()
        if isinstance(rendered, MissingPsfs):
            return rendered
        color = np.ascontiguousarray(rendered.color, dtype=np.float32)
        coarse = NOTHING
        if edge_light is not None:
            with times.wall("edge_light_ms"):
                coarse = edge_light.add(color)
                if coarse.size and (effects is not None or request.output != "srgb8"):
                    add_plane(coarse, color)
                    coarse = NOTHING
        with times.wall("edge_light_ms" if effects is None else "media_ms"):
            if effects is not None:
                effects.apply(color, view)
            color = encoded(color, request.output, coarse)
        return replace(rendered, color=color)

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
