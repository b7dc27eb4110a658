"""Baking of sun, sky and lamps into a static scene.

Shadows come from depth maps along parallel rays: one fine map for the sun, and many
coarse ones for the sky (ambient occlusion).
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from clients.scenes.geometry import Array, Mesh, merged
from clients.scenes.scene import Batch, Scene
from clients.scenes.scene_view import SceneView, open_context

Place = tuple[float, float, float]

_NEAR_M = 1.0


@dataclass(frozen=True)
class Lights:
    """Lights of a scene; in light of 1, a white surface is rendered white.

    Attributes
    ----------
    sun_direction : (3,) array
        Direction toward the sun.
    sun, sky_zenith, sky_horizon, bounce : (3,) arrays
        Linear RGB; `bounce` is the light that the surroundings reflect.
    lamps_m : (n, 3) array
        Positions of small lamps.
    lamp : (3,) array
        Light of a lamp on a surface one meter away, linear RGB.
    """

    sun_direction: Array
    sun: Array
    sky_zenith: Array
    sky_horizon: Array
    bounce: Array
    lamps_m: Array
    lamp: Array


class DepthMaps:
    """Depth maps of fixed occluders along parallel rays.

    Back faces cast no shadows, so that walls around a scene do not hide the sky behind
    them.
    """

    def __init__(self, occluders: list[Mesh], *, center_m: ArrayLike, radius_m: float):
        whole = merged([replace(mesh, texture="") for mesh in occluders])
        far_m = _NEAR_M + 2 * radius_m
        batch = Batch(
            vertices_m=whole.vertices_m.astype(np.float32),
            faces=whole.faces.astype(np.uint32),
            uv=whole.uv.astype(np.float32),
            srgb=np.zeros_like(whole.vertices_m, np.float32),
            texture=None,
        )
        self._scene = Scene(
            name="occluders",
            batches=(batch,),
            background_srgb=(0.0, 0.0, 0.0),
            near_m=_NEAR_M,
            far_m=far_m,
            infinite_from_m=far_m,
        )
        self._center_m = np.asarray(center_m, float)
        self._radius_m = radius_m
        self._context = open_context()

    def close(self) -> None:
        """Release the OpenGL context."""
        self._context.release()

    def toward(self, directions: Iterable[Array], size_px: int) -> list["ParallelMap"]:
        """Render the depth map (size_px, size_px) of each distant source."""
        found = []
        size = (size_px, size_px)
        with SceneView(self._context, self._scene, size, supersampling=1) as view:
            for direction in directions:
                axes = _axes_along(direction)
                pose = np.eye(4)
                pose[:3, :3] = axes.T
                pose[:3, 3] = self._center_m + axes[2] * (self._radius_m + _NEAR_M)
                depth_m = view.parallel_depth_m(pose, self._radius_m).astype(float)
                found.append(ParallelMap(depth_m, pose[:3, 3], axes, self._radius_m))
        return found


@dataclass(frozen=True)
class ParallelMap:
    """Depth map along parallel rays, in which points are looked up."""

    depth_m: Array
    origin_m: Array
    axes: Array
    radius_m: float

    def seen(self, points_m: Array, *, bias_m: float, soft: bool = False) -> Array:
        """Return the visibility (n,) of points (n, 3) from the source, 0 to 1."""
        local = (points_m - self.origin_m) @ self.axes.T
        size = len(self.depth_m)
        column = (local[:, 0] / self.radius_m + 1) * size / 2
        row = (1 - local[:, 1] / self.radius_m) * size / 2
        shifts = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        total = np.zeros(len(points_m))
        for dx, dy in shifts if soft else [(0, 0)]:
            i = np.clip(np.floor(row + dy), 0, size - 1).astype(int)
            j = np.clip(np.floor(column + dx), 0, size - 1).astype(int)
            total += self.depth_m[i, j] > -local[:, 2] - bias_m
        return total / (len(shifts) if soft else 1)


def _axes_along(direction: Array) -> Array:
    """Return the axes right, up and back (rows) of a camera facing `-direction`."""
    back = np.asarray(direction, float) / np.linalg.norm(direction)
    helper = np.eye(3)[2 if abs(back[1]) > 0.9 else 1]
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def hemisphere(count: int) -> Array:
    """Return `count` directions (n, 3) spread evenly over the upper hemisphere."""
    index = np.arange(count) + 0.5
    height = index / count
    angle = index * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)


class Baker:
    """Light that arrives at the points of a scene."""

    def __init__(self, lights: Lights, maps: DepthMaps, *, sky_directions: int = 40):
        self._lights = lights
        (self._sun_map,) = maps.toward([lights.sun_direction], 2048)
        sky = hemisphere(sky_directions)
        self._sky = list(zip(sky, maps.toward(sky, 384), strict=True))

    def light(
        self, points_m: Array, normals: Array, translucency: ArrayLike = 0.0
    ) -> Array:
        """Return the light (n, 3) on surfaces at points (n, 3) with normals (n, 3)."""
        off_surface = points_m + 0.02 * normals
        through = np.broadcast_to(np.asarray(translucency, float), len(points_m))
        return (
            self._sun_light(off_surface, normals, through)
            + self._sky_light(off_surface, normals, through)
            + self._lamp_light(points_m, normals, through)
        )

    def light_map(
        self,
        origin_m: Place,
        side_u_m: Place,
        side_v_m: Place,
        *,
        size: tuple[int, int],
    ) -> Array:
        """Return the light (h, w, 3) on a parallelogram that faces up.

        The sun is computed for every texel; sky and lamps, which vary slowly, for every
        eighth row and column.
        """
        width, height = size
        coarse = (max(2, width // 8), max(2, height // 8))
        points = _grid_points(origin_m, side_u_m, side_v_m, coarse)
        up = np.tile([0.0, 1.0, 0.0], (len(points), 1))
        none = np.zeros(len(points))
        slow = self._sky_light(points + 0.02 * up, up, none)
        slow = (slow + self._lamp_light(points, up, none)).reshape(*coarse[::-1], 3)
        points = _grid_points(origin_m, side_u_m, side_v_m, size)
        up = np.tile([0.0, 1.0, 0.0], (len(points), 1))
        sun = self._sun_light(points, up, np.zeros(len(points)))
        return _enlarged(slow, size) + sun.reshape(height, width, 3)

    def _sun_light(self, points_m: Array, normals: Array, through: Array) -> Array:
        sun = self._lights.sun_direction / np.linalg.norm(self._lights.sun_direction)
        seen = self._sun_map.seen(points_m, bias_m=0.035, soft=True)
        return (seen * _facing(normals @ sun, through))[:, None] * self._lights.sun

    def _sky_light(self, points_m: Array, normals: Array, through: Array) -> Array:
        total = np.zeros((len(points_m), 3))
        openness = np.zeros(len(points_m))
        for direction, depth_map in self._sky:
            seen = depth_map.seen(points_m, bias_m=0.04)
            blend = direction[1] ** 0.6
            radiance = blend * self._lights.sky_zenith
            radiance = radiance + (1 - blend) * self._lights.sky_horizon
            facing = _facing(normals @ direction, through)
            total += (seen * facing)[:, None] * radiance
            openness += seen
        # Uniform directions: the mean of 2 cos over a hemisphere is 1.
        total *= 2 / len(self._sky)
        openness = 0.35 + 0.65 * openness / len(self._sky)
        from_below = 0.55 - 0.45 * normals[:, 1]
        return total + (openness * from_below)[:, None] * self._lights.bounce

    def _lamp_light(self, points_m: Array, normals: Array, through: Array) -> Array:
        total = np.zeros(len(points_m))
        for lamp_m in self._lights.lamps_m:
            away = lamp_m - points_m
            square = np.einsum("ij,ij->i", away, away)
            cosine = np.einsum("ij,ij->i", away, normals) / np.sqrt(square + 1e-9)
            # The constant stands for the size of the lamp and keeps the result finite.
            total += _facing(cosine, through) / (square + 0.03)
        return total[:, None] * self._lights.lamp


def _grid_points(
    origin_m: Place, side_u_m: Place, side_v_m: Place, size: tuple[int, int]
) -> Array:
    """Return the texel centers (h·w, 3) of a parallelogram, row by row."""
    width, height = size
    u, v = np.meshgrid(
        (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    )
    sides = np.outer(u.ravel(), side_u_m) + np.outer(v.ravel(), side_v_m)
    return np.asarray(origin_m, float) + sides


def _enlarged(image: Array, size: tuple[int, int]) -> Array:
    """Enlarge a linear image (h, w, 3) to (width, height) by interpolation."""
    channels = [
        Image.fromarray(image[..., k].astype(np.float32)).resize(
            size, Image.Resampling.BILINEAR
        )
        for k in range(3)
    ]
    return np.stack([np.asarray(channel) for channel in channels], axis=-1)


def _facing(cosine: Array, through: Array) -> Array:
    """Return the cosine law, including light transmitted from behind."""
    return np.maximum(cosine, 0.0) + through * np.maximum(-cosine, 0.0)


@contextmanager
def baker(
    lights: Lights, occluders: list[Mesh], *, center_m: ArrayLike, radius_m: float
) -> Iterator[Baker]:
    """Open a `Baker` for a scene, with an OpenGL context that the block closes."""
    maps = DepthMaps(occluders, center_m=center_m, radius_m=radius_m)
    try:
        yield Baker(lights, maps)
    finally:
        maps.close()
