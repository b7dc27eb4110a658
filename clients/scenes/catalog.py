"""Scenes by name, and the scene of primitives under one directional light."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from clients.scenes import courtyard, night_road, stairs
from clients.scenes.appearance import checks, optotype_e, squares, uint8_srgb
from clients.scenes.geometry import (
    Array,
    Mesh,
    Scene,
    box,
    by_texture,
    finished,
    linear_from_hex,
    patch,
    rotation,
    sphere,
    transformed,
)

UNITS_PER_M = 180.0
_LIGHT_DIRECTION = np.array([0.45, 0.75, 0.6])


def at_units(x: float, y: float, z: float) -> Array:
    """Convert a position from scene units to meters (3,)."""
    return np.array([x, y, z]) / UNITS_PER_M


def build_primitives() -> Scene:
    """Build the primitives, seen from near the origin along -z.

    The layout matches the published test scene: the letter E at 4.17 m, a rotated
    cube at 0.39 m and a sphere at 0.19 m, with 180 scene units per meter and a field of
    view of 50°.
    """
    parts = [_letter_plane(), _cube(), _sphere(), *_room()]
    textures = {
        "letter": uint8_srgb(optotype_e()),
        "squares": uint8_srgb(squares()),
        "ball": uint8_srgb(checks("#2f8f6b", "#f0e6c8", columns=12, rows=6)),
    }
    return Scene(
        name="primitives",
        batches=tuple(
            finished(mesh, _light(mesh.normals), textures) for mesh in by_texture(parts)
        ),
        background_srgb=(0.62, 0.66, 0.70),
        near_m=0.05,
        far_m=40.0,
        infinite_from_m=30.0,
    )


def _letter_plane() -> Mesh:
    """Return the optotype, a square of 2 × 1.22 m centered above the line of sight."""
    center = at_units(0, 100, -750)
    half = 1.22
    return patch(
        center - [half, half, 0],
        (2 * half, 0, 0),
        (0, 2 * half, 0),
        texture="letter",
    )


def _cube() -> Mesh:
    """Return the rotated cube, with a color and a pattern on each face."""
    mesh = box([2 * 11.5 / UNITS_PER_M] * 3, texture="squares")
    palette = ("#c8553d", "#e07a3f", "#3d6f9e", "#5b9bd0", "#c89b3c", "#e8c25a")
    per_face = len(mesh.vertices_m) // 6
    albedo = np.repeat([linear_from_hex(c) for c in palette], per_face, axis=0)
    turn = rotation("y", 34) @ rotation("x", 28)
    turn[:3, 3] = at_units(-31, -7, -63)
    return transformed(replace(mesh, albedo=albedo), turn)


def _sphere() -> Mesh:
    """Return the nearest object, a ball in two colors."""
    turn = rotation("z", 25)
    turn[:3, 3] = at_units(14, -3.5, -30)
    return transformed(sphere(8 / UNITS_PER_M, sides=64, texture="ball"), turn)


def _room() -> list[Mesh]:
    """Return a floor of squares and a back wall at 9 m."""
    floor = patch((-6, -1.25, 0.5), (12, 0, 0), (0, 0, -9.5), cells=(24, 19))
    tile = np.floor(floor.vertices_m[floor.faces].mean(axis=1) * 2)
    dark = (tile[:, 0] + tile[:, 2]) % 2 == 0
    # Triangles share no vertices, so that a square has one color up to its edge.
    flat = replace(
        floor,
        vertices_m=floor.vertices_m[floor.faces].reshape(-1, 3),
        normals=floor.normals[floor.faces].reshape(-1, 3),
        uv=floor.uv[floor.faces].reshape(-1, 2),
        faces=np.arange(3 * len(floor.faces)).reshape(-1, 3),
        albedo=np.repeat(
            np.where(
                dark[:, None], linear_from_hex("#6d7681"), linear_from_hex("#aab2ba")
            ),
            3,
            axis=0,
        ),
        emission=np.zeros((3 * len(floor.faces), 3)),
        translucency=np.zeros(3 * len(floor.faces)),
    )
    back = patch((-9, -1.25, -9), (18, 0, 0), (0, 9, 0), color="#aeb6bd")
    return [flat, back]


def _light(normals: Array) -> Array:
    """Return ambient light and one directional light on surfaces (n, 3)."""
    toward = _LIGHT_DIRECTION / np.linalg.norm(_LIGHT_DIRECTION)
    lambert = np.maximum(normals @ toward, 0.0)[:, None]
    return 0.30 + 0.85 * lambert * np.array([1.0, 0.98, 0.94])


SCENE_BUILDERS: dict[str, Callable[[], Scene]] = {
    "primitives": build_primitives,
    "courtyard": courtyard.build,
    "night_road": night_road.build,
    "stairs": stairs.build,
}
"""Builder function of each scene."""


def build_scene(name: str) -> Scene:
    """Build a scene by its name.

    Raises
    ------
    ValueError
        If no scene has that name.
    """
    if name not in SCENE_BUILDERS:
        names = ", ".join(sorted(SCENE_BUILDERS))
        raise ValueError(f"unknown scene {name!r}; expected one of: {names}")
    return SCENE_BUILDERS[name]()
