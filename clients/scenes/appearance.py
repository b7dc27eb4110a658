"""Baking of sun, sky and lamps into a static scene, and textures.

Shadows come from depth maps along parallel rays: one fine map for the sun, and many
coarse ones for the sky (ambient occlusion).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from clients.scenes.geometry import (
    Array,
    Batch,
    Mesh,
    Scene,
    linear_from_hex,
    linear_from_srgb,
    merged,
    srgb_from_linear,
)
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
        shifts = list(product((-1, 0, 1), repeat=2)) if soft else [(0, 0)]
        total = np.zeros(len(points_m))
        for dx, dy in shifts:
            i = np.clip(np.floor(row + dy), 0, size - 1).astype(int)
            j = np.clip(np.floor(column + dx), 0, size - 1).astype(int)
            total += self.depth_m[i, j] > -local[:, 2] - bias_m
        return total / len(shifts)


def _seen_from(
    view: SceneView, direction: Array, center_m: ArrayLike, radius_m: float
) -> ParallelMap:
    """Render the depth map toward a distant source in a direction (3,)."""
    back = np.asarray(direction, float) / np.linalg.norm(direction)
    helper = np.eye(3)[2 if abs(back[1]) > 0.9 else 1]
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = np.asarray(center_m, float) + back * (radius_m + _NEAR_M)
    depth_m = view.parallel_depth_m(pose, radius_m).astype(float)
    return ParallelMap(depth_m, pose[:3, 3], pose[:3, :3].T, radius_m)


def hemisphere(count: int) -> Array:
    """Return `count` directions (n, 3) spread evenly over the upper hemisphere."""
    index = np.arange(count) + 0.5
    height = index / count
    angle = index * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)


class Baker:
    """Light that arrives at the points of a scene.

    Shadows come from depth maps of fixed occluders within a sphere.  Back faces cast no
    shadows, so that walls around a scene do not hide the sky behind them.
    """

    def __init__(
        self,
        lights: Lights,
        occluders: list[Mesh],
        *,
        center_m: ArrayLike,
        radius_m: float,
        sky_directions: int = 40,
    ) -> None:
        self._lights = lights
        whole = merged([replace(mesh, texture="") for mesh in occluders])
        batch = Batch(
            vertices_m=whole.vertices_m.astype(np.float32),
            faces=whole.faces.astype(np.uint32),
            uv=whole.uv.astype(np.float32),
            srgb=np.zeros_like(whole.vertices_m, np.float32),
            texture=None,
        )
        far_m = _NEAR_M + 2 * radius_m
        scene = Scene("occluders", (batch,), (0.0, 0.0, 0.0), _NEAR_M, far_m, far_m)
        maps: list[ParallelMap] = []
        context = open_context()
        try:
            for directions, size_px in (
                ([lights.sun_direction], 2048),
                (hemisphere(sky_directions), 384),
            ):
                size = (size_px, size_px)
                with SceneView(context, scene, size, supersampling=1) as view:
                    maps += [
                        _seen_from(view, d, center_m, radius_m) for d in directions
                    ]
        finally:
            context.release()
        self._sun_map, *sky_maps = maps
        self._sky = list(zip(hemisphere(sky_directions), sky_maps, strict=True))

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
        up, none = np.array([[0.0, 1.0, 0.0]]), np.zeros(1)
        points = _grid_points(origin_m, side_u_m, side_v_m, coarse)
        slow = self._sky_light(points + 0.02 * up, up, none)
        slow = (slow + self._lamp_light(points, up, none)).reshape(*coarse[::-1], 3)
        points = _grid_points(origin_m, side_u_m, side_v_m, size)
        sun = self._sun_light(points, up, none).reshape(height, width, 3)
        return resized(slow, size, Image.Resampling.BILINEAR) + sun

    def _sun_light(self, points_m: Array, normals: Array, through: Array) -> Array:
        sun = self._lights.sun_direction / np.linalg.norm(self._lights.sun_direction)
        seen = self._sun_map.seen(points_m, bias_m=0.035, soft=True)
        return (seen * _facing(normals @ sun, through))[:, None] * self._lights.sun

    def _sky_light(self, points_m: Array, normals: Array, through: Array) -> Array:
        lights, openness = self._lights, np.zeros(len(points_m))
        total = np.zeros((len(points_m), 3))
        for direction, depth_map in self._sky:
            seen = depth_map.seen(points_m, bias_m=0.04)
            blend = direction[1] ** 0.6
            radiance = blend * lights.sky_zenith + (1 - blend) * lights.sky_horizon
            total += (seen * _facing(normals @ direction, through))[:, None] * radiance
            openness += seen
        # Uniform directions: the mean of 2 cos over a hemisphere is 1.
        total *= 2 / len(self._sky)
        openness = 0.35 + 0.65 * openness / len(self._sky)
        from_below = 0.55 - 0.45 * normals[:, 1]
        return total + (openness * from_below)[:, None] * lights.bounce

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
    rows, columns = np.arange(height) + 0.5, np.arange(width) + 0.5
    u, v = (grid.ravel() for grid in np.meshgrid(columns / width, rows / height))
    sides = np.outer(u, side_u_m) + np.outer(v, side_v_m)
    return np.asarray(origin_m, float) + sides


def resized(
    image: Array, size: tuple[int, int], resampling: Image.Resampling
) -> NDArray[np.float32]:
    """Resize a linear image (h, w, 3) to (width, height)."""
    channels = [
        Image.fromarray(channel.astype(np.float32)).resize(size, resampling)
        for channel in np.moveaxis(image, 2, 0)
    ]
    return np.stack([np.asarray(channel) for channel in channels], axis=-1)


def _facing(cosine: Array, through: Array) -> Array:
    """Return the cosine law, including light transmitted from behind."""
    return np.maximum(cosine, 0.0) + through * np.maximum(-cosine, 0.0)


# Textures, as linear images (h, w, 3) from 0 to 1


def noise(height: int, width: int, *, cells: int, seed: int, octaves: int = 4) -> Array:
    """Return smooth noise (h, w) that tiles, with mean 0 and a range of about -1..1."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for octave in range(octaves):
        n = cells * 2**octave
        grid = np.pad(rng.uniform(-1, 1, (n, n)), 2, mode="wrap")
        # The padding makes the cubic filter wrap around, and is cropped afterward.
        step_x, step_y = width / n, height / n
        size = (round(width + 4 * step_x), round(height + 4 * step_y))
        image = Image.fromarray(grid.astype(np.float32))
        big = np.asarray(image.resize(size, Image.Resampling.BICUBIC))
        top, left = round(2 * step_y), round(2 * step_x)
        total += big[top : top + height, left : left + width] / 1.8**octave
    return total / 1.6


