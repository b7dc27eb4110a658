"""Parts of buildings, furniture and small objects."""

from dataclasses import replace
from itertools import pairwise, product
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from clients.scenes.geometry import (
    Array,
    Line,
    Look,
    Mesh,
    block,
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


def column(height_m: float, *, radius_m: float = 0.16, color: str = "#d9c7a5") -> Mesh:
    """Return a round column with base and capital, standing on the origin."""
    r, h = radius_m, height_m
    shaft = np.linspace(0.24, h - 0.32, 9)
    swelling = r * (1 - 0.10 * (shaft / h) ** 2)
    profile = [
        (1.5 * r, 0.0), (1.5 * r, 0.10), (1.25 * r, 0.14), (1.35 * r, 0.18), (r, 0.24),
        *zip(swelling, shaft, strict=True),
        (1.15 * r, h - 0.28), (0.95 * r, h - 0.25), (1.3 * r, h - 0.14),
        (1.6 * r, h - 0.10), (1.6 * r, h),
    ]  # fmt: skip
    return lathe(profile, sides=16, color=color)


def arch_wall(
    *,
    bay_m: float,
    bays: int,
    springing_m: float,
    height_m: float,
    opening_ratio: float = 0.78,
    depth_m: float = 0.45,
    **look: Unpack[Look],
) -> Mesh:
    """Return a wall of round arches along x from 0, with its front at z = 0 facing +z.

    Parameters
    ----------
    bay_m, height_m, depth_m : float
        Width of a bay, height and thickness of the wall.
    bays : int
        Number of bays.
    springing_m : float
        Height at which the arches start.
    opening_ratio : float
        Width of an opening relative to `bay_m`.
    **look
        Texture and color for `new_mesh`; the texture repeats every two meters.
    """
    radius = opening_ratio * bay_m / 2
    parts = []
    for bay in range(bays):
        center = (bay + 0.5) * bay_m
        edge = _arch_edge(center, radius, springing_m)
        parts += _face_over_arch(edge, bay * bay_m, bay_m, height_m, look)
        # The underside of the arch and the inner faces of the piers.
        back = edge - [0, 0, depth_m]
        strip = np.stack([edge, back], axis=1)
        parts.append(_sheet(strip, inward=np.array([center, springing_m, 0]), **look))
    return merged(parts)


def _arch_edge(center: float, radius: float, springing_m: float) -> Array:
    """Return the outline (n, 3) of an opening, from foot to foot."""
    angle, rise = np.linspace(np.pi, 0, 17), np.linspace(0, springing_m, 9)[:-1]
    x = [np.full(8, -radius), radius * np.cos(angle), np.full(8, radius)]
    y = [rise, springing_m + radius * np.sin(angle), rise[::-1]]
    x_m, y_m = center + np.concatenate(x), np.concatenate(y)
    return np.column_stack([x_m, y_m, np.zeros(len(x_m))])


def _face_over_arch(
    edge: Array, start_m: float, bay_m: float, height_m: float, look: Look
) -> list[Mesh]:
    """Return the front of a bay: two piers and the surface above the arch."""
    left_pier, curve, right_pier = edge[:9], edge[8:-8], edge[-9:]
    ends_m = start_m, start_m + bay_m
    top = np.linspace(0, 1, 13)[:, None, None]
    above = np.linspace(*ends_m, len(curve))
    crown = np.column_stack([above, np.full(len(curve), height_m), 0 * above])
    sheet = (1 - top) * curve[None] + top * crown[None]
    blocks = [
        np.stack([_at_x(left_pier, ends_m[0]), left_pier], axis=1),
        np.stack([right_pier, _at_x(right_pier, ends_m[1])], axis=1),
        sheet,
        # The sides of that surface run from the springing to the corners, which leaves
        # gaps.
        np.stack([sheet[:, 0], _at_x(sheet[:, 0], ends_m[0])], axis=1),
        np.stack([sheet[:, -1], _at_x(sheet[:, -1], ends_m[1])], axis=1),
    ]
    return [_sheet(block, inward=np.array([0, 0, 1e3]), **look) for block in blocks]


def _at_x(points: Array, x: float) -> Array:
    """Move points (n, 3) to one x."""
    return np.column_stack([np.full(len(points), x), points[:, 1:]])


def _sheet(points: Array, *, inward: Array, **look: Unpack[Look]) -> Mesh:
    """Return a grid of points (a, b, 3) as a surface that faces `inward`."""
    a, b = points.shape[:2]
    i, j = np.meshgrid(np.arange(a - 1), np.arange(b - 1), indexing="ij")
    first = (i * b + j).ravel()
    faces = np.concatenate(
        [
            np.stack([first, first + b, first + b + 1], axis=1),
            np.stack([first, first + b + 1, first + 1], axis=1),
        ]
    )
    flat = points.reshape(-1, 3)
    uv = np.stack([(flat[:, 0] - flat[:, 2]) / 2, flat[:, 1] / 2], axis=1)
    mesh = new_mesh(flat, faces, uv=uv, **look)
    toward = inward - flat
    turned = np.einsum("ij,ij->i", mesh.normals, toward) < 0
    sign = -1.0 if turned.mean() > 0.5 else 1.0
    return new_mesh(flat, faces, normals=sign * mesh.normals, uv=uv, **look)


def wall(
    origin_m: ArrayLike,
    along_m: ArrayLike,
    height_m: float,
    *,
    cell_m: float = 0.25,
    texture: str = "",
    color: str = "#ffffff",
) -> Mesh:
    """Return a plain vertical wall whose front faces along × up."""
    length_m = float(np.linalg.norm(along_m))
    cells = (max(1, round(length_m / cell_m)), max(1, round(height_m / cell_m)))
    return patch(
        origin_m,
        along_m,
        (0, height_m, 0),
        cells=cells,
        uv_scale=(length_m / 2, height_m / 2),
        texture=texture,
        color=color,
    )


def tiled_roof(
    width_m: float, slope_m: float, *, pitch_deg: float = 24.0, rows: int = 5
) -> Mesh:
    """Return a roof of clay tiles that slopes toward +z from a ridge on the x axis."""
    rng = np.random.default_rng(12)
    step, count = slope_m / rows, round(width_m / 0.26)
    angle = np.linspace(0, np.pi, 5)
    palette = ("#b4552f", "#c4683c", "#a34a2a", "#cf7d4e", "#b86142")
    tiles = []
    for row, i in np.ndindex(rows, count):
        x = (i + 0.5) * width_m / count
        arc_x, arc_y = x - np.cos(angle) * 0.135, np.sin(angle) * 0.07
        far = np.column_stack([arc_x, arc_y + 0.03 - 0.03, np.full(5, row * step)])
        near = np.column_stack([arc_x, arc_y + 0.03, np.full(5, (row + 1.1) * step)])
        tiles.append(
            _sheet(
                np.stack([far, near]),
                inward=np.array([x, 1e3, row * step]),
                color=str(rng.choice(palette)),
            )
        )
    return transformed(merged(tiles), rotation("x", pitch_deg))


def window(
    *, width_m: float = 0.9, height_m: float = 1.4, shutter: str = "#2f6f73"
) -> list[Mesh]:
    """Return a window with shutters for a wall facing +z, standing on the origin."""
    w, h = width_m, height_m
    parts = [patch((-w / 2, 0, 0.02), (w, 0, 0), (0, h, 0), color="#28343d")]
    for x in (-w / 2, 0.0, w / 2):
        parts.append(block((0.05, h, 0.06), (x, h / 2, 0.04), color="#efe6d2"))
    for y in (0.0, 0.5 * h, h):
        parts.append(block((w, 0.05, 0.06), (0, y, 0.04), color="#efe6d2"))
    parts.append(block((w + 0.3, 0.07, 0.16), (0, -0.07, 0.08), color="#d8c6a0"))
    for x in (-0.78 * w, 0.78 * w):
        parts.append(block((0.5 * w, h, 0.03), (x, h / 2, 0.04), color=shutter))
        for k in range(7):
            foot = (x - 0.21 * w, (k + 0.5) * h / 7.2, 0.058)
            parts.append(patch(foot, (0.42 * w, 0, 0), (0, 0.03, 0), color="#5aa3a7"))
    return parts


def awning(
    width_m: float, reach_m: float, drop_m: float, *, texture: str
) -> list[Mesh]:
    """Return an awning that extends toward +z from the line (0..width, 0, 0)."""
    return [
        patch(
            (0, low_m, reach_m),
            (width_m, 0, 0),
            up_m,
            cells=(24, rows),
            uv_scale=(width_m / 2, 1),
            texture=texture,
        )
        for low_m, up_m, rows in (
            (-drop_m, (0, drop_m, -reach_m), 8),
            (-drop_m - 0.22, (0, 0.22, 0), 1),  # the fringe
        )
    ]


def fountain() -> list[Mesh]:
    """Return a round fountain with two bowls, standing on the origin."""
    stone = "#c9bda6"
    basin = lathe(
        [(1.15, 0.0), (1.15, 0.38), (1.22, 0.40), (1.22, 0.48), (1.02, 0.48),
         (1.0, 0.2)],
        sides=36,
        color=stone,
    )  # fmt: skip
    water = lathe([(1.02, 0.36), (0.6, 0.36), (0.3, 0.36), (0.0, 0.36)], sides=36)
    water = _upward(new_mesh(water.vertices_m, water.faces, color="#5b9aa8"))
    stem = lathe(
        [(0.22, 0.3), (0.14, 0.5), (0.11, 0.8), (0.16, 1.0), (0.5, 1.12), (0.56, 1.2),
         (0.5, 1.2), (0.1, 1.12), (0.07, 1.4), (0.24, 1.52), (0.28, 1.58), (0.0, 1.56)],
        sides=28,
        color=stone,
    )  # fmt: skip
    t = np.linspace(0, 1, 8)
    reach, height = 0.5 + 0.4 * t, 1.22 + 0.25 * t - 1.1 * t**2
    jets = [
        tube(
            np.stack([reach * np.cos(angle), height, reach * np.sin(angle)], axis=1),
            0.008,
            sides=4,
            color="#e4f3f6",
        )
        for angle in np.linspace(0, 2 * np.pi, 10, endpoint=False)
    ]
    top = placed(sphere(0.09, sides=14, color=stone), (0, 1.66, 0))
    return [basin, water, stem, top, *jets]


def lattice(
    width_m: float, height_m: float, *, spacing_m: float = 0.2, color: str = "#e8dfc8"
) -> list[Mesh]:
    """Return a diagonal wooden lattice in the plane z = 0, from the origin."""
    parts = []
    for sign in (-1, 1):
        for c in np.arange(-height_m, width_m + height_m, spacing_m):
            x = (c, c + height_m)[::sign]
            t = np.sort(np.clip((np.array([0, width_m]) - x[0]) / (x[1] - x[0]), 0, 1))
            if t[1] - t[0] >= 0.02:
                path = np.column_stack(
                    [x[0] + t * (x[1] - x[0]), t * height_m, [0.01 * sign] * 2]
                )
                parts.append(tube(path, 0.013, sides=4, color=color))
    rails = [(0, 0), (width_m, 0), (width_m, height_m), (0, height_m), (0, 0)]
    for (xa, ya), (xb, yb) in pairwise(rails):
        parts.append(tube([(xa, ya, 0), (xb, yb, 0)], 0.03, sides=4, color=color))
    return parts


# Furniture and small objects

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
    rim = lathe(
        [(radius_m, height_m - 0.025), (radius_m + 0.004, height_m - 0.012),
         (radius_m, height_m)],
        sides=36,
        color="#6b4a2c" if top else "#8b8f90",
    )  # fmt: skip
    return [leg, _disc(radius_m, height_m, texture=top), rim]


def _disc(
    radius_m: float,
    height_m: float,
    *,
    rings: int = 8,
    sides: int = 36,
    **look: Unpack[Look],
) -> Mesh:
    """Return a horizontal disc, finely divided for small shadows."""
    r = np.linspace(0, radius_m, rings + 1)
    mesh = lathe(np.stack([r, np.full_like(r, height_m)], axis=1)[::-1], sides=sides)
    uv = mesh.vertices_m[:, [0, 2]] / (2 * radius_m) * [1, -1] + 0.5
    return _upward(new_mesh(mesh.vertices_m, mesh.faces, uv=uv, **look))


def chair(*, frame: str = _IRON, seat: str = "#b0703c") -> list[Mesh]:
    """Return a bent-wire chair that faces -z, with thin legs and bars in its back."""
    parts = [
        painted(_disc(0.20, 0.46, rings=4, sides=20), seat),
        lathe([(0.20, 0.44), (0.205, 0.45), (0.20, 0.46)], color=frame),
    ]
    bars: list[Line] = []
    for x in (-0.16, 0.16):
        bars.append([(0.75 * x, 0.45, -0.12), (1.15 * x, 0.0, -0.19)])
        bars.append([(0.75 * x, 0.0, 0.22), (x, 0.45, 0.17), (1.05 * x, 0.85, 0.24)])
    angle = np.linspace(0, np.pi, 9)
    arch = [0.168 * np.cos(angle), 0.85 + 0.10 * np.sin(angle), np.full(9, 0.24)]
    bars.append(np.stack(arch, axis=1))
    for x in (-0.09, 0.0, 0.09):
        bars.append([(x, 0.46, 0.18), (x, 0.68, 0.205), (x, 0.93 - abs(x), 0.24)])
    ring = np.linspace(0, 2 * np.pi, 13)
    bars.append(
        np.stack([0.15 * np.cos(ring), 0 * ring + 0.18, 0.17 * np.sin(ring)], axis=1)
    )
    return parts + [tube(bar, 0.010, sides=5, color=frame) for bar in bars]


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
    roof = lathe([(0.068, 0.175), (0.02, 0.215), (0.008, 0.222)], sides=4, color=_IRON)
    ring = np.linspace(0, 2 * np.pi, 11)
    loop = np.stack([0.02 * np.cos(ring), 0.24 + 0.02 * np.sin(ring), 0 * ring], axis=1)
    bars = [
        tube([(x, 0.01, z), (x, 0.17, z)], 0.004, color=_IRON)
        for x, z in product((-0.046, 0.046), repeat=2)
    ]
    candle = lathe([(0.025, 0.012), (0.025, 0.085), (0.0, 0.085)], color="#f3e3bd")
    flame = lathe(
        [(0.0, 0.088), (0.010, 0.102), (0.008, 0.115), (0.0, 0.138)],
        sides=10,
        color="#ffb347",
    )
    return [
        block((0.10, 0.012, 0.10), (0, 0.006, 0), color=_IRON),
        block((0.10, 0.010, 0.10), (0, 0.170, 0), color=_IRON),
        placed(roof, turn_deg=45),
        tube(loop, 0.0025, sides=5, color=_IRON),
        *bars,
        candle,
        painted(flame, "#ffd27a", emission=glow),
    ]


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

    where = point(((np.arange(count) + 0.5) / count)[:, None])
    bulb = merged(
        [
            painted(sphere(bulb_m, sides=8), "#ffbe78", emission=1.35),
            placed(lathe([(0.016, 0.028), (0.014, 0.075)], sides=8, color="#222222")),
        ]
    )
    below = where - [0.0, 0.08, 0.0]
    cable = tube(point(t), 0.006, sides=5, color="#1d1d1f")
    return [cable, *(placed(bulb, position) for position in below)], below


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
        block((0.05, height + 0.14, 0.03), (x, height / 2, 0.0), color="#7a4f2a")
        for x in (-width / 2 - 0.01, width / 2 + 0.01)
    ]
    frame += [
        block((width + 0.06, 0.05, 0.03), (0, y, 0.0), color="#7a4f2a")
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
    corner_m, sides_m = (-width / 2, 0, 0), ((width, 0, 0), (0, height, 0))
    front = patch(corner_m, *sides_m, cells=(4, 6), texture=texture)
    back = patch(corner_m, *sides_m, cells=(4, 6), color="#efe4cd")
    away = rotation("x", 14)
    away[:3, 3] = (0, 0, -2 * height * np.sin(np.deg2rad(14)))
    return [transformed(front, rotation("x", -14)), transformed(back, away)]
