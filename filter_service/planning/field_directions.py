"""Directions of a camera in the visual field of an eye that may look elsewhere.

The camera is a pinhole in the eye's entrance pupil, and gaze rotates the eye relative
to it.  Field directions (h, v) are relative to the eye (CONVENTIONS.md), so the PSFs of
a field direction move over the image with the gaze.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics import pinhole
from filter_service.camera import Camera

MAX_FIELD_DEG = 80.0
"""Largest angle from the camera's axis and from the gaze at which there are nodes."""

BORDER_SAMPLES = 33
"""Number of points along each image edge at which the field extent is sampled."""


def unit_direction(h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
    """Return unit vectors (..., 3) to sources at azimuth h and elevation v."""
    h, v = np.radians(np.asarray(h_deg, float)), np.radians(np.asarray(v_deg, float))
    return np.stack(
        [np.sin(h) * np.cos(v), np.sin(v) * np.ones_like(h), -np.cos(h) * np.cos(v)],
        axis=-1,
    )


def angles_deg(direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return azimuths and elevations (...) of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(direction, float), -1, 0)
    return (
        np.degrees(np.arctan2(x, -z)),
        np.degrees(np.arctan2(y, np.hypot(x, z))),
    )


def gaze_rotation(gaze_deg: tuple[float, float]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from eye to camera: up by v, then sideways by h."""
    h, v = np.radians(gaze_deg)
    up = np.array([[1, 0, 0], [0, np.cos(v), -np.sin(v)], [0, np.sin(v), np.cos(v)]])
    aside = np.array([[np.cos(h), 0, -np.sin(h)], [0, 1, 0], [np.sin(h), 0, np.cos(h)]])
    return aside @ up


def field_deg(
    camera: Camera,
    x_px: ArrayLike,
    y_px: ArrayLike,
    *,
    gaze_deg: tuple[float, float] = (0.0, 0.0),
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the field direction (h, v), deg, of an image point, y downward.

    The center of the top-left pixel is (0.5, 0.5).
    """
    tangent_x, tangent_y = pinhole.tangents_at(
        x_px,
        y_px,
        tangents=camera.tangents,
        size_px=(camera.width_px, camera.height_px),
    )
    direction = np.stack(
        np.broadcast_arrays(tangent_x, tangent_y, -np.ones(())), axis=-1
    )
    return angles_deg(direction @ gaze_rotation(gaze_deg))


def field_range_deg(
    camera: Camera, *, gaze_deg: tuple[float, float] = (0.0, 0.0)
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of h and v in an image, within ±`MAX_FIELD_DEG`."""
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    x, y = np.meshgrid(along * camera.width_px, along * camera.height_px)
    h_deg, v_deg = field_deg(camera, x, y, gaze_deg=gaze_deg)
    return _limits_deg(h_deg), _limits_deg(v_deg)


def _limits_deg(angle_deg: NDArray[np.float64]) -> tuple[float, float]:
    return (
        float(np.clip(angle_deg.min(), -MAX_FIELD_DEG, MAX_FIELD_DEG)),
        float(np.clip(angle_deg.max(), -MAX_FIELD_DEG, MAX_FIELD_DEG)),
    )


def nearest_inside_deg(
    camera: Camera,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    gaze_deg: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return field directions (h, v), clamped to the image."""
    turn = gaze_rotation(gaze_deg)
    x, y, z = np.moveaxis(unit_direction(h_deg, v_deg) @ turn.T, -1, 0)
    left, right, up, down = camera.tangents
    ahead = np.maximum(-z, np.cos(np.radians(MAX_FIELD_DEG)))
    seen = np.stack(
        [
            np.clip(x / ahead, left, right),
            np.clip(y / ahead, down, up),
            -np.ones_like(x),
        ],
        axis=-1,
    )
    return angles_deg(seen @ turn)


def pixel_from_mrad(
    camera: Camera,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    gaze_deg: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float64]:
    """Return the local scale (..., 2, 2) of the image at a field direction.

    The scale is in pixels (x right, y up) per mrad along the pupil axes (ex, ey) of
    that field; see `pinhole.pixel_from_mrad`.  Directions beyond the camera's
    ±`MAX_FIELD_DEG` are clamped to it.
    """
    turn = gaze_rotation(gaze_deg)
    direction = unit_direction(h_deg, v_deg)
    camera_h, camera_v = angles_deg(direction @ turn.T)
    scale = pinhole.pixel_from_mrad(
        np.clip(camera_h, -MAX_FIELD_DEG, MAX_FIELD_DEG),
        np.clip(camera_v, -MAX_FIELD_DEG, MAX_FIELD_DEG),
        tangents=camera.tangents,
        size_px=(camera.width_px, camera.height_px),
    )
    # The eye's pupil axes, rotated into the camera's frame, relative to the camera's.
    eye_axes = np.stack(_pupil_axes(direction), axis=-1)  # (..., 3, 2)
    camera_axes = np.stack(_pupil_axes(direction @ turn.T), axis=-1)
    roll = np.swapaxes(camera_axes, -1, -2) @ (turn @ eye_axes)
    return scale @ roll


def _pupil_axes(direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return ex = u x y, normalized, and ey = ex x u, each (..., 3)."""
    ex = np.cross(direction, np.array([0.0, 1.0, 0.0]))
    ex /= np.linalg.norm(ex, axis=-1, keepdims=True)
    return ex, np.cross(ex, direction)
