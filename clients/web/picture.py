"""A picture with depth, at full and preview size."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from estimator import InvalidFile
from filter_service import Camera, RgbdView
from filter_service.image_files import named_note, read_depth_file
from filter_service.pictures import read_picture_srgb8

MAX_WIDTH_PX, MAX_HEIGHT_PX = 960, 720
"""Size limit of the full picture; larger pictures are reduced."""

SMALL_WIDTH_PX = 480
"""Maximum width of a preview."""

MIN_SIDE_PX = 16
MAX_SIDE_RATIO = 100
"""Maximum ratio of the longer side to the shorter; a preview of more has no rows."""

MAX_PHOTO_BYTES = 60_000_000
PHOTO_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF")
"""Checked by content, not by name.  Other formats run programs (EPS) or have rarely
used decoders."""

DEPTH_SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".exr")
FAR_DPT = 0.0
DEPTH_HELP = "floats in meters (.npy, .exr, .tif), integers in millimeters (.png, .npy)"


class ChartRow(NamedTuple):
    """One row of a letter chart: its size, and its center and right end, 0 to 1."""

    log_mar: float
    y_ratio: float
    end_ratio: float


@dataclass(frozen=True)
class Picture:
    """A picture with depth.

    Attributes
    ----------
    title : as displayed
    view : at full size
    small : reduced size for previews
    distance_dpt : distance of a flat picture; None if it has its own depth
    focus_dpt, pupil_diameter_mm : an initial state, or None
    chart_rows : the rows of a chart, from the top
    follows_gaze : whether its center stays on the line of sight
    notes : on what the files do not show, or likely mistakes
    """

    title: str
    view: RgbdView
    small: RgbdView
    distance_dpt: float | None = None
    focus_dpt: float | None = None
    pupil_diameter_mm: float | None = None
    chart_rows: tuple[ChartRow, ...] = ()
    follows_gaze: bool = False
    notes: tuple[str, ...] = ()

    @property
    def aspect_ratio(self) -> float:
        """Return width over height."""
        return self.view.width_px / self.view.height_px

    def at(self, distance_dpt: float) -> Picture:
        """Return a flat picture at another distance; one with depth unchanged."""
        if self.distance_dpt is None or distance_dpt == self.distance_dpt:
            return self
        return replace(
            self,
            view=_flat(self.view, distance_dpt),
            small=_flat(self.small, distance_dpt),
            distance_dpt=distance_dpt,
        )

    def scene_point(self, x: float, y: float) -> ScenePoint:
        """Return the point at a position, from (0, 0) at the top left to (1, 1)."""
        view = self.view
        column = min(int(x * view.width_px), view.width_px - 1)
        row = min(int(y * view.height_px), view.height_px - 1)
        left, right, up, down = view.tangents
        depth_m = float(view.depth_m[row, column])
        tangents = (left + x * (right - left), up + y * (down - up))
        if view.depth_kind == "planar":
            depth_m *= math.sqrt(1.0 + tangents[0] ** 2 + tangents[1] ** 2)
        is_known = depth_m > 0.0 and not math.isinf(depth_m)
        return ScenePoint(tangents, 1.0 / depth_m if is_known else FAR_DPT)


@dataclass(frozen=True)
class ScenePoint:
    """A point of the scene: its direction and its distance."""

    tangents: tuple[float, float]
    distance_dpt: float

    def direction_deg(self, gaze_deg: tuple[float, float]) -> tuple[float, float]:
        """Return azimuth and elevation relative to an eye with a gaze, deg.

        Gaze rotates the eye up by v, then sideways by h. The inverse rotation gives the
        direction in the eye's own field.
        """
        h, v = (math.radians(angle) for angle in gaze_deg)
        x, y, z = self.tangents[0], self.tangents[1], -1.0
        x, z = x * math.cos(h) + z * math.sin(h), z * math.cos(h) - x * math.sin(h)
        y, z = y * math.cos(v) + z * math.sin(v), z * math.cos(v) - y * math.sin(v)
        length = math.sqrt(x * x + y * y + z * z)
        return math.degrees(math.atan2(x, -z)), math.degrees(math.asin(y / length))


def picture_of(
    title: str,
    view: RgbdView,
    *,
    distance_dpt: float | None = None,
    focus_dpt: float | None = None,
    pupil_diameter_mm: float | None = None,
) -> Picture:
    """Return a picture with its preview."""
    n = math.ceil(view.width_px / SMALL_WIDTH_PX)
    return Picture(
        title, view, coarser(view, n), distance_dpt, focus_dpt, pupil_diameter_mm
    )


def coarser(view: RgbdView, n: int) -> RgbdView:
    """Return a view with n x n pixels merged: mean light, nearest depth.

    Incomplete blocks at the right and lower edges are cropped.
    """
    height_px, width_px = view.height_px // n, view.width_px // n
    blocks = (height_px, n, width_px, n)
    cut = (slice(height_px * n), slice(width_px * n))
    light = linear_from_srgb8(cast("NDArray[np.uint8]", view.color)[cut])
    mean = light.reshape(*blocks, 3).mean(axis=(1, 3))
    depth_m = view.depth_m[cut].reshape(blocks)
    valid_m = np.where(depth_m > 0.0, depth_m, np.inf)
    left, right, up, down = view.tangents
    return RgbdView(
        srgb8_from_linear(mean),
        valid_m.min(axis=(1, 3)).astype(np.float32),
        (
            left,
            left + (right - left) * width_px * n / view.width_px,
            up,
            up + (down - up) * height_px * n / view.height_px,
        ),
        view.depth_kind,
    )


def linear_from_srgb8(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return linear light, 0 to 1."""
    v = np.arange(256) / 255.0
    table = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[color]


