"""Frames of a data set: files, camera and depth format.

Layouts list frames; workers read their files.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import PixelGrid, Tangents
from filter_service.image_files import (
    ImageFile,
    depth_of,
    read_depth_file,
    read_stored_depth,
)


class Optics(Protocol):
    """Interface of camera models."""

    def tangents(self, grid: PixelGrid) -> Tangents:
        """Return the tangents of the left, right, upper and lower edge of an image."""


@dataclass(frozen=True)
class FieldOfView:
    """Symmetric camera, given by its vertical field of view."""

    fov_deg: float

    def tangents(self, grid: PixelGrid) -> Tangents:
        """Return the tangents of the image edges."""
        return grid.fov_tangents(self.fov_deg)


@dataclass(frozen=True)
class Pinhole:
    """Calibrated camera; the center of pixel (0, 0) is at (0, 0).

    If the image size is known, images of other sizes are rejected.
    """

    focal_x_px: float
    focal_y_px: float
    center_x_px: float
    center_y_px: float
    size_px: tuple[int, int] | None = None

    def tangents(self, grid: PixelGrid) -> Tangents:
        """Return the tangents of the image edges, half a pixel beyond pixel centers.

        Raises
        ------
        ValueError
            If the camera is for images of another size.
        """
        size_px = grid.full_width_px, grid.full_height_px
        if self.size_px not in (None, size_px):
            raise ValueError(
                f"{size_px[0]}x{size_px[1]} px, but the camera of this layout is for "
                f"{self.size_px[0]}x{self.size_px[1]}; allowed: that size, "
                "--intrinsics or --fov-deg"
            )
        return grid.intrinsics_tangents(
            self.focal_x_px, self.focal_y_px, self.center_x_px, self.center_y_px
        )


class DepthForm(Protocol):
    """Interface of depth formats."""

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in a file, m; 0, negative and NaN are missing.

        If the content of the file is given, the file is not read.
        """

    def of_integers(
        self, stored: NDArray[np.uint16]
    ) -> tuple[NDArray[np.float32], list[str]]:
        """Return the depth in a video frame, m, and notes."""


@dataclass(frozen=True)
class Scaled:
    """Depth in multiples of a unit; by default, integers are mm and floats are m."""

    depth_scale_m: float | None = None

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in a file, m."""
        scale_m = self.depth_scale_m
        return read_depth_file(path, depth_scale=scale_m, option="", content=content)

    def of_integers(
        self, stored: NDArray[np.uint16]
    ) -> tuple[NDArray[np.float32], list[str]]:
        """Return the depth in a video frame, m, and notes."""
        return depth_of(stored, self.depth_scale_m)


@dataclass(frozen=True)
class Disparity:
    """Depth as disparity of a stereo pair, in px; infinity is unknown.

    depth = focal length x baseline / (disparity + offset), as in Middlebury.
    """

    focal_px: float
    baseline_m: float
    offset_px: float

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in a file, m; 0 if the disparity is unknown."""
        stored = read_stored_depth(path, option="", content=content)
        return replace(stored, pixels=self._depth_m(stored.pixels))

    def of_integers(
        self, stored: NDArray[np.uint16]
    ) -> tuple[NDArray[np.float32], list[str]]:
        """Return the depth in a video frame, m, and no notes."""
        return self._depth_m(stored), []

    def _depth_m(self, disparity_px: NDArray[Any]) -> NDArray[np.float32]:
        apart_px = disparity_px.astype(np.float64) + self.offset_px
        known = np.isfinite(apart_px) & (apart_px > 0.0)
        depth_m = np.zeros(disparity_px.shape)
        with np.errstate(over="ignore"):  # values beyond float32 become infinity
            depth_m[known] = self.focal_px * self.baseline_m / apart_px[known]
            return depth_m.astype(np.float32)


@dataclass(frozen=True)
class SourceFrame:
    """A frame of a data set.

    Attributes
    ----------
    name : str
        Unique name of the results, a relative path without a suffix.
    color, depth : Path
        Files of the images, or videos.
    optics : Optics
        Camera.
    depth_form : DepthForm
        Depth format.
    color_index, depth_index : int, optional
        Frame numbers in videos.
    time_s : Fraction, optional
        Time in a video of color whose frame rate varies.
    fault : str, optional
        Reason why the frame cannot be used, if known before it is read.
    """

    name: str
    color: Path
    depth: Path
    optics: Optics
    depth_form: DepthForm
    color_index: int | None = None
    depth_index: int | None = None
    time_s: Fraction | None = None
    fault: str | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """Return the image files of the frame, without videos."""
        parts = ((self.color, self.color_index), (self.depth, self.depth_index))
        return tuple(path for path, index in parts if index is None)

    def described(self) -> dict[str, Any]:
        """Return the camera and the depth format, for JSON."""
        return {
            part: {"kind": type(value).__name__, **asdict(cast(Any, value))}
            for part, value in (("camera", self.optics), ("depth", self.depth_form))
        }


class BadFrame(ValueError):
    """The frame cannot be used; the message names its file."""


def check_sizes(frame: SourceFrame, color: ImageFile, depth: ImageFile) -> None:
    """Check that color and depth have the same size and place.

    Raises
    ------
    BadFrame
        If they differ.
    """
    if (problem := color.grid.difference(depth.grid)) is not None:
        found, wanted = problem
        raise BadFrame(
            f"'{frame.depth}': {found}; allowed: the size of '{frame.color}', {wanted}"
        )


def center_depth_m(depth_m: NDArray[np.float32]) -> float:
    """Return the median depth at the center of an image.

    The center is a tenth of the image's width and height.  It is enlarged until it
    contains known depth.  If the image has none, return infinity.
    """
    height_px, width_px = depth_m.shape
    for part in (0.1, 0.2, 0.4, 0.8, 1.0):
        half_y, half_x = (
            max(1, math.ceil(part * side / 2.0)) for side in (height_px, width_px)
        )
        y, x = height_px // 2, width_px // 2
        middle_m = depth_m[
            max(0, y - half_y) : y + half_y, max(0, x - half_x) : x + half_x
        ]
        known_m = middle_m[middle_m > 0.0]
        if known_m.size:
            # The lower of two middle values, because the mean of a wall and the sky is
            # neither.
            return float(np.sort(known_m, axis=None)[(known_m.size - 1) // 2])
    return math.inf
