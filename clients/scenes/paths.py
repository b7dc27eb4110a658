"""Camera paths: position, target, focus and pupil of an eye over time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from clients.scenes.geometry import Array


@dataclass(frozen=True)
class Key:
    """Key frame of a path.

    Attributes
    ----------
    position_m, target_m : (float, float, float)
        Positions of the eye and of the point in the image center.
    pupil_diameter_mm : float
        Pupil of the eye.
    focus_m : float
        Focus distance, meters; may be inf.
    """

    position_m: tuple[float, float, float]
    target_m: tuple[float, float, float]
    pupil_diameter_mm: float
    focus_m: float


@dataclass(frozen=True)
class Moment:
    """State of the eye, and pose of the camera (4, 4, camera to world), in a frame."""

    pose: Array
    pupil_diameter_mm: float
    focus_dpt: float


PATHS = {
    "courtyard": (
        Key((0.02, 1.16, 0.02), (-0.10, 0.98, -4.0), 3.0, 4.0),
        Key((0.06, 1.17, -0.03), (0.08, 0.93, -4.0), 4.0, 2.5),
        Key((0.02, 1.19, -0.05), (-0.06, 0.99, -5.0), 4.95, 14.0),
        Key((-0.04, 1.18, -0.03), (-0.20, 0.86, -3.0), 4.5, 0.7),
        Key((-0.02, 1.15, 0.03), (-0.30, 0.98, -4.0), 3.0, 0.5),
    ),
    "primitives": (
        Key((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), 4.95, 4.17),
        Key((0.03, 0.02, -0.01), (0.02, 0.0, -1.0), 4.5, 1.0),
        Key((0.0, 0.03, 0.01), (-0.05, 0.0, -1.0), 4.0, 0.39),
        Key((-0.03, 0.01, 0.0), (-0.02, 0.02, -1.0), 3.0, 0.25),
        Key((-0.01, 0.0, 0.0), (0.0, 0.0, -1.0), 4.0, 4.17),
    ),
}


def path_moments(path: tuple[Key, ...], n_frames: int) -> list[Moment]:
    """Interpolate a path from its first key to its last.

    Parameters
    ----------
    path : tuple of Key
        At least two keys, spread evenly over the frames.
    n_frames : int
        Number of frames, at least 1.

    Raises
    ------
    ValueError
        If there are too few keys or frames.

    Notes
    -----
    The path is a Catmull-Rom spline through the keys.  Focus is interpolated in
    diopters, which measure the effort of the eye.
    """
    if len(path) < 2 or n_frames < 1:
        raise ValueError(
            f"path has {len(path)} keys and n_frames is {n_frames}; allowed: 2 keys or "
            "more, 1 frame or more"
        )
    values = np.array(
        [
            (*key.position_m, *key.target_m, key.pupil_diameter_mm, 1 / key.focus_m)
            for key in path
        ]
    )
    moments = []
    for t in np.linspace(0, len(path) - 1, n_frames):
        row = _catmull_rom(values, t)
        focus_dpt = float(max(row[7], 0.0))
        pose = look_at(row[:3], row[3:6])
        moments.append(Moment(pose, float(row[6]), focus_dpt))
    return moments


def _catmull_rom(values: Array, t: float) -> Array:
    """Return the spline through the rows of `values` at t, from 0 to rows - 1."""
    i = min(int(t), len(values) - 2)
    s = t - i
    before = values[max(i - 1, 0)]
    first, second = values[i], values[i + 1]
    after = values[min(i + 2, len(values) - 1)]
    slope_a, slope_b = (second - before) / 2, (after - first) / 2
    return (
        (2 * s**3 - 3 * s**2 + 1) * first
        + (s**3 - 2 * s**2 + s) * slope_a
        + (3 * s**2 - 2 * s**3) * second
        + (s**3 - s**2) * slope_b
    )


def look_at(position_m: ArrayLike, target_m: ArrayLike) -> Array:
    """Return the pose (4, 4), camera to world, of an upright camera."""
    position_m = np.asarray(position_m, float)
    back = position_m - np.asarray(target_m, float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(back, right), back
    pose[:3, 3] = position_m
    return pose
