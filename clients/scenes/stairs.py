"""Stairs: a flight that leads down from the viewer's feet, 1.6 to 6 m away."""

import numpy as np

from clients.scenes.appearance import (
    Baker,
    Lights,
    board,
    framed,
    plaster,
    uint8_srgb,
    wood,
)
from clients.scenes.geometry import (
    Array,
    Mesh,
    Scene,
    block,
    by_texture,
    finished,
    patch,
    tube,
)

STEP_COUNT = 11
RISE_M, GOING_M = 0.17, 0.28
FIRST_EDGE_M = 0.30
"""Distance of the first edge from the viewer's eyes, in plan."""

EYE_HEIGHT_M = 1.6
HALF_WIDTH_M = 0.62
_LANDING_M = 3.0
_STRIP_M = 0.03


def build() -> Scene:
    """Build the scene and bake its light (a second on two cores)."""
    lights = Lights(
        sun_direction=np.array([0.35, 0.9, 0.25]),
        sun=np.array([1.0, 0.95, 0.85]) * 0.35,
        sky_zenith=np.array([0.95, 0.95, 1.0]) * 0.75,
        sky_horizon=np.array([0.9, 0.85, 0.8]) * 0.5,
        bounce=np.array([0.8, 0.72, 0.62]) * 0.45,
        lamps_m=np.array([[0.0, 0.6, -2.0], [0.0, -0.4, -4.6]]),
        lamp=np.array([1.0, 0.86, 0.66]) * 0.35,
    )
    textures = {
        "oak": uint8_srgb(wood("#6d4526", "#b5824f", planks=3)),
        "plaster": uint8_srgb(plaster("#cfc7b8", "#ebe5d8", seed=5)),
        "tiles": uint8_srgb(_floor_tiles()),
        "poster": uint8_srgb(_poster()),
    }
    solids = by_texture([*_steps(), *_shell(), *_rails(), *_things()])
    bake = Baker(lights, solids, center_m=(0, -0.6, -2.4), radius_m=4.5)
    return Scene(
        name="stairs",
        batches=tuple(
            finished(m, bake.light(m.vertices_m, m.normals, m.translucency), textures)
            for m in solids
        ),
        background_srgb=(0.86, 0.84, 0.80),
        near_m=0.1,
        far_m=30.0,
        infinite_from_m=25.0,
        fov_deg=50.0,
    )


def edge_m(step: int) -> tuple[float, float]:
    """Return height y and position z of the front edge of a step, 0 for the landing."""
    return -EYE_HEIGHT_M - step * RISE_M, -FIRST_EDGE_M - step * GOING_M


def _steps() -> list[Mesh]:
    """Return the landing, treads and risers, with a light strip along each edge."""
    found = [
        _flat(-EYE_HEIGHT_M, 1.2, -FIRST_EDGE_M + _STRIP_M, "oak"),
    ]
    for step in range(STEP_COUNT + 1):
        y, z = edge_m(step)
        if step:
            back = edge_m(step - 1)[1]
            found.append(_flat(y, back, z + _STRIP_M, "oak"))
        found.append(_flat(y, z + _STRIP_M, z, "", color="#efe6cf"))
        # The riser is seen from below only; it closes the step.
        found.append(
            patch(
                (-HALF_WIDTH_M, y - RISE_M, z),
                (2 * HALF_WIDTH_M, 0, 0),
                (0, RISE_M, 0),
                cells=(12, 2),
                color="#d8d0c0",
            )
        )
    y, z = edge_m(STEP_COUNT)
    found.append(
        patch(
            (-1.4, y - RISE_M, z),
            (2.8, 0, 0),
            (0, 0, -_LANDING_M),
            cells=(28, 30),
            uv_scale=(2.8, _LANDING_M),
            texture="tiles",
        )
    )
    return found


