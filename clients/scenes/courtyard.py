"""Courtyard: a café garden in the evening sun, with depths from 0.3 to 30 m.

It replaces San Miguel, a scene from the literature, and has similar content: thin
occluders, nearby foliage, furniture, text in several sizes, repeated arches and small
lamps.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from clients.scenes import architecture as build_
from clients.scenes.appearance import (
    Baker,
    Lights,
    board,
    evening_sky,
    framed,
    hills,
    plaster,
    resized,
    stone_tiles,
    stripes,
    uint8_srgb,
    wood,
)
from clients.scenes.geometry import (
    Array,
    Batch,
    Look,
    Mesh,
    Scene,
    by_texture,
    finished,
    grid_faces,
    lathe,
    linear_from_hex,
    merged,
    new_mesh,
    patch,
    placed,
    rotation,
    sphere,
    transformed,
    tube,
    unit,
)

_FLOOR_M = (-6.5, -15.0, 13.0, 17.0)  # left, far, width, length
_SUN = np.array([0.55, 0.62, 0.42])


def build() -> Scene:
    """Build the scene and bake its light (a few seconds on two cores)."""
    lamps, lamps_m = _lamps()
    rng = np.random.default_rng(2023)
    lights = Lights(
        sun_direction=_SUN,
        sun=np.array([1.0, 0.80, 0.55]) * 1.25,
        sky_zenith=np.array([0.30, 0.42, 0.62]) * 0.85,
        sky_horizon=np.array([0.75, 0.62, 0.50]) * 0.75,
        bounce=np.array([0.34, 0.26, 0.19]) * 0.55,
        lamps_m=lamps_m,
        lamp=np.array([1.0, 0.62, 0.28]) * 0.05,
    )
    textures = _textures()
    solids = by_texture([*_architecture(), *_furniture(rng), *_plants(rng), *lamps])
    occluders = [*solids, _floor()]
    bake = Baker(lights, occluders, center_m=(0, 2.0, -6.5), radius_m=11.5)
    batches = [
        finished(m, bake.light(m.vertices_m, m.normals, m.translucency), textures)
        for m in solids
    ]
    batches.append(_floor_batch(bake))
    for mesh in by_texture(_backdrop()):
        batches.append(finished(mesh, np.ones((len(mesh.vertices_m), 3)), textures))
    return Scene(
        name="courtyard",
        batches=tuple(batches),
        background_srgb=(0.55, 0.72, 0.88),
        near_m=0.08,
        far_m=140.0,
        infinite_from_m=60.0,
    )


def _put(parts: list[Mesh], position_m: ArrayLike, turn_deg: float = 0.0) -> list[Mesh]:
    """Rotate the parts of an object about the vertical axis and move them."""
    return [placed(part, position_m, turn_deg=turn_deg) for part in parts]


def _architecture() -> list[Mesh]:
    """Return the walls, the arcades and the fountain."""
    warm: Look = {"texture": "plaster_warm"}
    back = build_.arch_wall(bay_m=2.6, bays=5, springing_m=1.7, height_m=3.75, **warm)
    windows: list[Mesh] = []
    for x in np.arange(5) * 2.6 - 5.2:
        windows += _put(build_.window(height_m=1.15), (x, 4.15, -14.0))
    return [
        placed(back, (-6.5, 0, -14.0)),
        build_.wall((-6.5, 3.75, -14.0), (13, 0, 0), 1.95, **warm),
        *windows,
        placed(build_.tiled_roof(13.4, 1.5), (-6.7, 6.1, -14.9)),
        *_side(-6.5, 5.2, "plaster_rose", turn_deg=90),
        # The wall on this side is low and lets in the evening sun.
        *_side(6.5, 2.3, "plaster_warm", turn_deg=-90),
        *_put(build_.fountain(), (0.4, 0, -7.6)),
        *_put(build_.awning(4.6, 1.3, 0.7, texture="stripes"), (-5.9, 3.45, -12.2), 38),
        patch(
            (-2.2, 3.1, -13.97),
            (4.4, 0, 0),
            (0, 0.62, 0),
            cells=(16, 4),
            texture="sign",
        ),
    ]


def _side(x_m: float, height_m: float, texture: str, *, turn_deg: float) -> list[Mesh]:
    """Return a side of the courtyard: a wall, and an arcade in front of it."""
    inward = -np.sign(x_m)
    start_z, foot_z = (-1.2, 1.5) if inward > 0 else (-13.2, -14.5)
    arcade = build_.arch_wall(
        bay_m=2.4, bays=5, springing_m=3.0 - 0.02, height_m=4.3, opening_ratio=0.86,
        depth_m=0.3, texture=texture,
    )  # fmt: skip
    # Raise the feet of the piers to keep only the part above the columns.
    lifted = np.maximum(arcade.vertices_m, [-np.inf, 2.98, -np.inf])
    move = rotation("y", turn_deg)
    move[:3, 3] = (x_m + 1.15 * inward, 0, start_z)
    return [
        *(
            placed(build_.column(3.0), (x_m + 1.3 * inward, 0, z))
            for z in np.arange(-13.2, -1.0, 2.4)
        ),
        transformed(replace(arcade, vertices_m=lifted), move),
        build_.wall(
            (x_m, 0.0, foot_z), (0, 0, -16.0 * inward), height_m, texture=texture
        ),
    ]


def _furniture(rng: np.random.Generator) -> list[Mesh]:
    """Return tables, chairs, a board, a railing and the objects on the near table."""
    menu = build_.standing_board((0.62, 0.98), texture="chalk")
    return [
        *_table_group(-1.75, -3.4, 20, "#1f6f78", rng),
        *_table_group(1.9, -4.9, -35, "#2b2f33", rng),
        *_table_group(-2.9, -6.6, 60, "#a23b2a", rng),
        *_table_group(2.7, -8.6, 10, "#1f6f78", rng),
        *_near_table(rng),
        *_put(menu, (1.42, 0, -2.6), -26),
        *build_.railing((2.0, 0, -3.3), (5.0, 0, -3.3)),
    ]


def _table_group(
    x: float, z: float, turn: float, frame: str, rng: np.random.Generator
) -> list[Mesh]:
    """Return a table with two or three chairs, a lantern and cups."""
    group = build_.bistro_table(top="table")
    for angle in (15, 140, 255)[: 2 + int(rng.random() < 0.6)]:
        radians = np.deg2rad(angle)
        where = (0.62 * np.sin(radians), 0, 0.62 * np.cos(radians))
        group += _put(build_.chair(frame=frame), where, angle)
    group += _put(build_.lantern(), (0.05, 0.74, -0.06))
    group += _put(build_.cup(sides=12), (-0.18, 0.74, 0.08), 40)
    group += _put(build_.cup(sides=12), (0.14, 0.74, 0.15), 40)
    return _put(group, (x, 0, z), turn)


def _near_table(rng: np.random.Generator) -> list[Mesh]:
    """Return the viewer's table, with objects at distances of 0.6 to 1.1 m."""
    top = 0.74
    things = [
        *build_.bistro_table(radius_m=0.46, top="table"),
        *_put(build_.cup(), (0.02, top, 0.0), -30),
        *_put(build_.table_card((0.15, 0.21), texture="card"), (-0.23, top, -0.03), 16),
        *_put(vase(rng=rng), (0.24, top, -0.06)),
        *_put(build_.lantern(), (-0.03, top, -0.27)),
    ]
    return _put(things, (0.02, 0, -0.80))