def tinted(value: Array, dark: str, light: str) -> Array:
    """Blend two colors by value (h, w), from -1 (dark) to 1 (light)."""
    t = np.clip(value / 2 + 0.5, 0, 1)[..., None]
    return (1 - t) * linear_from_hex(dark) + t * linear_from_hex(light)


def plaster(dark: str, light: str, *, size: int = 512, seed: int = 1) -> Array:
    """Return weathered plaster (size, size, 3)."""
    value = 0.8 * noise(size, size, cells=4, seed=seed)
    fine = noise(size, size, cells=64, seed=seed + 1, octaves=2)
    return tinted(value + 0.25 * fine, dark, light)


def wood(dark: str, light: str, *, size: int = 512, planks: int = 5) -> Array:
    """Return planks (size, size, 3) whose grain runs along u."""
    grain = noise(size, size, cells=4, seed=7)
    fine = noise(size, size, cells=8, seed=8, octaves=6)
    v = np.arange(size)[:, None] / size * planks
    rings = np.sin(26 * v + 3.0 * noise(size, size, cells=2, seed=3, octaves=2))
    tone = np.random.default_rng(5).uniform(-0.35, 0.35, planks)
    board = tone[np.minimum(v.astype(int), planks - 1)]
    image = tinted(0.35 * rings + 0.3 * grain + 0.3 * fine + board, dark, light)
    edge = np.minimum(v % 1, 1 - v % 1) * size / planks
    return image * np.clip(0.25 + edge / 4, 0.25, 1)[..., None]


def stone_tiles(*, size: int = 1024, tiles: int = 8) -> Array:
    """Return a floor of squares in two colors with small dark corner stones."""
    y, x = np.mgrid[0:size, 0:size] / size * tiles
    column, row = x.astype(int), y.astype(int)
    tone = np.random.default_rng(2).uniform(-0.35, 0.35, (tiles, tiles))[row, column]
    marble = noise(size, size, cells=6, seed=4, octaves=5)
    cream = tinted(0.7 * marble + tone, "#b9a283", "#e6d5b8")
    terracotta = tinted(0.7 * marble + tone, "#8c4f38", "#c07a58")
    image = np.where(((column + row) % 2 == 0)[..., None], cream, terracotta)
    fx, fy = np.abs(x - np.round(x)), np.abs(y - np.round(y))
    image = np.where((fx + fy < 0.17)[..., None], linear_from_hex("#3d4a52"), image)
    joint = np.minimum(np.minimum(fx, fy), np.abs(fx + fy - 0.17))
    return image * np.clip(0.45 + joint / 0.025, 0.45, 1)[..., None]


def stripes(first: str, second: str, *, count: int, size: int = 256) -> Array:
    """Return vertical stripes in two colors (size, size, 3)."""
    x = np.arange(size) / size * 2 * count
    edge = np.clip((np.abs((x + 0.5) % 2 - 1) - 0.5) * size / count, -1, 1)
    cloth = noise(size, size, cells=32, seed=9, octaves=2)
    color = tinted(edge[None, :] + 0 * cloth, first, second)
    return color * (0.94 + 0.06 * cloth)[..., None]


