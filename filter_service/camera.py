"""A pinhole camera, and whether two cameras can share a PSF store.

An on-axis store depends only on the pixel pitch of a camera.  A store with PSFs that
vary over the visual field contains kernels for directions in one image, transformed by
its local scale, so it fits only cameras with the same view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, cast

from msgspec import Meta

from filter_service.errors import BadMessage
from filter_service.validation import Record, checked, show

MAX_SIDE_PX = 16384
MAX_TANGENT = 20.0  # 87 degrees to one side; a pinhole image cannot use more
MIN_EXTENT = 1e-6

SAME_RATIO = 1e-3
"""Tolerance relative to the pixel pitch and to the image's extent: a kernel of 255 px
is then accurate to a quarter of a pixel, and a direction to about one."""

SidePx = Annotated[int, Meta(ge=1, le=MAX_SIDE_PX)]
Tangent = Annotated[float, Meta(ge=-MAX_TANGENT, le=MAX_TANGENT)]
Tangents = tuple[Tangent, Tangent, Tangent, Tangent]


def tangents_from_fov(
    vertical_fov_deg: float, width_px: int, height_px: int
) -> tuple[float, float, float, float]:
    """Return (left, right, up, down) of a symmetric camera with square pixels.

    Raises
    ------
    ValueError
        If the field of view is impossible for a pinhole.
    """
    if not 0 < vertical_fov_deg < 174:
        raise ValueError(f"vertical_fov_deg is {vertical_fov_deg}; allowed: 0 to 174")
    up = math.tan(math.radians(vertical_fov_deg) / 2)
    right = up * width_px / height_px
    return (-right, right, up, -up)


def read_intrinsics(text: str) -> tuple[float, float, float, float]:
    """Return focal lengths and principal point, px, from the option ``--intrinsics``.

    Raises
    ------
    ValueError
        If there are not four numbers, or a focal length is not positive.
    """
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        fx = fy = cx = cy = math.nan
    if not (min(fx, fy) > 0.0 and all(map(math.isfinite, (fx, fy, cx, cy)))):
        raise ValueError(f"--intrinsics is {text!r}; allowed: FX,FY,CX,CY in px")
    return fx, fy, cx, cy


@dataclass(frozen=True)
class Camera(Record):
    """A pinhole: image size, tangents to the left, right, upper and lower edge.

    Attributes
    ----------
    width_px, height_px : int, 1 to 16384
    tangents : (left, right, up, down)
        Tangents of the angles to the image edges, left < right and down < up, within
        20.

    Raises
    ------
    BadMessage
        If a size or tangent is out of range, or edges are on the wrong sides.
    """

    width_px: SidePx
    height_px: SidePx
    tangents: Tangents

    def __post_init__(self) -> None:
        """Validate the fields; convert NumPy numbers and lists to Python's types."""
        for name in ("width_px", "height_px"):
            object.__setattr__(self, name, checked(getattr(self, name), SidePx, name))
        # mypy does not accept an alias of a tuple as a type.
        kind = cast("type[Tangents]", Tangents)
        tangents = checked(self.tangents, kind, "tangents")
        left, right, up, down = tangents
        if right - left < MIN_EXTENT or up - down < MIN_EXTENT:
            raise BadMessage(
                f"they are {show(list(tangents))}",
                field="tangents",
                allowed="(left, right, up, down) with left < right and down < up",
            )
        object.__setattr__(self, "tangents", tangents)

    @classmethod
    def from_fov(
        cls, vertical_fov_deg: float, *, width_px: int, height_px: int
    ) -> Camera:
        """Return a symmetric camera with square pixels.

        Raises
        ------
        ValueError
            If the field of view or size is impossible for a pinhole.
        """
        tangents = tangents_from_fov(vertical_fov_deg, width_px, height_px)
        return cls(width_px, height_px, tangents)

    @classmethod
    def from_intrinsics(
        cls,
        focal_x_px: float,
        focal_y_px: float,
        center_x_px: float,
        center_y_px: float,
        *,
        width_px: int,
        height_px: int,
    ) -> Camera:
        """Return a calibrated camera without distortion.

        Parameters
        ----------
        focal_x_px, focal_y_px : float
        center_x_px, center_y_px : float
            Principal point; the center of pixel (0, 0) is at (0, 0), as in OpenCV and
            ROS.  The image ends half a pixel beyond the centers of its outermost
            pixels.
        width_px, height_px : int

        Raises
        ------
        BadMessage
            If the size or edges are impossible for a pinhole.
        """
        tangents = (
            -(center_x_px + 0.5) / focal_x_px,
            (width_px - 0.5 - center_x_px) / focal_x_px,
            (center_y_px + 0.5) / focal_y_px,
            -(height_px - 0.5 - center_y_px) / focal_y_px,
        )
        return cls(width_px, height_px, tangents)

    @property
    def corner_distance_ratio(self) -> float:
        """Return the distance of the farthest corner per unit of planar depth."""
        left, right, up, down = self.tangents
        across, along = max(abs(left), abs(right)), max(abs(up), abs(down))
        return math.sqrt(1.0 + across**2 + along**2)

    @property
    def pixel_pitch_mrad(self) -> tuple[float, float]:
        """Return the angle of one pixel on the axis, (x, y), in mrad."""
        left, right, up, down = self.tangents
        return (
            1000.0 * (right - left) / self.width_px,
            1000.0 * (up - down) / self.height_px,
        )

    @property
    def pixel_count(self) -> int:
        """Return width times height."""
        return self.width_px * self.height_px


def is_same_camera(first: Camera, second: Camera, *, follows_field: bool) -> bool:
    """Return whether both cameras can share a PSF store.

    Parameters
    ----------
    follows_field : bool
        Whether the PSFs of the store vary over the visual field.
    """
    pitches = zip(first.pixel_pitch_mrad, second.pixel_pitch_mrad, strict=True)
    if any(abs(a / b - 1.0) > SAME_RATIO for a, b in pitches):
        return False
    return not follows_field or _has_same_view(first, second)


def _has_same_view(first: Camera, second: Camera) -> bool:
    if (first.width_px, first.height_px) != (second.width_px, second.height_px):
        return False
    left, right, up, down = second.tangents
    extents = (right - left, right - left, up - down, up - down)
    return all(
        abs(a - b) <= SAME_RATIO * extent
        for a, b, extent in zip(first.tangents, second.tangents, extents, strict=True)
    )


def distinct_cameras(
    cameras: Sequence[Camera], *, follows_field: bool
) -> tuple[Camera, ...]:
    """Return the cameras that need a store of their own, in order."""
    distinct: list[Camera] = []
    for camera in cameras:
        if not any(
            is_same_camera(known, camera, follows_field=follows_field)
            for known in distinct
        ):
            distinct.append(camera)
    return tuple(distinct)