def _plants(rng: np.random.Generator) -> list[Mesh]:
    """Return the nearby branches, climbing plants and potted trees."""
    parts = [
        branch(path, rng=rng, n_leaves=n, leaf_m=0.062)
        for path, n in (
            (((-0.62, 1.50, -0.62), (-0.42, 1.44, -0.50), (-0.28, 1.37, -0.45)), 26),
            (((-0.62, 1.46, -0.62), (-0.44, 1.36, -0.55), (-0.36, 1.27, -0.52)), 22),
            (((-0.50, 1.47, -0.50), (-0.30, 1.42, -0.43), (-0.13, 1.40, -0.40)), 22),
        )
    ]
    parts += _put(build_.lattice(3.4, 2.6), (-5.1, 0.2, -3.0), 90)
    for start in (0.2, 1.5, 2.9):
        s = np.linspace(0, 1, 10)
        path = np.stack(
            [-5.02 + 0 * s, 0.2 + 2.6 * s, -3.0 - start - 0.4 * np.sin(4 * s)], axis=1
        )
        parts.append(
            climber(
                path, spread_m=(0.07, 0.25, 0.3), n_leaves=520, n_blossoms=290, rng=rng
            )
        )
    hedge = [(-6.2 + 0.25 * k, 3.95 + 0.15 * np.sin(k), -13.8) for k in range(14)]
    parts.append(
        climber(
            hedge, spread_m=(0.2, 0.28, 0.12), n_leaves=760, n_blossoms=430, rng=rng,
            leaf_m=0.12,
        )
    )  # fmt: skip
    pots = ((-3.2, -9.6, ""), (3.9, -6.3, "#f2a03d"), (-4.0, -1.9, ""),
            (4.4, -10.6, "#f2c53d"), (-1.9, -12.6, "#f2c53d"))  # fmt: skip
    for x, z, fruit in pots:
        parts += _put(potted_tree(rng=rng, fruit=fruit), (x, 0, z))
    return parts


