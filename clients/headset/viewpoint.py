"""Initial position of the viewer in a scene."""

import numpy as np

from clients.scenes.geometry import Array
from clients.scenes.paths import PATHS, path_moments
from clients.scenes.scene import Scene

EYE_HEIGHT_M = 1.6
_FLOOR_M = 0.3
"""A scene whose lowest point is at most this far from 0 has its floor at 0."""

_HEADROOM_M = 0.1
_STEP_BACK_RATIO = 0.25
"""Distance from the near end of an interior, as a fraction of its depth."""

_LEAST_DISTANCE_M = 0.4
_DISTANCE_RADII = 2.2
"""Distance in radii of the scene's bounding sphere, which is then 54 degrees wide."""


def viewpoint(scene: Scene) -> Array:
    """Return the pose (4, 4), camera to world, of an upright viewer.

    In a built-in scene, the viewer stands at the beginning of the scene's path. A scene
    that has its floor at 0 and is taller than a person is an interior; the viewer
    stands inside, with eyes `EYE_HEIGHT_M` above the floor. Any other scene is viewed
    from outside, along -z, at the height of its center.
    """
    if scene.name in PATHS:
        return path_moments(PATHS[scene.name], 1)[0].pose
    points_m = [batch.vertices_m[batch.faces].reshape(-1, 3) for batch in scene.batches]
    low_m = np.min([points.min(axis=0) for points in points_m], axis=0)
    high_m = np.max([points.max(axis=0) for points in points_m], axis=0)
    pose = np.eye(4)
    pose[:3, 3] = (low_m + high_m) / 2.0
    if abs(low_m[1]) <= _FLOOR_M and high_m[1] >= EYE_HEIGHT_M + _HEADROOM_M:
        pose[1, 3] = EYE_HEIGHT_M
        pose[2, 3] = high_m[2] - _STEP_BACK_RATIO * (high_m[2] - low_m[2])
    else:
        radius_m = np.linalg.norm(high_m - low_m) / 2.0
        pose[2, 3] += max(_DISTANCE_RADII * radius_m, _LEAST_DISTANCE_M)
    return pose
