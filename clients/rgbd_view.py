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
    """

    color: NDArray[Any]
    depth_m: NDArray[np.float32]
    tangents: tuple[float, float, float, float]
    depth_kind: str = "planar"

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

    @property
    def camera(self) -> Camera:
        """Return the camera of this view."""
        height_px, width_px = self.depth_m.shape
        return Camera(width_px, height_px, tuple(float(t) for t in self.tangents))

    @property
    def header(self) -> ViewHeader:
        """Return what a frame's header says about this view."""
        color = COLOR_FORMATS[self.color.dtype.type]
        return ViewHeader(self.camera, color, self.depth_kind)
