"""Quad layers, drawn into the picture of a view as a runtime's compositor would do it.

A quad is drawn over everything, at its own distance, so that it is then filtered with
the picture: its edges spread over what is around it, and what is behind stays hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.headset.runtime import Eye, matrix_of
from clients.headset.stereo_gaze import RgbdPicture
from clients.openxr_layer import wire
from filter_service.color_encoding import srgb8_of, srgb_curve
from filter_service.messages import Pose

Array = NDArray[np.float64]

OPAQUE_ALPHA = 0.5
"""A pixel has the distance of the quad from this opacity on."""

NEAR_M = 1e-3
"""Nothing is drawn nearer than this to the eye."""

_LINEAR_OF_SRGB8 = srgb_curve(np.arange(256) / 255.0).astype(np.float32)
_LINEAR_OF_BYTE = (np.arange(256) / 255.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Quad:
    """A rectangle with a picture, seen from its front.

    Attributes
    ----------
    pose : seven floats
        Pose of its center in the room: x points to the right, y up and z to the viewer.
    size_m : (float, float)
        Width and height.
    light : (h, w, 4) float32
        Linear light times opacity, and opacity; the top row first.
    eyes : tuple of "left" or "right"
        Eyes that see it.
    """

    pose: Pose
    size_m: tuple[float, float]
    light: NDArray[np.float32]
    eyes: tuple[Eye, ...]


def light_of(raw: NDArray[Any], color_format: int, flags: int) -> NDArray[np.float32]:
    """Return the light of a quad's image, as `Quad` has it.

    Parameters
    ----------
    raw : (h, w, 4) uint8 or float16, or (h, w) uint32
        As in the shared memory.
    color_format, flags : int
        Of the message.
    """
    rows = raw if flags & wire.TOP_FIRST else raw[::-1]
    if color_format == wire.LINEAR10:
        rows = _unpacked(rows)
    stored_channels = (2, 1, 0) if flags & wire.IS_BGR else (0, 1, 2)
    light = np.empty(rows.shape, np.float32)
    light[..., 3] = 1.0
    if flags & wire.IS_BLENDED:
        alpha = rows[..., 3].astype(np.float32)
        light[..., 3] = alpha / np.float32(255.0) if raw.dtype == np.uint8 else alpha
    for channel, stored in enumerate(stored_channels):
        values = rows[..., stored]
        if color_format == wire.SRGB8:
            light[..., channel] = _LINEAR_OF_SRGB8[values]
        elif color_format == wire.LINEAR8:
            light[..., channel] = _LINEAR_OF_BYTE[values]
        else:
            light[..., channel] = np.nan_to_num(values)
    if flags & wire.IS_BLENDED and flags & wire.IS_UNPREMULTIPLIED:
        light[..., :3] *= light[..., 3:]
    return light


def _unpacked(packed: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Return channels of 10 bits and an opacity of 2 bits as numbers from 0 to 1."""
    channels = [(packed >> 10 * i & 1023) / np.float32(1023.0) for i in range(3)]
    return np.stack([*channels, (packed >> 30) / np.float32(3.0)], -1, dtype=np.float32)


def draw_quads(picture: RgbdPicture, quads: Sequence[Quad]) -> None:
    """Draw quads into the color and the depth of a picture, the lowest first."""
    for quad in quads:
        if picture.view.eye in quad.eyes:
            _draw(picture, quad)


def _draw(picture: RgbdPicture, quad: Quad) -> None:
    relative = np.linalg.inv(matrix_of(picture.view.pose)) @ matrix_of(quad.pose)
    axes, center = relative[:3, :3], relative[:3, 3]
    part = _part(picture, axes, center, quad.size_m)
    if part is None:
        return
    rows, columns = part
    height_px, width_px = picture.depth_m.shape
    left, right, up, down = picture.view.tangents
    x = (
        left
        + (np.arange(columns.start, columns.stop) + 0.5) * (right - left) / width_px
    )
    y = up - (np.arange(rows.start, rows.stop) + 0.5) * (up - down) / height_px
    # A ray (x, y, -1) times the planar depth meets the plane of the quad.
    toward = axes[0, 2] * x + axes[1, 2] * y[:, None] - axes[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = (axes[:, 2] @ center) / toward
        points = [depth_m * x - center[0], depth_m * y[:, None] - center[1]]
        points.append(-depth_m - center[2])
        across, along = (
            sum(axis[k] * points[k] for k in range(3)) / size + 0.5
            for axis, size in zip((axes[:, 0], axes[:, 1]), quad.size_m, strict=True)
        )
        inside = (toward < 0.0) & (depth_m > NEAR_M)
        inside &= (across >= 0.0) & (across <= 1.0) & (along >= 0.0) & (along <= 1.0)
    if not inside.any():
        return
    seen = _sampled(quad.light, across[inside], 1.0 - along[inside])
    _put_over(picture.color[rows, columns], inside, seen)
    is_opaque = inside.copy()
    is_opaque[inside] = seen[:, 3] >= OPAQUE_ALPHA
    picture.depth_m[rows, columns][is_opaque] = depth_m[is_opaque]


def _part(
    picture: RgbdPicture, axes: Array, center: Array, size_m: tuple[float, float]
) -> tuple[slice, slice] | None:
    """Return the rows and columns that a quad may cover; None if it is not in view."""
    height_px, width_px = picture.depth_m.shape
    half = 0.5 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * size_m
    corners = center + half @ axes[:, :2].T
    if (corners[:, 2] > -NEAR_M).all():
        return None
    if (corners[:, 2] > -NEAR_M).any():  # partly behind the eye
        return slice(0, height_px), slice(0, width_px)
    left, right, up, down = picture.view.tangents
    x = (corners[:, 0] / -corners[:, 2] - left) / (right - left) * width_px
    y = (up - corners[:, 1] / -corners[:, 2]) / (up - down) * height_px
    columns = slice(max(0, int(x.min())), min(width_px, int(x.max()) + 1))
    rows = slice(max(0, int(y.min())), min(height_px, int(y.max()) + 1))
    is_seen = columns.start < columns.stop and rows.start < rows.stop
    return (rows, columns) if is_seen else None


def _sampled(
    light: NDArray[np.float32], across: Array, down: Array
) -> NDArray[np.float32]:
    """Return an image between its pixels, bilinear, at coordinates from 0 to 1."""
    height_px, width_px = light.shape[:2]
    x = np.clip(across * width_px - 0.5, 0.0, width_px - 1.0)
    y = np.clip(down * height_px - 0.5, 0.0, height_px - 1.0)
    x0, y0 = x.astype(np.intp), y.astype(np.intp)
    x1, y1 = np.minimum(x0 + 1, width_px - 1), np.minimum(y0 + 1, height_px - 1)
    fx = (x - x0).astype(np.float32)[:, None]
    fy = (y - y0).astype(np.float32)[:, None]
    upper = light[y0, x0] * (1.0 - fx) + light[y0, x1] * fx
    lower = light[y1, x0] * (1.0 - fx) + light[y1, x1] * fx
    return np.asarray(upper * (1.0 - fy) + lower * fy)


def _put_over(
    color: NDArray[np.uint8] | NDArray[np.float16],
    inside: NDArray[np.bool_],
    seen: NDArray[np.float32],
) -> None:
    """Draw light over a part of an image."""
    behind = color[inside]
    is_srgb = color.dtype == np.uint8
    light = _LINEAR_OF_SRGB8[behind] if is_srgb else behind.astype(np.float32)
    light = seen[:, :3] + (1.0 - seen[:, 3:]) * light
    color[inside] = srgb8_of(light) if is_srgb else light.astype(np.float16)
