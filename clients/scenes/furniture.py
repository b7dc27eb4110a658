"""Furniture and small objects: tables, chairs, cups, lanterns, railings, boards."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from clients.scenes.foliage import BLOSSOMS, GREENS, cloud
from clients.scenes.geometry import (
    Array,
    Line,
    Mesh,
    box,
    lathe,
    merged,
    new_mesh,
    painted,
    patch,
    placed,
    rotation,
    sphere,
    transformed,
    tube,
)

_IRON = "#2b2f33"


def bistro_table(
    *, radius_m: float = 0.36, height_m: float = 0.74, top: str = ""
) -> list[Mesh]:
    """Return a round table; `top` is the name of the texture of its top."""
    leg = lathe(
        [(0.0, 0.0), (0.20, 0.0), (0.20, 0.02), (0.05, 0.05), (0.022, 0.10),
         (0.022, 0.4), (0.022, height_m - 0.06), (0.10, height_m - 0.025)],
        sides=12,
        color=_IRON,
    )  # fmt: skip
    plate = _disc(radius_m, height_m, texture=top)
    rim = lathe(
        [(radius_m, height_m - 0.025), (radius_m + 0.004, height_m - 0.012),
         (radius_m, height_m)],
        sides=36,
        color="#6b4a2c" if top else "#8b8f90",
    )  # fmt: skip
    return [leg, plate, rim]


def _disc(
    radius_m: float,
    height_m: float,
    *,
    rings: int = 8,
    sides: int = 36,
    texture: str = "",
    color: str = "#ffffff",
) -> Mesh:
    """Return a horizontal disc, finely divided for small shadows."""
    r = np.linspace(0, radius_m, rings + 1)
    mesh = lathe(np.stack([r, np.full_like(r, height_m)], axis=1)[::-1], sides=sides)
    uv = mesh.vertices_m[:, [0, 2]] / (2 * radius_m) * [1, -1] + 0.5
    normals = np.tile([0.0, 1.0, 0.0], (len(uv), 1))
    return new_mesh(
        mesh.vertices_m, mesh.faces, normals=normals, uv=uv, texture=texture,
        color=color,
    )  # fmt: skip


def chair(*, frame: str = _IRON, seat: str = "#b0703c") -> list[Mesh]:
    """Return a bent-wire chair that faces -z, with thin legs and bars in its back."""
    parts = [painted(_disc(0.20, 0.46, rings=4, sides=20), seat)]
    parts.append(lathe([(0.20, 0.44), (0.205, 0.45), (0.20, 0.46)], color=frame))
    bars: list[Line] = []
    for x in (-0.16, 0.16):
        bars.append([(0.75 * x, 0.45, -0.12), (1.15 * x, 0.0, -0.19)])
        back = [(0.75 * x, 0.0, 0.22), (x, 0.45, 0.17), (1.05 * x, 0.85, 0.24)]
        bars.append(back)
    angle = np.linspace(0, np.pi, 9)
    arch = np.stack(
        [0.168 * np.cos(angle), 0.85 + 0.10 * np.sin(angle), np.full(9, 0.24)], axis=1
    )
    bars.append(arch)
    for x in (-0.09, 0.0, 0.09):
        bars.append([(x, 0.46, 0.18), (x, 0.68, 0.205), (x, 0.93 - abs(x), 0.24)])
    ring = np.linspace(0, 2 * np.pi, 13)
    bars.append(
        np.stack([0.15 * np.cos(ring), 0 * ring + 0.18, 0.17 * np.sin(ring)], axis=1)
    )
    parts += [tube(bar, 0.010, sides=5, color=frame) for bar in bars]
    return parts


def cup(
    *, color: str = "#f4efe6", coffee: str = "#5a3218", sides: int = 28
) -> list[Mesh]:
    """Return a cup of coffee on a saucer, standing on the origin."""
    saucer = lathe(
        [(0.0, 0.004), (0.035, 0.003), (0.075, 0.014), (0.076, 0.016), (0.034, 0.008)],
        sides=sides,
        color=color,
    )
    body = lathe(
        [(0.022, 0.008), (0.026, 0.010), (0.037, 0.035), (0.042, 0.068),
         (0.039, 0.068), (0.035, 0.04)],
        sides=sides,
        color=color,
    )  # fmt: skip
    drink = lathe([(0.038, 0.058), (0.02, 0.058), (0.0, 0.0581)], sides=sides)
    # Milk foam at the center of the drink.
    foam = lathe(
        [(0.024, 0.0585), (0.01, 0.0587), (0.0, 0.0588)], sides=sides, color="#e9cfa4"
    )
    angle = np.linspace(-1.35, 1.35, 9)
    handle = np.stack(
        [0.034 + 0.024 * np.cos(angle), 0.038 + 0.02 * np.sin(angle), 0 * angle], axis=1
    )
    return [
        saucer,
        body,
        _upward(painted(drink, coffee)),
        _upward(foam),
        tube(handle, 0.0045, sides=8, color=color),
    ]


def _upward(mesh: Mesh) -> Mesh:
    """Return a horizontal surface with all normals pointing up."""
    normals = np.tile([0.0, 1.0, 0.0], (len(mesh.vertices_m), 1))
    return replace(mesh, normals=normals)


def lantern(*, glow: float = 1.6) -> list[Mesh]:
    """Return a candle lantern, 0.24 m high, with thin bars around a flame."""
    parts = [placed(box((0.10, 0.012, 0.10), color=_IRON), (0, 0.006, 0))]
    parts.append(placed(box((0.10, 0.010, 0.10), color=_IRON), (0, 0.170, 0)))
    roof = lathe([(0.068, 0.175), (0.02, 0.215), (0.008, 0.222)], sides=4, color=_IRON)
    parts.append(placed(roof, turn_deg=45))
    ring = np.linspace(0, 2 * np.pi, 11)
    loop = np.stack([0.02 * np.cos(ring), 0.24 + 0.02 * np.sin(ring), 0 * ring], axis=1)
    parts.append(tube(loop, 0.0025, sides=5, color=_IRON))
    for x in (-0.046, 0.046):
        for z in (-0.046, 0.046):
            parts.append(tube([(x, 0.01, z), (x, 0.17, z)], 0.004, color=_IRON))
    candle = lathe([(0.025, 0.012), (0.025, 0.085), (0.0, 0.085)], color="#f3e3bd")
    flame = lathe(
        [(0.0, 0.088), (0.010, 0.102), (0.008, 0.115), (0.0, 0.138)],
        sides=10,
        color="#ffb347",
    )
    return [*parts, candle, painted(flame, "#ffd27a", emission=glow)]


def railing(
    start_m: ArrayLike,
    end_m: ArrayLike,
    *,
    height_m: float = 1.0,
    spacing_m: float = 0.11,
) -> list[Mesh]:
    """Return an iron railing of thin bars, with a ring between neighboring bars."""
    start_m, end_m = np.asarray(start_m, float), np.asarray(end_m, float)
    length_m = np.linalg.norm(end_m - start_m)
    count = max(2, round(length_m / spacing_m))
    foot = np.linspace(start_m, end_m, count + 1)
    up = np.array([0.0, 1.0, 0.0])
    parts = [
        tube([start_m + up * y, end_m + up * y], r, sides=6, color=_IRON)
        for y, r in ((0.08, 0.010), (height_m - 0.14, 0.008), (height_m, 0.018))
    ]
    along = (end_m - start_m) / length_m
    ring = np.linspace(0, 2 * np.pi, 11)[:, None]
    for i, point in enumerate(foot):
        thick = 0.016 if i % 8 == 0 else 0.006
        parts.append(tube([point, point + up * height_m], thick, sides=5, color=_IRON))
        if i < count:
            center = (point + foot[i + 1]) / 2 + up * (height_m - 0.07)
            loop = center + 0.05 * (np.cos(ring) * along + np.sin(ring) * up)
            parts.append(tube(loop, 0.005, sides=4, color=_IRON))
    return parts


def string_lights(
    start_m: ArrayLike,
    end_m: ArrayLike,
    *,
    sag_m: float,
    count: int,
    bulb_m: float = 0.035,
) -> tuple[list[Mesh], Array]:
    """Return a hanging cable with glowing bulbs, and their positions (n, 3)."""
    t = np.linspace(0, 1, 25)[:, None]
    start_m, end_m = np.asarray(start_m, float), np.asarray(end_m, float)

    def point(s: Array) -> Array:
        drop = np.array([0.0, 4 * sag_m, 0.0])
        return (1 - s) * start_m + s * end_m - s * (1 - s) * drop

    parts = [tube(point(t), 0.006, sides=5, color="#1d1d1f")]
    where = point(((np.arange(count) + 0.5) / count)[:, None])
    bulb = merged(
        [
            painted(sphere(bulb_m, sides=8), "#ffbe78", emission=1.35),
            placed(lathe([(0.016, 0.028), (0.014, 0.075)], sides=8, color="#222222")),
        ]
    )
    below = where - [0.0, 0.08, 0.0]
    parts += [placed(bulb, position) for position in below]
    return parts, below


def standing_board(
    size_m: tuple[float, float], *, texture: str, lean_deg: float = 12.0
) -> list[Mesh]:
    """Return a board on two legs that leans back and faces +z."""
    width, height = size_m
    front = patch(
        (-width / 2, 0.08, 0.0),
        (width, 0, 0),
        (0, height, 0),
        cells=(8, 12),
        texture=texture,
    )
    frame = [
        placed(box((0.05, height + 0.14, 0.03), color="#7a4f2a"), (x, height / 2, 0.0))
        for x in (-width / 2 - 0.01, width / 2 + 0.01)
    ]
    frame += [
        placed(box((width + 0.06, 0.05, 0.03), color="#7a4f2a"), (0, y, 0.0))
        for y in (0.07, height + 0.09)
    ]
    tilt = rotation("x", -lean_deg)
    legs = [
        tube([(x, 0.0, -0.45), (x, height, -0.2)], 0.014, color="#7a4f2a")
        for x in (-width / 2, width / 2)
    ]
    return [transformed(part, tilt) for part in (front, *frame)] + legs


def table_card(size_m: tuple[float, float], *, texture: str) -> list[Mesh]:
    """Return a folded menu card that stands on a table and faces +z."""
    width, height = size_m
    tilt = rotation("x", -14)
    front = patch(
        (-width / 2, 0, 0), (width, 0, 0), (0, height, 0), cells=(4, 6), texture=texture
    )
    back = patch(
        (-width / 2, 0, 0), (width, 0, 0), (0, height, 0), color="#efe4cd", cells=(4, 6)
    )
    away = rotation("x", 14)
    away[:3, 3] = (0, 0, -2 * height * np.sin(np.deg2rad(14)))
    return [transformed(front, tilt), transformed(back, away)]


def vase(*, rng: np.random.Generator, height_m: float = 0.13) -> list[Mesh]:
    """Return a small blue vase with three flowering stems."""
    body = lathe(
        [(0.0, 0.0), (0.024, 0.0), (0.034, 0.03), (0.028, 0.065), (0.013, 0.1),
         (0.018, height_m)],
        sides=24,
        color="#3f7fa3",
    )  # fmt: skip
    parts = [body]
    for lean in ((-0.05, 0.02), (0.045, 0.0), (0.0, -0.03)):
        tip = np.array([lean[0], height_m + 0.11, lean[1]])
        middle = np.array([0.3 * lean[0], height_m + 0.03, 0.3 * lean[1]])
        parts.append(tube([(0, 0.05, 0), middle, tip], 0.0025, color="#55803a"))
        parts.append(
            cloud(tip, [0.06] * 3, n_leaves=40, leaf_m=0.026, rng=rng,
                  colors=BLOSSOMS, width_ratio=0.8)
        )  # fmt: skip
        parts.append(
            cloud(middle, [0.04] * 3, n_leaves=8, leaf_m=0.035, rng=rng, colors=GREENS)
        )
    return parts
