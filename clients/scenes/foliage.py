"""Leaves, flowers, branches and plants, made of many small triangles."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clients.scenes.geometry import (
    Array,
    Mesh,
    lathe,
    linear_from_hex,
    merged,
    new_mesh,
    sphere,
    transformed,
    tube,
)

GREENS = ("#3f6b2a", "#5c8a35", "#7ba246", "#355c2c", "#94b04e")
BLOSSOMS = ("#d63a7e", "#e85d9a", "#c22a6a", "#f08ab8")


def leaves(
    base_m: Array,
    along: Array,
    facing: Array,
    *,
    length_m: float,
    width_m: float,
    colors: Sequence[str],
    rng: np.random.Generator,
    segments: int = 0,
) -> Mesh:
    """Return folded, translucent leaves.

    Parameters
    ----------
    base_m, along, facing : (n, 3) arrays
        Foot, direction and upward normal of each leaf; the last two need not be unit
        vectors.
    length_m, width_m : float
        Mean size.
    colors : sequence of str
        sRGB codes to choose from.
    rng : numpy.random.Generator
        Source of the variation.
    segments : int
        Rows of triangles per leaf; with 0, a leaf has two triangles and no midrib.
    """
    n = len(base_m)
    along = _unit(along)
    across = _unit(np.cross(along, facing))
    up = np.cross(across, along)
    size = rng.uniform(0.7, 1.3, (n, 1, 1))
    s = np.linspace(0, 1, max(segments, 1) + 2)
    half_width = 0.5 * width_m * np.sin(np.pi * s**0.8)
    droop = -0.35 * length_m * s**2
    fold = 0.45
    rows = []
    for side in (-1, 0, 1):
        offset = (
            (length_m * s)[None, :, None] * along[:, None]
            + (side * half_width)[None, :, None] * across[:, None]
            + (droop + fold * abs(side) * half_width)[None, :, None] * up[:, None]
        )
        rows.append(base_m[:, None] + size * offset)
    vertices = np.stack(rows, axis=2)  # (n, rows, 3 across, xyz)
    faces = _leaf_faces(segments)
    per_leaf = vertices.shape[1] * 3
    all_faces = faces[None] + per_leaf * np.arange(n)[:, None, None]
    mesh = new_mesh(vertices, all_faces, normals=np.repeat(up, per_leaf, axis=0))
    palette = np.array([linear_from_hex(color) for color in colors])
    tint = palette[rng.integers(len(palette), size=n)] * rng.uniform(0.75, 1.2, (n, 1))
    # A pale midrib and a darker foot make leaves recognizable at close range.
    shade = np.ones((len(s), 3, 1)) * np.array([1.0, 1.25, 1.0])[None, :, None]
    shade = shade * (0.75 + 0.35 * s)[:, None, None]
    albedo = np.clip(tint[:, None, None] * shade, 0, 1).reshape(-1, 3)
    return replace(mesh, albedo=albedo, translucency=np.full(len(albedo), 0.55))


def _leaf_faces(segments: int) -> NDArray[np.int64]:
    """Return the triangles of a leaf; rows have a left, midrib and right vertex."""
    if segments == 0:
        return np.array([(1, 5, 7), (1, 7, 3)])
    faces = []
    for row in range(segments + 1):
        left, middle, right = 3 * row, 3 * row + 1, 3 * row + 2
        # The first and the last row are points, so half of their triangles are empty.
        if row > 0:
            faces += [(left, middle, middle + 3), (middle, right, middle + 3)]
        if row < segments:
            faces += [(left, middle + 3, left + 3)]
            faces += [(right, right + 3, middle + 3)]
    return np.array(faces)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def branch(
    path_m: ArrayLike,
    *,
    radius_m: float = 0.006,
    leaf_m: float = 0.07,
    n_leaves: int = 40,
    rng: np.random.Generator,
    colors: Sequence[str] = GREENS,
) -> Mesh:
    """Return a twig with leaves on two sides, with details for a distance of 0.3 m."""
    path_m = np.asarray(path_m, float)
    taper = np.linspace(radius_m, 0.3 * radius_m, len(path_m))
    bark = tube(path_m, taper, sides=6, color="#5b4632")
    t = np.sort(rng.uniform(0.08, 1.0, n_leaves)) * (len(path_m) - 1)
    index = np.minimum(t.astype(int), len(path_m) - 2)
    along = path_m[index + 1] - path_m[index]
    base = path_m[index] + (t - index)[:, None] * along
    side = np.where(np.arange(n_leaves) % 2, 1.0, -1.0)[:, None]
    out = side * np.cross(_unit(along), [0.0, 0.3, 1.0]) + 0.7 * _unit(along)
    out = out + rng.normal(0, 0.35, (n_leaves, 3))
    facing = np.array([0, 1.0, 0.5]) + rng.normal(0, 0.4, (n_leaves, 3))
    crown = leaves(
        base,
        out,
        facing,
        length_m=leaf_m,
        width_m=0.45 * leaf_m,
        colors=colors,
        rng=rng,
        segments=4,
    )
    return merged([bark, crown])


def cloud(
    center_m: ArrayLike,
    size_m: ArrayLike,
    *,
    n_leaves: int,
    leaf_m: float,
    rng: np.random.Generator,
    colors: Sequence[str] = GREENS,
    width_ratio: float = 0.55,
) -> Mesh:
    """Return leaves around a rough ball, such as a bush or the crown of a tree."""
    direction = _unit(rng.normal(0, 1, (n_leaves, 3)))
    depth = rng.uniform(0.55, 1.0, (n_leaves, 1)) ** 0.5
    lumps = 1 + 0.18 * np.sin(direction @ rng.normal(0, 4, (3, 1)) + 1)
    base = np.asarray(center_m) + direction * depth * lumps * np.asarray(size_m) / 2
    along = direction + rng.normal(0, 0.6, (n_leaves, 3))
    facing = direction + np.array([0, 0.8, 0]) + rng.normal(0, 0.4, (n_leaves, 3))
    return leaves(
        base,
        along,
        facing,
        length_m=leaf_m,
        width_m=width_ratio * leaf_m,
        colors=colors,
        rng=rng,
    )


def climber(
    path_m: ArrayLike,
    *,
    spread_m: ArrayLike,
    n_leaves: int,
    n_blossoms: int,
    rng: np.random.Generator,
    leaf_m: float = 0.07,
) -> Mesh:
    """Return leaves and blossoms of a plant that climbs along a path."""
    path_m = np.asarray(path_m, float)

    def along_path(n: int, spread: Array) -> Array:
        t = rng.uniform(0, len(path_m) - 1.001, n)
        i = t.astype(int)
        base = path_m[i] + (t - i)[:, None] * (path_m[i + 1] - path_m[i])
        return base + rng.normal(0, 1, (n, 3)) * spread

    def spray(
        n: int, spread: float, length_m: float, colors: Sequence[str], ratio: float
    ) -> Mesh:
        base = along_path(n, np.asarray(spread_m) * spread)
        direction = rng.normal(0, 1, (n, 3)) + np.array([0, -0.3, 0.5])
        return leaves(
            base,
            direction,
            rng.normal(0, 0.5, (n, 3)) + np.array([0, 0.7, 0.7]),
            length_m=length_m,
            width_m=ratio * length_m,
            colors=colors,
            rng=rng,
        )

    return merged(
        [
            spray(n_leaves, 1.0, leaf_m, GREENS, 0.6),
            spray(n_blossoms, 1.1, 0.65 * leaf_m, BLOSSOMS, 0.95),
        ]
    )


def potted_tree(
    *,
    rng: np.random.Generator,
    height_m: float = 1.9,
    crown_m: float = 0.95,
    fruit: str = "",
) -> list[Mesh]:
    """Return a small tree in a clay pot, standing on the origin."""
    pot = lathe(
        [(0.0, 0.0), (0.17, 0.0), (0.25, 0.36), (0.28, 0.38), (0.28, 0.44),
         (0.24, 0.44), (0.0, 0.40)],
        sides=18,
        color="#b5643c",
    )  # fmt: skip
    trunk = tube(
        [(0, 0.4, 0), (0.02, 0.8, 0.01), (0, height_m - 0.6 * crown_m, 0)],
        [0.03, 0.025, 0.02],
        color="#6a4f38",
    )
    center = np.array([0, height_m - crown_m / 2, 0])
    crown = cloud(center, [crown_m] * 3, n_leaves=520, leaf_m=0.11, rng=rng)
    parts = [pot, trunk, crown]
    if fruit:
        for direction in _unit(rng.normal(0, 1, (16, 3))):
            ball = sphere(0.045, sides=8, color=fruit)
            move = np.eye(4)
            move[:3, 3] = center + direction * crown_m * 0.47
            parts.append(transformed(ball, move))
    return parts


def cypress(*, rng: np.random.Generator, height_m: float = 7.0) -> Mesh:
    """Return a tall dark tree, standing on the origin."""
    return cloud(
        [0, height_m / 2, 0],
        [1.5, height_m, 1.5],
        n_leaves=680,
        leaf_m=0.34,
        rng=rng,
        colors=("#2f4a2a", "#3b5a31", "#496a38"),
    )