def _flat(
    height_m: float, back_m: float, front_m: float, texture: str, *, color: str = ""
) -> Mesh:
    """Return a horizontal board across the stairs."""
    return patch(
        (-HALF_WIDTH_M, height_m, back_m),
        (2 * HALF_WIDTH_M, 0, 0),
        (0, 0, front_m - back_m),
        cells=(16, 4),
        uv_scale=(2.4, 0.45),
        color=color or "#ffffff",
        texture=texture,
    )


def _shell() -> list[Mesh]:
    """Return the walls beside the stairs and behind the lower landing."""
    floor = edge_m(STEP_COUNT)[0] - RISE_M
    far = edge_m(STEP_COUNT)[1] - _LANDING_M
    length, height = 1.2 - far, 0.9 - floor
    return [
        patch(
            (-HALF_WIDTH_M, floor, 1.2),
            (0, 0, -length),
            (0, height, 0),
            cells=(60, 36),
            uv_scale=(length / 2, height / 2),
            texture="plaster",
        ),
        patch(
            (HALF_WIDTH_M, floor, far),
            (0, 0, length),
            (0, height, 0),
            cells=(60, 36),
            uv_scale=(length / 2, height / 2),
            texture="plaster",
        ),
        patch(
            (-1.4, floor, far),
            (2.8, 0, 0),
            (0, height, 0),
            cells=(28, 36),
            uv_scale=(1.4, height / 2),
            texture="plaster",
        ),
    ]


def _rails() -> list[Mesh]:
    """Return the handrails, parallel to the flight, and their posts."""
    found = []
    top, bottom = edge_m(0), edge_m(STEP_COUNT)
    for x in (-HALF_WIDTH_M + 0.07, HALF_WIDTH_M - 0.07):
        path = [(x, y + 0.92, z) for y, z in ((top[0], 0.6), top, bottom)]
        found.append(tube(path, 0.022, sides=12, color="#5a3a20"))
        for step in range(0, STEP_COUNT + 1, 2):
            y, z = edge_m(step)
            found.append(
                tube([(x, y, z + 0.1), (x, y + 0.95, z + 0.1)], 0.009, color="#30343a")
            )
    return found


def _things() -> list[Mesh]:
    """Return a door mat, a pair of boxes and a poster on the far wall."""
    y, z = edge_m(STEP_COUNT)
    floor, far = y - RISE_M, z - _LANDING_M
    mat = block((0.9, 0.02, 0.55), (0.0, floor + 0.01, z - 1.2), color="#5b3b2c")
    boxes = [
        block((0.34, 0.26, 0.26), (0.38, floor + 0.13, z - 0.55), color="#a97c4c"),
        block((0.22, 0.16, 0.20), (0.40, floor + 0.34, z - 0.55), color="#3f7fa3"),
    ]
    toy_y, toy_z = edge_m(4)
    toy = block((0.12, 0.07, 0.07), (-0.28, toy_y + 0.035, toy_z + 0.14),
                color="#c8402f")  # fmt: skip
    poster = patch(
        (-0.45, floor + 1.0, far + 0.01), (0.9, 0, 0), (0, 1.1, 0),
        cells=(4, 4), texture="poster",
    )  # fmt: skip
    return [mat, *boxes, toy, poster]


def _floor_tiles() -> Array:
    """Return two by two tiles in gray and white."""
    image = np.empty((256, 256, 3))
    y, x = np.mgrid[0:256, 0:256]
    odd = (x // 128 + y // 128) % 2 == 1
    image[:] = np.where(odd[..., None], 0.72, 0.30)
    joint = (x % 128 < 3) | (y % 128 < 3)
    image[joint] = 0.18
    return image


def _poster() -> Array:
    """Return a poster with lines of text in several sizes."""
    lines = (
        ("SECOND", 0.16, 88, "#a03a22"),
        ("FLOOR", 0.34, 88, "#a03a22"),
        ("Rooms 201 to 218", 0.55, 44, ""),
        ("Library and reading room", 0.68, 32, ""),
        ("Please mind the step", 0.82, 32, ""),
    )
    image = board((512, 640), lines, paper="#f2ead8", ink="#202428", grain=0.02)
    return framed(image, color="#3a2c20", border_px=14)
