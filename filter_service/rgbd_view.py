"""One view of a scene: color, depth and camera, for clients and engines.

A view may have a *hidden layer*: the image without the visible surface.
Its light is needed where the edges of that surface are blurred.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera, Tangents, camera_of
from filter_service.errors import BadMessage
from filter_service.settings import DEPTH_KINDS, DepthKind
from filter_service.validation import show

ColorImage = NDArray[np.uint8] | NDArray[np.float32] | NDArray[np.float16]
"""(height, width, 3): 8-bit sRGB, or linear light."""

MIN_DEPTH_M = 1e-6
"""Smaller depth counts as missing: no surface is nearer than a micrometer, and the
reciprocals of much smaller numbers exceed float32."""

COLOR_DTYPES = tuple(map(np.dtype, (np.uint8, np.float32, np.float16)))
DEPTH_DTYPE = np.dtype(np.float32)


@dataclass(frozen=True)
class RgbdView:
    """Color, depth and camera of one view.

    Attributes
    ----------
    color : (height, width, 3)
        uint8 sRGB; or float32 or float16 linear light, including values above 1 and
        below 0.
    depth_m : (height, width), float32
        +inf is infinity; NaN and less than `MIN_DEPTH_M` are missing.
    tangents : (left, right, up, down)
        Tangents of the angles to the image edges, left < right and down < up.
    depth_kind : "planar" or "radial"
        View-space z, or distance from the eye.
    hidden_color, hidden_depth_m : like color and depth_m, optional
        Hidden layer: both or neither.  Where depth is 0, negative or NaN, nothing is
        hidden and nothing is filled in.

    Raises
    ------
    BadMessage
        If the arrays are not a valid RGB-D image (a ValueError, too).
    """

    color: ColorImage
    depth_m: NDArray[np.float32]
    tangents: Tangents
    depth_kind: DepthKind = "planar"
    hidden_color: ColorImage | None = None
    hidden_depth_m: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Validate the arrays."""
        color, depth_m = self.color, self.depth_m
        _check_plain("color", color, "an array (height, width, 3)")
        _check_plain("depth", depth_m, "an array (height, width)")
        if color.ndim != 3 or color.shape[2] != 3 or 0 in color.shape:
            raise BadMessage(
                f"it has shape {color.shape}",
                field="color",
                allowed="(height, width, 3)",
            )
        if color.dtype not in COLOR_DTYPES:
            raise BadMessage(
                f"it is {color.dtype}",
                field="color",
                allowed="uint8 sRGB, float32 or float16 linear",
            )
        if depth_m.shape != color.shape[:2] or depth_m.dtype != DEPTH_DTYPE:
            raise BadMessage(
                f"it is {depth_m.dtype} of shape {depth_m.shape}",
                field="depth",
                allowed=f"float32 of shape {color.shape[:2]}",
            )
        if self.depth_kind not in DEPTH_KINDS:
            raise BadMessage(
                f"it is {self.depth_kind!r}",
                field="depth.kind",
                allowed=", ".join(DEPTH_KINDS),
            )
        if self.hidden_color is not None or self.hidden_depth_m is not None:
            self._check_hidden()
        object.__setattr__(self, "tangents", self.camera.tangents)  # as floats

    def _check_hidden(self) -> None:
        """Reject a hidden layer whose types or shapes differ from the visible one's."""
        for field, image, seen in (
            ("hidden_color", self.hidden_color, self.color),
            ("hidden_depth", self.hidden_depth_m, self.depth_m),
        ):
            wanted = f"{seen.dtype} of shape {seen.shape}"
            found = "missing"
            if image is not None:
                _check_plain(field, image, wanted)
                found = f"{image.dtype} of shape {image.shape}"
            if found != wanted:
                raise BadMessage(f"it is {found}", field=field, allowed=wanted)

    @cached_property
    def camera(self) -> Camera:
        """The camera of this view."""
        return camera_of(self.width_px, self.height_px, self.tangents)

    @property
    def width_px(self) -> int:
        """Return the number of columns."""
        return int(self.color.shape[1])

    @property
    def height_px(self) -> int:
        """Return the number of rows."""
        return int(self.color.shape[0])

    @property
    def surface_count(self) -> int:
        """Return 1, or 2 with a hidden layer."""
        return 1 if self.hidden_depth_m is None else 2

    @property
    def surface_colors(self) -> tuple[Any, ...]:
        """Return the color of each surface."""
        return (self.color, self.hidden_color)[: self.surface_count]

    @property
    def surface_depths_m(self) -> tuple[Any, ...]:
        """Return the depth of each surface."""
        return (self.depth_m, self.hidden_depth_m)[: self.surface_count]

    @property
    def images(self) -> tuple[NDArray[Any], ...]:
        """Return color and depth, followed by the hidden layer if there is one."""
        surfaces = zip(self.surface_colors, self.surface_depths_m, strict=True)
        return tuple(image for surface in surfaces for image in surface)


def _check_plain(field: str, image: object, allowed: str) -> None:
    """Reject values other than arrays, and masked arrays, whose mask would be lost."""
    if type(image) is np.ndarray:
        return
    if isinstance(image, np.ma.MaskedArray):
        raise BadMessage(
            f"it is a masked array with {np.asarray(image.mask).sum()} masked values",
            field=field,
            allowed="a plain array, as from its method filled(0)",
        )
    if not isinstance(image, np.ndarray):
        raise BadMessage(f"it is {show(image)}", field=field, allowed=allowed)


def as_views(
    color: ColorImage | RgbdView | Sequence[RgbdView],
    depth_m: NDArray[np.float32] | None,
    camera: Camera | None,
) -> tuple[RgbdView, ...]:
    """Return the views of a frame, given as views or as arrays and a camera.

    Raises
    ------
    BadMessage
        If arrays have no depth or camera, views come with separate depth, or the input
        has another type.
    """
    if isinstance(color, np.ndarray):
        if depth_m is None:
            raise BadMessage("it is missing", field="depth", allowed="depth in meters")
        if camera is None:
            raise BadMessage(
                "it is missing", field="camera", allowed="a camera, or an RgbdView"
            )
        return (RgbdView(color, depth_m, camera.tangents),)
    _check_views(color)
    if depth_m is not None:
        raise BadMessage(
            "it is given twice", field="depth", allowed="arrays, or an RgbdView"
        )
    return (color,) if isinstance(color, RgbdView) else tuple(color)


def _check_views(color: object) -> None:
    views = color if isinstance(color, Sequence) else [color]
    for view in views:
        if not isinstance(view, RgbdView):
            inside = f" of {type(view).__name__}" if view is not color else ""
            raise BadMessage(
                f"a {type(color).__name__}{inside}",
                field="color",
                allowed="an array (height, width, 3), an RgbdView, or several",
            )


def as_cameras(
    views: Camera | RgbdView | Sequence[Camera | RgbdView],
) -> tuple[Camera, ...]:
    """Return the cameras of one or several cameras or views.

    Raises
    ------
    BadMessage
        If an item is neither.
    """
    given = (views,) if isinstance(views, Camera | RgbdView) else tuple(views)
    found = []
    for view in given:
        camera = view.camera if isinstance(view, RgbdView) else view
        if not isinstance(camera, Camera):
            raise BadMessage(
                f"{camera!r}", field="camera", allowed="a Camera, or a sequence of them"
            )
        found.append(camera)
    return tuple(found)
