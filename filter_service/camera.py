"""A pinhole camera, and whether two cameras can share a PSF store.

An on-axis store depends only on the pixel pitch of a camera.  A store with PSFs that
vary over the visual field contains kernels for directions in one image, transformed by
its local scale, so it fits only cameras with the same view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
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


PIXEL_ASPECT_LIMITS = (0.1, 10.0)
"""Width of a pixel relative to its height: 2 in anamorphic film, 0.9 to 1.5 in DV."""


def tangents_from_fov(
    vertical_fov_deg: float,
    width_px: int,
    height_px: int,
    *,
    pixel_aspect_ratio: float = 1.0,
) -> tuple[float, float, float, float]:
    """Return (left, right, up, down) of a symmetric camera.

    Parameters
    ----------
    pixel_aspect_ratio : float
        Width of a pixel relative to its height.

    Raises
    ------
    ValueError
        If the field of view or the ratio of the sides is impossible for a pinhole.
    """
    if not 0 < vertical_fov_deg < 174:
        raise ValueError(f"vertical_fov_deg is {vertical_fov_deg}; allowed: 0 to 174")
    up = math.tan(math.radians(vertical_fov_deg) / 2)
    right = up * pixel_aspect_ratio * width_px / height_px
    if right > MAX_TANGENT and up <= MAX_TANGENT:
        raise BadMessage(
            f"a vertical field of view of {vertical_fov_deg:g} deg reaches "
            f"{math.degrees(math.atan(right)):.3g} deg to each side of an image of "
            f"{width_px}x{height_px} px",
            field="camera",
            allowed=f"{math.degrees(math.atan(MAX_TANGENT)):.3g} deg; the width and "
            "height of one image",
        )
    return (-right, right, up, -up)


@dataclass(frozen=True)
class PixelGrid:
    """Pixels of an image as a part of the picture that a camera took.

    Attributes
    ----------
    width_px, height_px : int
        Size of the image.
    left_px, top_px : int
        Place of its first pixel in the picture; negative if the image is larger.
    full_width_px, full_height_px : int
        Size of the picture; 0 stands for the size of the image.
    pixel_aspect_ratio : float
        Width of a pixel relative to its height.
    """

    width_px: int
    height_px: int
    left_px: int = 0
    top_px: int = 0
    full_width_px: int = 0
    full_height_px: int = 0
    pixel_aspect_ratio: float = 1.0

    def __post_init__(self) -> None:
        """Replace a size of 0."""
        for name in ("width_px", "height_px"):
            full = getattr(self, f"full_{name}") or getattr(self, name)
            object.__setattr__(self, f"full_{name}", full)

    @property
    def is_part(self) -> bool:
        """Return whether the image is not the whole picture."""
        return self.window != (0, 0, self.width_px, self.height_px)

    @property
    def window(self) -> tuple[int, int, int, int]:
        """Return the place of the first pixel and the size of the picture."""
        return self.left_px, self.top_px, self.full_width_px, self.full_height_px

    def difference(self, other: PixelGrid) -> tuple[str, str] | None:
        """Return size or place of another image and of this one, if they differ."""
        size, other_size = (
            f"{grid.width_px}x{grid.height_px}" for grid in (self, other)
        )
        if size != other_size:
            return f"{other_size} px", size
        if self.window == other.window or not (self.is_part and other.is_part):
            return None
        own, others = (
            f"at {grid.left_px},{grid.top_px} px of {grid.full_width_px}x"
            f"{grid.full_height_px}"
            for grid in (self, other)
        )
        return others, own

    def fov_tangents(self, vertical_fov_deg: float) -> Tangents:
        """Return the tangents of the image if the picture has a field of view.

        Raises
        ------
        ValueError
            As `tangents_from_fov`.
        """
        left, right, up, down = tangents_from_fov(
            vertical_fov_deg,
            self.full_width_px,
            self.full_height_px,
            pixel_aspect_ratio=self.pixel_aspect_ratio,
        )
        if not self.is_part:
            return left, right, up, down
        across, along = (
            (right - left) / self.full_width_px,
            (up - down) / self.full_height_px,
        )
        first, top = left + across * self.left_px, up - along * self.top_px
        return (
            first,
            first + across * self.width_px,
            top,
            top - along * self.height_px,
        )

    def intrinsics_tangents(
        self,
        focal_x_px: float,
        focal_y_px: float,
        center_x_px: float,
        center_y_px: float,
    ) -> Tangents:
        """Return the tangents of the image for the intrinsics of the picture.

        Raises
        ------
        BadMessage
            As `Camera.from_intrinsics`.
        """
        return Camera.from_intrinsics(
            focal_x_px,
            focal_y_px,
            center_x_px - self.left_px,
            center_y_px - self.top_px,
            width_px=self.width_px,
            height_px=self.height_px,
        ).tangents


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


@lru_cache(maxsize=64, typed=True)
def _known_camera(width_px: int, height_px: int, tangents: Tangents) -> Camera:
    return Camera(width_px, height_px, tangents)


def camera_of(width_px: int, height_px: int, tangents: Tangents) -> Camera:
    """Return a camera; the views of a stream have equal ones, which are checked once.

    Raises
    ------
    BadMessage
        As `Camera`.
    """
    if type(tangents) is tuple and set(map(type, tangents)) == {float}:
        return _known_camera(width_px, height_px, tangents)
    return Camera(width_px, height_px, tangents)


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
    """Return the cameras that need separate stores, in order."""
    distinct: list[Camera] = []
    for camera in cameras:
        if not any(
            is_same_camera(known, camera, follows_field=follows_field)
            for known in distinct
        ):
            distinct.append(camera)
    return tuple(distinct)