def board(
    size_px: tuple[int, int],
    lines: Iterable[tuple[str, float, float, str]],
    *,
    paper: str,
    ink: str,
    grain: float = 0.1,
) -> Array:
    """Draw centered lines of text on a board.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of the image.
    lines : iterable of (text, center, font size, color)
        Lines, with the center as a fraction of the height from the top and the font
        size in px.  An empty color selects `ink`.
    paper, ink : str
        Colors as "#rrggbb".
    grain : float
        Strength of the paper's texture.
    """
    width, height = size_px
    image = Image.new("RGB", size_px, paper)
    draw = ImageDraw.Draw(image)
    for text, center, font_px, color in lines:
        draw.text(
            (width / 2, center * height),
            text,
            fill=color or ink,
            font=ImageFont.load_default(size=font_px),
            anchor="mm",
        )
    linear = linear_from_srgb(np.asarray(image) / 255.0)
    return np.clip(
        linear * (1 + grain * noise(height, width, cells=8, seed=11)[..., None]), 0, 1
    )


def framed(image: Array, *, color: str, border_px: int, inset_px: int = 0) -> Array:
    """Draw a frame of `color` around an image, inset from its edge."""
    result = image.copy()
    a, b = inset_px, inset_px + border_px
    h, w = image.shape[:2]
    mask = np.zeros((h, w), bool)
    mask[a : h - a, a : w - a] = True
    mask[b : h - b, b : w - b] = False
    result[mask] = linear_from_hex(color)
    return result


def optotype_e(*, size: int = 640) -> Array:
    """Return a black E on white, five units high, with bars of one unit."""
    unit = size // 8
    image = np.full((size, size, 3), 0.9)
    low, high = round(1.5 * unit), round(6.5 * unit)
    image[low:high, low : low + unit] = 0.008
    for top in range(low, high, 2 * unit):
        image[top : top + unit, low:high] = 0.008
    return image


def squares(*, size: int = 256) -> Array:
    """Return a gray frame and a gray square on white, to be tinted by vertex colors."""
    y, x = np.abs(np.mgrid[0:size, 0:size] / (size - 1) * 2 - 1)
    ring = np.maximum(x, y)
    value = np.where((ring > 0.9) | (ring < 0.4), 0.35, 1.0)
    return np.repeat(value[..., None], 3, axis=-1)


def checks(
    first: str, second: str, *, columns: int, rows: int, size: int = 512
) -> Array:
    """Return a checkerboard of two colors (size, size, 3)."""
    y, x = np.mgrid[0:size, 0:size] / size
    odd = ((x * columns).astype(int) + (y * rows).astype(int)) % 2 == 0
    return np.where(odd[..., None], linear_from_hex(first), linear_from_hex(second))


def evening_sky(sine: Array) -> Array:
    """Return the sky's linear color (..., 3) at the sine of an elevation (...)."""
    t = np.clip(sine / 0.5, 0, 1)[..., None] ** 0.75
    return (1 - t) * linear_from_hex("#fbe3bf") + t * linear_from_hex("#74aee6")


def hills(
    bottom_m: float,
    height_m: float,
    distance_m: float,
    *,
    width: int = 1024,
    height: int = 512,
) -> Array:
    """Return an evening view: sky, ridges of hills and fields.

    The sky blends into `evening_sky` behind the image.

    Parameters
    ----------
    bottom_m, height_m, distance_m : float
        Lower edge above the eye, height, and distance of the image in the scene.
    width, height : int
        Size of the texture, px.
    """
    x = np.linspace(0, 1, width)
    y = np.linspace(1, 0, height)[:, None]
    above_m = bottom_m + y * height_m
    sky = evening_sky(above_m / np.hypot(above_m, distance_m))
    image = np.broadcast_to(sky, (height, width, 3)).copy()
    ridges = (
        (0.44, 0.05, 2.3, 0.4, "#8fa3b5", "#a9b4bd"),
        (0.36, 0.06, 3.1, 1.9, "#6c8a77", "#8aa184"),
        (0.24, 0.04, 4.7, 3.0, "#5d7d45", "#9aa35a"),
        (0.14, 0.02, 2.9, 5.0, "#8a8a45", "#c7b266"),
    )
    field = noise(height, width, cells=12, seed=21)
    for base, swing, frequency, phase, dark, light in ridges:
        line = base + swing * np.sin(2 * np.pi * frequency * x + phase)
        line = line + 0.4 * swing * np.sin(2 * np.pi * 2.7 * frequency * x + 2 * phase)
        image = np.where((y < line)[..., None], tinted(field, dark, light), image)
    return image


def uint8_srgb(linear: Array) -> NDArray[np.uint8]:
    """Encode linear light as sRGB bytes."""
    return np.round(255 * srgb_from_linear(linear)).astype(np.uint8)
