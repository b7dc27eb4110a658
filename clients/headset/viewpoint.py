"""The viewer's initial position, with the scene in front of them."""

import numpy as np

from clients.scenes.geometry import Array
from clients.scenes.paths import PATHS, path_moments
from clients.scenes.scene import Scene

EYE_HEIGHT_M = 1.6
_FLOOR_M = 0.3
"""A scene whose lowest point is no further from 0 than this stands on the floor."""

_HEADROOM_M = 0.1
_STEP_BACK_RATIO = 0.25
"""Distance of the viewer from the near end of an interior, as a part of its depth."""

_LEAST_DISTANCE_M = 0.4
_DISTANCE_RADII = 2.2
"""At this distance a sphere around the scene is 54 degrees wide."""


def viewpoint(scene: Scene) -> Array:
    """Return the pose (4, 4), camera to world, of an upright viewer.

    In a built-in scene, the viewer stands where the scene's path begins. In an
    interior, that is a scene with its floor at 0 that is higher than a person, the
    viewer stands inside, `EYE_HEIGHT_M` above the floor. Any other scene is viewed from
    outside, along -z, at the height of its center.
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
