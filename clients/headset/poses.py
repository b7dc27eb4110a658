"""Poses as in OpenXR: position x, y, z in meters, then a quaternion x, y, z, w."""

from collections.abc import Sequence

import numpy as np

from clients.scenes.geometry import Array, rotation
from filter_service.messages import Pose


def matrix_of(pose: Pose) -> Array:
    """Return the matrix (4, 4) from the pose's frame to its reference frame.

    Raises
    ------
    ValueError
        If the length of the quaternion is not between 0.5 and 2.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of(_unit(pose[3:]))
    matrix[:3, 3] = pose[:3]
    return matrix


def rotation_of(quaternion: Array) -> Array:
    """Return the rotation (3, 3) of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _unit(quaternion: Sequence[float]) -> Array:
    values = np.asarray(quaternion, float)
    length = float(np.linalg.norm(values))
    if not 0.5 < length < 2.0:
        raise ValueError(
            f"orientation is {values.tolist()}; allowed: a unit quaternion"
        )
    return values / length


def turned(yaw_deg: float, pitch_deg: float = 0.0) -> tuple[float, float, float, float]:
    """Return the quaternion of a head that turns left by yaw, then up by pitch."""
    yaw, pitch = np.radians(yaw_deg) / 2, np.radians(pitch_deg) / 2
    # q = q_yaw q_pitch
    return (
        float(np.cos(yaw) * np.sin(pitch)),
        float(np.sin(yaw) * np.cos(pitch)),
        float(-np.sin(yaw) * np.sin(pitch)),
        float(np.cos(yaw) * np.cos(pitch)),
    )


def direction_of(h_deg: float, v_deg: float) -> Array:
    """Return the unit vector (3,) at h degrees to the right and v degrees up."""
    h, v = np.radians(h_deg), np.radians(v_deg)
    return np.array([np.sin(h) * np.cos(v), np.sin(v), -np.cos(h) * np.cos(v)])


def angles_of(direction: Array) -> tuple[float, float]:
    """Return the angles (h, v) in degrees of a vector in front of the viewer."""
    x, y, z = direction
    h = np.degrees(np.arctan2(x, -z))
    return float(h), float(np.degrees(np.arctan2(y, np.hypot(x, z))))


def upright(pose: Array) -> Array:
    """Return a level pose (4, 4) with the same position and heading."""
    ahead = -pose[:3, 2]
    level = rotation("y", -np.degrees(np.arctan2(ahead[0], -ahead[2])))
    level[:3, 3] = pose[:3, 3]
    return level
