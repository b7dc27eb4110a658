"""An RGB-D image with its camera, as a client hands it to the filter service."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.messages import LINEAR, LINEAR16, SRGB8, Camera, ViewHeader

COLOR_FORMATS = {np.uint8: SRGB8, np.float32: LINEAR, np.float16: LINEAR16}


def tangents_from_fov(
    vertical_fov_deg: float, width_px: int, height_px: int
) -> tuple[float, float, float, float]:
    """Return (left, right, up, down) of a symmetric camera with square pixels."""
    if not 0 < vertical_fov_deg < 174:
        raise ValueError(f"vertical_fov_deg is {vertical_fov_deg}; allowed: 0 to 174")
    up = math.tan(math.radians(vertical_fov_deg) / 2)
    right = up * width_px / height_px
    return (-right, right, up, -up)


@dataclass(frozen=True)
class RgbdView:
    """One view of a scene.

    Parameters
    ----------
    color : (height, width, 3) uint8 sRGB, or float32 or float16 linear
        Linear light may be above 1, and negative in a wide gamut.
    depth_m : (height, width) float32, metres
        View-space z (``planar``) or distance (``radial``).  +inf is infinity;
        0, negative and NaN are missing.
    tangents : 4 floats
        (left, right, up, down) of the image edges, left < right and down < up.
    depth_kind : {"planar", "radial"}
    hidden_color, hidden_depth_m : like color and depth_m, optional
        What the camera would see with what it sees taken away; both or neither.  Depth
        of 0, negative or NaN: nothing is hidden here.
    """

    color: NDArray[Any]
    depth_m: NDArray[np.float32]
    tangents: tuple[float, float, float, float]
    depth_kind: str = "planar"
    hidden_color: NDArray[Any] | None = None
    hidden_depth_m: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Refuse arrays that are no RGB-D image."""
        if self.color.ndim != 3 or self.color.shape[2] != 3:
            raise ValueError(
                f"color has shape {self.color.shape}; allowed: (height, width, 3)"
            )
        if self.color.dtype.type not in COLOR_FORMATS:
            raise ValueError(
                f"color is {self.color.dtype}; allowed: uint8 (sRGB), float32 or "
                "float16 (linear)"
            )
        if self.depth_m.shape != self.color.shape[:2]:
            raise ValueError(
                f"depth_m has shape {self.depth_m.shape}; the colour needs "
                f"{self.color.shape[:2]}"
            )
        if self.depth_m.dtype != np.float32:
            raise ValueError(f"depth_m is {self.depth_m.dtype}; allowed: float32")
        if self.hidden_color is not None or self.hidden_depth_m is not None:
            self._check_hidden()

    def _check_hidden(self) -> None:
        for name, seen in (("hidden_color", "color"), ("hidden_depth_m", "depth_m")):
            image, like = getattr(self, name), getattr(self, seen)
            if image is None:
                raise ValueError(f"{name} is missing; allowed: both layers or neither")
            if image.shape != like.shape or image.dtype != like.dtype:
                raise ValueError(
                    f"{name} is {image.dtype} of shape {image.shape}; allowed: as "
                    f"{seen}, {like.dtype} of shape {like.shape}"
                )

    @property
    def images(self) -> tuple[NDArray[Any], ...]:
        """Return colour and depth, and those of the hidden layer if there is one."""
        images = (self.color, self.depth_m, self.hidden_color, self.hidden_depth_m)
        return images[: self.header.part_count]

    @property
    def camera(self) -> Camera:
        """Return the camera of this view."""
        height_px, width_px = self.depth_m.shape
        return Camera(width_px, height_px, tuple(float(t) for t in self.tangents))

    @property
    def header(self) -> ViewHeader:
        """Return what a frame's header says about this view."""
        color = COLOR_FORMATS[self.color.dtype.type]
        has_hidden = self.hidden_depth_m is not None
        return ViewHeader(self.camera, color, self.depth_kind, has_hidden)