def _lamps() -> tuple[list[Mesh], np.ndarray]:
    """Return the string lights, and the positions (n, 3) of their bulbs."""
    parts, positions = [], []
    lines = (
        ((-5.2, 3.3, -1.4), (4.0, 3.5, -5.2), 0.45, 13),
        ((-5.2, 3.4, -4.6), (5.2, 3.4, -3.2), 0.55, 14),
        ((-5.2, 3.5, -6.6), (5.2, 3.5, -9.4), 0.6, 14),
        ((5.2, 3.5, -6.2), (-5.2, 3.6, -11.6), 0.6, 14),
    )
    for start, end, sag_m, count in lines:
        line, where = build_.string_lights(start, end, sag_m=sag_m, count=count)
        parts += line
        positions.append(where)
    return parts, np.concatenate(positions)


def _floor() -> Mesh:
    left, far, width, length = _FLOOR_M
    return patch((left, 0, far + length), (width, 0, 0), (0, 0, -length))


def _floor_batch(bake: Baker) -> Batch:
    """Return the floor, whose light is baked into the texture for fine shadows."""
    left, far, width, length = _FLOOR_M
    texel_m = 0.0125
    columns, rows = round(width / texel_m), round(length / texel_m)
    image = bake.light_map(
        (left, 0, far), (width, 0, 0), (0, 0, length), size=(columns, rows)
    )
    tile_px = round(4.0 / texel_m)  # the pattern repeats every four meters
    tiles = resized(stone_tiles(), (tile_px, tile_px), Image.Resampling.BOX)
    repeat = np.tile(tiles, (rows // tile_px + 1, columns // tile_px + 1, 1))
    texture = uint8_srgb(image * repeat[:rows, :columns])
    floor = replace(_floor(), texture="floor")
    ones = np.ones((len(floor.vertices_m), 3))
    return finished(floor, ones, {"floor": texture})


def _backdrop() -> list[Mesh]:
    """Return the landscape behind the arches and the sky, without shadows."""
    rng = np.random.default_rng(31)
    lawn = patch((-30, -0.01, -14.4), (60, 0, 0), (0, 0, -15.6), color="#77853d")
    view = patch(
        (-26, -0.6, -30), (52, 0, 0), (0, 12, 0), uv_scale=(1, 0.995), texture="hills"
    )
    path = patch((-0.9, 0.0, -14.4), (2.2, 0, 0), (0, 0, -15), color="#d9bf93")
    trees = []
    for x, z, height in (
        (-5.6, -19, 6.0), (-2.6, -23, 7.0), (2.2, -20.5, 6.2), (4.6, -25, 7.5),
        (6.2, -18.5, 5.2), (-7.6, -24, 7.0),
    ):  # fmt: skip
        tree = placed(cypress(rng=rng, height_m=height), (x, 0, z))
        # Cosine shading: leaves that face the sun are brighter.
        facing = np.maximum(tree.normals @ _SUN / np.linalg.norm(_SUN), 0)
        light = (0.55 + 0.75 * facing)[:, None]
        trees.append(replace(tree, albedo=tree.albedo * light))
    return [lawn, view, path, *trees, _sky()]


def _sky() -> Mesh:
    """Return a dome 100 m away, which the renderer treats as infinitely far."""
    tt, aa = np.meshgrid(
        np.linspace(-0.05, np.pi / 2, 12), np.linspace(0, 2 * np.pi, 25), indexing="ij"
    )
    points = 100 * np.stack(
        [np.cos(tt) * np.sin(aa), np.sin(tt), np.cos(tt) * np.cos(aa)], axis=-1
    )
    mesh = new_mesh(points, grid_faces(11, 24))
    return replace(mesh, albedo=evening_sky(np.sin(tt).ravel()))


def _textures() -> dict[str, NDArray[np.uint8]]:
    """Draw the textures of the scene; the other meshes have vertex colors."""
    linear = {
        "plaster_warm": plaster("#c99a5e", "#ecd09a"),
        "plaster_rose": plaster("#b87862", "#dca58c", seed=6),
        "table": wood("#6d4526", "#b27d48"),
        "stripes": stripes("#b3372b", "#f3e9d2", count=4),
        "hills": hills(-1.8, 12.0, 30.0),
        "sign": _sign(),
        "chalk": _chalk_board(),
        "card": _menu_card(),
    }
    return {name: uint8_srgb(image) for name, image in linear.items()}


def _sign() -> Array:
    lines = [("CAFE DEL SOL", 0.5, 100, "")]
    image = board((1024, 144), lines, paper="#1f4d4a", ink="#f5dfa3", grain=0.06)
    return framed(image, color="#d9b45a", border_px=5, inset_px=8)


def _chalk_board() -> Array:
    lines = [
        ("TODAY", 0.10, 120, "#f7e27a"),
        ("SOUP", 0.26, 100, ""),
        ("pumpkin & sage  4.50", 0.345, 48, "#d8e4e0"),
        ("PASTA", 0.47, 100, ""),
        ("lemon & basil  7.80", 0.555, 48, "#d8e4e0"),
        ("TART", 0.68, 100, "#f2a7b8"),
        ("plum, warm  3.90", 0.765, 48, "#d8e4e0"),
        ("open till 10 pm", 0.91, 62, "#9fd3c7"),
    ]
    image = board((640, 1012), lines, paper="#26302e", ink="#f4f4ee", grain=0.3)
    return framed(image, color="#c9d2cc", border_px=3, inset_px=18)


def _menu_card() -> Array:
    lines = [
        ("MENU", 0.12, 92, "#8c2f24"),
        ("Coffee  2.40", 0.30, 56, ""),
        ("Cocoa  2.80", 0.41, 56, ""),
        ("Lemonade  3.10", 0.52, 56, ""),
        ("Almond cake  3.60", 0.66, 42, ""),
        ("Apricot tart  3.90", 0.74, 42, ""),
        ("Ask us about allergens", 0.88, 28, "#6b5a48"),
    ]
    image = board((480, 672), lines, paper="#f6ecd6", ink="#2b211a", grain=0.04)
    return framed(image, color="#8c2f24", border_px=6, inset_px=14)


# Plants, made of many small triangles

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
        Base, direction and upward normal of each leaf; the last two need not be unit
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
    along = unit(along)
    across = unit(np.cross(along, facing))
    up = np.cross(across, along)
    size = rng.uniform(0.7, 1.3, (n, 1, 1))
    s = np.linspace(0, 1, max(segments, 1) + 2)
    half_width = 0.5 * width_m * np.sin(np.pi * s**0.8)
    droop, fold = -0.35 * length_m * s**2, 0.45
    rows = [
        (length_m * s)[None, :, None] * along[:, None]
        + (side * half_width)[None, :, None] * across[:, None]
        + (droop + fold * abs(side) * half_width)[None, :, None] * up[:, None]
        for side in (-1, 0, 1)
    ]
    # (n, rows, 3 across, xyz)
    vertices = np.stack([base_m[:, None] + size * row for row in rows], axis=2)
    per_leaf = vertices.shape[1] * 3
    faces = _leaf_faces(segments)[None] + per_leaf * np.arange(n)[:, None, None]
    mesh = new_mesh(vertices, faces, normals=np.repeat(up, per_leaf, axis=0))
    palette = np.array([linear_from_hex(color) for color in colors])
    tint = palette[rng.integers(len(palette), size=n)] * rng.uniform(0.75, 1.2, (n, 1))
    # A pale midrib and a darker base make leaves recognizable at close range.
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
            faces += [(left, middle + 3, left + 3), (right, right + 3, middle + 3)]
    return np.array(faces)


def branch(
    path_m: ArrayLike,
    *,
    radius_m: float = 0.006,
    leaf_m: float = 0.07,
    n_leaves: int = 40,
    rng: np.random.Generator,
    colors: Sequence[str] = GREENS,
) -> Mesh:
    """Return a twig with leaves on two sides, detailed enough to view from 0.3 m."""
    path_m = np.asarray(path_m, float)
    taper = np.linspace(radius_m, 0.3 * radius_m, len(path_m))
    bark = tube(path_m, taper, sides=6, color="#5b4632")
    t = np.sort(rng.uniform(0.08, 1.0, n_leaves)) * (len(path_m) - 1)
    index = np.minimum(t.astype(int), len(path_m) - 2)
    along = path_m[index + 1] - path_m[index]
    base = path_m[index] + (t - index)[:, None] * along
    side = np.where(np.arange(n_leaves) % 2, 1.0, -1.0)[:, None]
    out = side * np.cross(unit(along), [0.0, 0.3, 1.0]) + 0.7 * unit(along)
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
    direction = unit(rng.normal(0, 1, (n_leaves, 3)))
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

    def spray(
        n: int, spread: float, length_m: float, colors: Sequence[str], ratio: float
    ) -> Mesh:
        t = rng.uniform(0, len(path_m) - 1.001, n)
        i = t.astype(int)
        base = path_m[i] + (t - i)[:, None] * (path_m[i + 1] - path_m[i])
        scatter = rng.normal(0, 1, (n, 3)) * (np.asarray(spread_m) * spread)
        direction = rng.normal(0, 1, (n, 3)) + np.array([0, -0.3, 0.5])
        return leaves(
            base + scatter,
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
    """Return a small tree in a clay pot at the origin."""
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
    balls = []
    if fruit:
        ball = sphere(0.045, sides=8, color=fruit)
        places = center + unit(rng.normal(0, 1, (16, 3))) * crown_m * 0.47
        balls = [placed(ball, place) for place in places]
    return [pot, trunk, crown, *balls]


def cypress(*, rng: np.random.Generator, height_m: float = 7.0) -> Mesh:
    """Return a tall dark tree at the origin."""
    return cloud(
        [0, height_m / 2, 0],
        [1.5, height_m, 1.5],
        n_leaves=680,
        leaf_m=0.34,
        rng=rng,
        colors=("#2f4a2a", "#3b5a31", "#496a38"),
    )


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
        parts += [
            tube([(0, 0.05, 0), middle, tip], 0.0025, color="#55803a"),
            cloud(tip, [0.06] * 3, n_leaves=40, leaf_m=0.026, rng=rng,
                  colors=BLOSSOMS, width_ratio=0.8),
            cloud(middle, [0.04] * 3, n_leaves=8, leaf_m=0.035, rng=rng, colors=GREENS),
        ]  # fmt: skip
    return parts
