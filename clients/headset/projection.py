"""Camera matrices of one eye."""

import numpy as np

from clients.scenes.geometry import Array
from clients.scenes.scene import Scene

Tangents = tuple[float, float, float, float]


def camera_uniforms(
    pose: Array, tangents: Tangents, scene: Scene
) -> dict[str, tuple[float, ...]]:
    """Return the camera's uniforms of the scene shader, by name.

    Parameters
    ----------
    pose : (4, 4), camera to world
    tangents : (left, right, up, down)
    scene : scene whose near and far planes are used

    Raises
    ------
    ValueError
        The pose or the tangents do not describe a camera.
    """
    pose = np.asarray(pose, float)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"pose of shape {pose.shape}; needs 4x4 finite numbers")
    turned = pose[:3, :3].T @ pose[:3, :3]
    if not np.allclose(turned, np.eye(3), atol=1e-3):
        raise ValueError("the pose stretches: its axes must be unit vectors, square")
    clip_from_view = projection(tangents, scene.near_m, scene.far_m)
    view_from_world = np.linalg.inv(pose)
    # GLSL matrices are column-major.
    clip_from_world = (clip_from_view @ view_from_world).T
    return {
        "clip_from_world": tuple(clip_from_world.ravel()),
        "planar_depth": tuple(-view_from_world[2]),
    }


def projection(tangents: Tangents, near_m: float, far_m: float) -> Array:
    """Return OpenGL's projection (4, 4) for an asymmetric frustum.

    Raises
    ------
    ValueError
        Tangents that are not finite, or not left < right and down < up.
    """
    left, right, up, down = tangents
    if not (np.isfinite(tangents).all() and left < right and down < up):
        raise ValueError(f"tangents {tangents}: need left < right and down < up")
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 2] = 2 / (right - left), (right + left) / (right - left)
    matrix[1, 1], matrix[1, 2] = 2 / (up - down), (up + down) / (up - down)
    matrix[2, 2] = (near_m + far_m) / (near_m - far_m)
    matrix[2, 3] = 2 * near_m * far_m / (near_m - far_m)
    matrix[3, 2] = -1.0
    return matrix