def srgb8_from_linear(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return 8-bit sRGB."""
    v = np.clip(light, 0.0, 1.0)
    srgb = np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)
    return np.round(255.0 * srgb).astype(np.uint8)


def _flat(view: RgbdView, distance_dpt: float) -> RgbdView:
    distance_m = np.inf if distance_dpt <= 0.0 else 1.0 / distance_dpt
    return replace(view, depth_m=np.full(view.color.shape[:2], distance_m, np.float32))


def photo_picture(
    name: str,
    content: bytes,
    *,
    width_deg: float,
    distance_dpt: float,
    depth: tuple[str, bytes] | None = None,
) -> Picture:
    """Return a photo as a picture: flat at a distance, or with depth from a file.

    Parameters
    ----------
    width_deg : float
        Visual angle of its width, deg.
    distance_dpt : float
        Distance of the photo if there is no depth.
    depth : (name, content), optional
        Depth file.

    Raises
    ------
    InvalidFile
        If a file is not a picture, or the depth has another shape.
    """
    color, notes = _photo_color(name, content)
    height_px, width_px = color.shape[:2]
    depth_m = None
    if depth is not None:
        depth_m, depth_notes = _photo_depth(*depth, shape=(height_px, width_px))
        notes += depth_notes
    factor = max(1.0, width_px / MAX_WIDTH_PX, height_px / MAX_HEIGHT_PX)
    right = math.tan(math.radians(width_deg) / 2.0)
    up = right * height_px / width_px
    tangents, title = (-right, right, up, -up), Path(name).name[:60]
    if depth_m is not None:
        view = coarser(RgbdView(color, depth_m, tangents), math.ceil(factor))
        return replace(picture_of(title, view), notes=notes)
    color = _resized(color, round(width_px / factor), round(height_px / factor))
    view = RgbdView(color, np.ones(color.shape[:2], np.float32), tangents)
    flat = picture_of(title, view, distance_dpt=math.nan)
    return replace(flat.at(distance_dpt), notes=notes)


def _resized(
    color: NDArray[np.uint8], width_px: int, height_px: int
) -> NDArray[np.uint8]:
    """Return color with fewer pixels, resampled in linear light."""
    if color.shape[:2] == (height_px, width_px):
        return color
    planes = [
        Image.fromarray(linear_from_srgb8(color[..., c])).resize(
            (width_px, height_px), Image.Resampling.HAMMING
        )
        for c in range(3)
    ]
    return srgb8_from_linear(np.stack([np.asarray(p) for p in planes], axis=-1))


def _photo_color(
    name: str, content: bytes
) -> tuple[NDArray[np.uint8], tuple[str, ...]]:
    allowed = "a JPEG, PNG, WebP or TIFF picture"
    _check_size(name, content)
    try:
        color, notes = read_picture_srgb8(
            content, name=name[:60], formats=PHOTO_FORMATS
        )
    except InvalidFile as error:
        if error.found.startswith("cannot be read"):
            raise InvalidFile(name[:60], "not a picture", allowed) from None
        raise
    shorter, longer = sorted(color.shape[:2])
    if shorter < MIN_SIDE_PX or longer > MAX_SIDE_RATIO * shorter:
        size = f"{color.shape[1]} × {color.shape[0]} px"
        allowed = f"{MIN_SIDE_PX} or more, and at most {MAX_SIDE_RATIO} to 1"
        raise InvalidFile(name[:60], size, allowed)
    return color, tuple(named_note(Path(name), note) for note in notes)


def _photo_depth(
    name: str, content: bytes, *, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    _check_size(name, content)
    suffix = Path(name).suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        allowed = ", ".join(DEPTH_SUFFIXES)
        raise ValueError(f"“{name:.60}” is not a depth file; allowed: {allowed}")
    shown = Path(name).name[:60]
    try:
        file = read_depth_file(Path(f"depth{suffix}"), option="", content=content)
    except InvalidFile as error:
        raise InvalidFile(shown, error.found, error.allowed) from None
    depth_m = file.pixels
    if depth_m.shape != shape:
        found, wanted = (f"{w} × {h} px" for h, w in (depth_m.shape, shape))
        allowed = f"the size of the photo, {wanted}"
        raise InvalidFile(name[:60], found, allowed)
    return depth_m, file.notes


def _check_size(name: str, content: bytes) -> None:
    if len(content) > MAX_PHOTO_BYTES:
        found = f"{len(content) / 1e6:.0f} MB"
        raise InvalidFile(name[:60], found, f"{MAX_PHOTO_BYTES / 1e6:.0f} MB")


def camera_of(width_deg: float, *, width_px: int, height_px: int) -> Camera:
    """Return a symmetric camera with the given horizontal field of view."""
    right = math.tan(math.radians(width_deg) / 2.0)
    up = right * height_px / width_px
    return Camera(width_px, height_px, (-right, right, up, -up))
