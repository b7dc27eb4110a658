"""Pixels of a picture on a display, and the visual angle of each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service import Camera

ARCMIN_PER_DEG = 60.0
SIDE_LIMITS_PX = (8, 4096)
PIXEL_LIMITS_ARCMIN = (0.01, 60.0)
SCREEN_LIMITS_MM = (1.0, 100_000.0)
SCREEN_LIMITS_PX = (8, 100_000)
DISTANCE_LIMITS_M = (0.05, 1000.0)
WHITE_LIMITS_NIT = (0.01, 100_000.0)

SAME_PITCH_RATIO = 0.005
"""Tolerance between a given pixel and that of a screen at its distance."""


def check(name: str, value: float, limits: tuple[float, float], unit: str = "") -> None:
    """Raise ValueError unless a parameter is within limits."""
    low, high = limits
    if not low <= value <= high:
        allowed = f"{low:g} to {high:g}{' ' + unit if unit else ''}"
        raise ValueError(f"{name} is {value:g}; allowed: {allowed}")


@dataclass(frozen=True, kw_only=True)
class Display:
    """Pixels of a picture in the middle of a flat display that faces the viewer.

    Visual angles are those about the middle of the picture: an object that subtends
    the angle a there is 2 tan(a / 2) wide on a display at unit distance.  Spatial
    frequencies are those in the middle.

    Parameters
    ----------
    width_px, height_px : int
        Size of the picture, 8 to 4096 px.
    pixel_arcmin : float
        Visual angle of a square pixel in the middle, arcmin.
    white_nit : float, optional
        Luminance of white, cd/m².  With it, stimuli state their luminances.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    width_px: int
    height_px: int
    pixel_arcmin: float
    white_nit: float | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("width_px", "height_px"):
            side_px = getattr(self, name)
            if side_px != int(side_px):
                raise ValueError(f"{name} is {side_px!r}; allowed: an integer")
            check(name, side_px, SIDE_LIMITS_PX, "px")
        check("pixel_arcmin", self.pixel_arcmin, PIXEL_LIMITS_ARCMIN, "arcmin")
        if self.white_nit is not None:
            check("white_nit", self.white_nit, WHITE_LIMITS_NIT, "nit")

    @classmethod
    def of_screen(
        cls,
        *,
        width_px: int,
        height_px: int,
        screen_width_mm: float,
        screen_width_px: int,
        distance_m: float,
        pixel_arcmin: float | None = None,
        white_nit: float | None = None,
    ) -> Display:
        """Return a picture on a screen of known width and distance.

        Parameters
        ----------
        width_px, height_px : int
            Size of the picture.
        screen_width_mm : float
            Width of the screen.
        screen_width_px : int
            Pixels across the screen.
        distance_m : float
            Distance from the eye to the screen.
        pixel_arcmin : float, optional
            Expected visual angle of a pixel, to be checked.
        white_nit : float, optional
            Luminance of white, cd/m².

        Raises
        ------
        ValueError
            If a value is out of range, the picture is wider than the screen, or the
            pixel of the screen differs from ``pixel_arcmin`` by more than 0.5 %.  The
            message names both.
        """
        check("screen_width_mm", screen_width_mm, SCREEN_LIMITS_MM, "mm")
        check("screen_width_px", screen_width_px, SCREEN_LIMITS_PX, "px")
        check("distance_m", distance_m, DISTANCE_LIMITS_M, "m")
        if width_px > screen_width_px:
            raise ValueError(
                f"width_px is {width_px}; allowed: up to {screen_width_px}, the width "
                "of the screen"
            )
        pitch_ratio = screen_width_mm / 1000.0 / screen_width_px / distance_m
        found_arcmin = ARCMIN_PER_DEG * math.degrees(math.atan(pitch_ratio))
        if pixel_arcmin is not None and not math.isclose(
            pixel_arcmin, found_arcmin, rel_tol=SAME_PITCH_RATIO
        ):
            raise ValueError(
                f"pixel_arcmin is {pixel_arcmin:g}, but a pixel of {screen_width_mm:g} "
                f"mm / {screen_width_px} px at {distance_m:g} m is {found_arcmin:.5g} "
                "arcmin; allowed: one of them, or values that agree to 0.5 %"
            )
        return cls(
            width_px=width_px,
            height_px=height_px,
            pixel_arcmin=found_arcmin,
            white_nit=white_nit,
        )

    @property
    def pitch_ratio(self) -> float:
        """Width of a pixel relative to its distance: the tangent of its angle."""
        return math.tan(math.radians(self.pixel_arcmin / ARCMIN_PER_DEG))

    @cached_property
    def camera(self) -> Camera:
        """Camera whose image is the picture."""
        focal_px = 1.0 / self.pitch_ratio
        return Camera.from_intrinsics(
            *(focal_px, focal_px),
            *(0.5 * (self.width_px - 1), 0.5 * (self.height_px - 1)),
            width_px=self.width_px,
            height_px=self.height_px,
        )

    def size_px(self, angle_arcmin: float) -> float:
        """Return the size in px of an angle about the middle of the picture."""
        half = math.radians(0.5 * angle_arcmin / ARCMIN_PER_DEG)
        return 2.0 * math.tan(half) / self.pitch_ratio

    def cycles_per_px(self, frequency_cpd: float) -> float:
        """Return a spatial frequency in the middle of the picture in cycles per px."""
        return frequency_cpd * math.degrees(self.pitch_ratio)

    def places_px(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the centers of pixels from the middle, x (1, width), y (height, 1).

        x points right, and y up.
        """
        x_px = np.arange(self.width_px) - 0.5 * (self.width_px - 1)
        y_px = 0.5 * (self.height_px - 1) - np.arange(self.height_px)
        return x_px[None, :], y_px[:, None]

    def described(self) -> dict[str, Any]:
        """Return the calibration, for JSON."""
        return {
            "width_px": self.width_px,
            "height_px": self.height_px,
            "pixel_arcmin": self.pixel_arcmin,
            "white_nit": self.white_nit,
        }
