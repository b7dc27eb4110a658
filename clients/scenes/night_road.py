"""Night road: oncoming headlamps, tail lamps, street lamps and signs, 5 to 240 m away.

Light is computed in photometric units: luminous intensities of lamps, illuminances of
surfaces and luminances.  In an image, 1 is `WHITE_CD_M2`.
"""

from dataclasses import replace

import numpy as np

from clients.scenes.appearance import board, framed, uint8_srgb
from clients.scenes.courtyard import cypress
from clients.scenes.geometry import (
    Array,
    Mesh,
    Scene,
    block,
    by_texture,
    finished,
    grid_faces,
    lathe,
    linear_from_hex,
    luminous,
    merged,
    new_mesh,
    painted,
    patch,
    placed,
    sphere,
    tube,
)

WHITE_CD_M2 = 10.0
"""Luminance of 1 in an image: a sign in the light of headlamps."""

LOW_BEAM_CD = 350.0
"""Intensity of a low beam toward the eyes of oncoming drivers: the limit of UN
Regulation 149 at its point B50L."""

TAIL_LAMP_CD = 8.0
"""Intensity of a tail lamp; UN Regulation 7 allows 4 to 17 cd."""

HEADLAMP_RADIUS_M, TAIL_LAMP_RADIUS_M = 0.07, 0.06

CAR_DISTANCES_M = (48.0, 95.0, 190.0)
"""Distances of the oncoming cars."""

LEADER_DISTANCE_M = 34.0
"""Distance of the car ahead."""

LAMP_HEIGHT_M, HALF_TRACK_M = 0.65, 0.62
LANE_M, ONCOMING_X_M = 3.5, -3.5
EYE_HEIGHT_M = 1.2

_BEAM_CD, _BEAM_WIDTH_DEG, _CUTOFF_DEG = 18_000.0, 16.0, 0.57
"""Largest intensity of the driver's own low beam, its width, and how far below the
horizon it ends."""

_STREET_LAMP_CD, _STREET_LAMP_M2 = 700.0, 0.06
_STREET_LAMPS_M = tuple((3.4, 7.0, -z) for z in (30.0, 65.0, 100.0, 135.0, 170.0))
_SKY_SRGB = (0.043, 0.063, 0.125)
_LENGTH_M = 260.0


def build() -> Scene:
    """Build the scene."""
    textures = {
        "speed": uint8_srgb(_speed_sign()),
        "town": uint8_srgb(_town_sign()),
        "plate": uint8_srgb(
            board(
                (256, 64),
                [("HX 4827", 0.52, 52, "")],
                paper="#f2f2ee",
                ink="#101418",
                grain=0.0,
            )
        ),
    }
    lit = [*_ground(), *_verges(), *_signs(), *_cars(), *_posts(), *_person()]
    batches = [finished(mesh, _light(mesh), textures) for mesh in by_texture(lit)]
    batches.append(luminous(merged([*_lamps(), *_windows()])))
    return Scene(
        name="night_road",
        batches=tuple(batches),
        background_srgb=_SKY_SRGB,
        near_m=0.5,
        far_m=600.0,
        infinite_from_m=400.0,
        fov_deg=28.0,
        is_hdr=True,
    )


# Light


def _light(mesh: Mesh) -> Array:
    """Return the light (n, 3) that a white surface would send to the driver."""
    points_m, normals = mesh.vertices_m, mesh.normals
    warm, white, cold = (
        linear_from_hex(code) / linear_from_hex(code).max()
        for code in ("#ffdca8", "#ffffff", "#9fb4d8")
    )
    lux = 0.05 * np.ones((len(points_m), 1)) * cold
    for lamp_m in np.array(_STREET_LAMPS_M):
        lux = lux + _lux(points_m, normals, lamp_m, _STREET_LAMP_CD)[:, None] * warm
    for side in (-1.0, 1.0):
        lamp_m = np.array([side * HALF_TRACK_M, LAMP_HEIGHT_M, 1.8])
        beam_cd = _own_beam_cd(points_m - lamp_m)
        lux = lux + _lux(points_m, normals, lamp_m, beam_cd)[:, None] * white
        for distance_m in CAR_DISTANCES_M:
            lamp_m = np.array(
                [ONCOMING_X_M + side * HALF_TRACK_M, LAMP_HEIGHT_M, -distance_m]
            )
            toward = (points_m - lamp_m) * [1.0, 1.0, -1.0]
            beam_cd = _own_beam_cd(toward)
            lux = lux + _lux(points_m, normals, lamp_m, beam_cd)[:, None] * white
    return lux / np.pi / WHITE_CD_M2


def _lux(
    points_m: Array, normals: Array, lamp_m: Array, intensity_cd: Array | float
) -> Array:
    """Return the illuminance (n,) of surfaces by one lamp."""
    away = lamp_m - points_m
    square = np.einsum("ij,ij->i", away, away)
    cosine = np.einsum("ij,ij->i", away, normals) / np.sqrt(square + 1e-9)
    return np.maximum(cosine, 0.0) * intensity_cd / (square + 0.1)


def _own_beam_cd(toward: Array) -> Array:
    """Return the intensity (n,) of a low beam in directions (n, 3), along -z."""
    ahead = np.maximum(-toward[:, 2], 1e-6)
    azimuth_deg = np.degrees(np.arctan2(toward[:, 0], ahead))
    below_deg = np.degrees(np.arctan2(-toward[:, 1], ahead)) - _CUTOFF_DEG
    # The kerb's side is lit higher, as traffic there comes from behind.
    below_deg = below_deg + np.clip(azimuth_deg * 0.26, 0.0, 2.5)
    sharp = 1.0 / (1.0 + np.exp(-np.clip(below_deg / 0.12, -60.0, 60.0)))
    spread = np.exp(-((azimuth_deg / _BEAM_WIDTH_DEG) ** 2))
    fall = np.exp(-np.maximum(below_deg, 0.0) / 4.0)
    beam = LOW_BEAM_CD * spread + (_BEAM_CD - LOW_BEAM_CD) * sharp * spread * fall
    return np.where(toward[:, 2] < 0.0, beam, 0.0)


# Things


def _ground() -> list[Mesh]:
    """Return the asphalt, its markings and the grass."""
    left, right = ONCOMING_X_M - LANE_M / 2, LANE_M / 2
    asphalt = _strip(left - 0.3, right + 0.3, -0.0, "#5a5c5e", cells=24)
    grass = [
        _strip(right + 0.3, 40.0, -0.02, "#3c4a2c", cells=16),
        _strip(-40.0, left - 0.3, -0.02, "#3c4a2c", cells=16),
    ]
    lines = [_strip(x - 0.06, x + 0.06, 0.01, "#f4f4f0") for x in (left, right)]
    for z in np.arange(2.0, _LENGTH_M - 6.0, 9.0):
        dash = patch(
            (-LANE_M / 2 - 0.06, 0.012, -z),
            (0.12, 0, 0),
            (0, 0, -3.0),
            cells=(1, 3),
            color="#f4f4f0",
        )
        lines.append(dash)
    return [asphalt, *grass, *lines]


def _strip(
    left_m: float, right_m: float, height_m: float, color: str, *, cells: int = 1
) -> Mesh:
    """Return a strip of ground along the road, with finer triangles nearby."""
    distance_m = np.geomspace(3.0, _LENGTH_M, 140)
    x, z = np.meshgrid(np.linspace(left_m, right_m, cells + 1), -distance_m)
    points = np.stack([x, np.full_like(x, height_m), z], axis=-1).reshape(-1, 3)
    faces = grid_faces(len(distance_m) - 1, cells)
    return new_mesh(
        points, faces, normals=np.tile([0.0, 1.0, 0.0], (len(points), 1)), color=color
    )


def _verges() -> list[Mesh]:
    """Return trees and houses."""
    rng = np.random.default_rng(11)
    trees = [
        placed(cypress(rng=rng, height_m=h), (x, -0.1, -z))
        for x, z, h in (
            *((-9.0, 30.0, 6.0), (-10.5, 52.0, 7.5), (-9.5, 80.0, 7.0)),
            *((8.5, 44.0, 7.0), (9.5, 70.0, 8.0), (8.0, 120.0, 7.0)),
        )
    ]
    houses = [
        block((8.0, 5.5, 10.0), (x, 2.75, -z), color=color)
        for x, z, color in ((14.0, 58.0, "#b8a58c"), (-16.0, 72.0, "#a8b0b4"))
    ]
    roofs = [
        block((8.8, 0.4, 10.8), (x, 5.7, -z), color="#6a3a30")
        for x, z in ((14.0, 58.0), (-16.0, 72.0))
    ]
    return [*trees, *houses, *roofs]


def _windows() -> list[Mesh]:
    """Return lit windows, 30 cd/m²."""
    found = []
    for x, z, is_lit in (
        *((12.2, 52.95, True), (14.2, 52.95, False), (16.0, 52.95, True)),
        *((-17.6, 66.95, False), (-15.4, 66.95, True), (-13.6, 66.95, True)),
    ):
        if is_lit:
            glass = patch((x - 0.5, 2.9, -z), (1.0, 0, 0), (0, 1.2, 0))
            found.append(_emitting(glass, "#ffc978", 30.0))
    return found


def _signs() -> list[Mesh]:
    """Return the signs on their posts, in the light of the headlamps."""
    posts = [
        tube([(x, 0.0, -z), (x, h, -z)], 0.035, color="#9a9ea2")
        for x, z, h in ((2.9, 16.0, 2.5), (3.2, 31.9, 2.6), (4.6, 31.9, 2.6))
    ]
    speed = _board_at((2.9, 2.2, -15.9), (0.6, 0.6), "speed")
    town = _board_at((3.9, 2.15, -31.8), (1.7, 0.85), "town")
    return [*posts, speed, town]


def _board_at(
    center_m: tuple[float, float, float], size_m: tuple[float, float], texture: str
) -> Mesh:
    x, y, z = center_m
    width, height = size_m
    sheet = patch(
        (x - width / 2, y - height / 2, z),
        (width, 0, 0),
        (0, height, 0),
        cells=(4, 4),
        texture=texture,
    )
    # Retroreflective: about eight times as bright to the driver as a matt white sheet.
    return _brighter(sheet, 8.0)


def _brighter(mesh: Mesh, factor: float) -> Mesh:
    return replace(mesh, albedo=mesh.albedo * factor)


def _cars() -> list[Mesh]:
    """Return the bodies of the cars."""
    bodies: list[Mesh] = []
    for x, z, color in (
        (0.0, LEADER_DISTANCE_M + 2.1, "#6a2d2a"),
        *((ONCOMING_X_M, d + 2.1, "#39434d") for d in CAR_DISTANCES_M),
    ):
        bodies += [
            block((1.75, 0.62, 4.2), (x, 0.60, -z), color=color),
            block((1.5, 0.55, 2.0), (x, 1.18, -z), color="#14181c"),
        ]
    plate = patch(
        (-0.26, 0.62, -LEADER_DISTANCE_M + 0.02),
        (0.52, 0, 0),
        (0, 0.12, 0),
        texture="plate",
    )
    return [*bodies, _brighter(plate, 4.0)]


def _posts() -> list[Mesh]:
    """Return the poles of the street lamps, and reflector posts."""
    poles = [
        tube(
            [(5.2, 0.0, z), (5.2, y - 0.3, z), (x + 0.2, y, z)],
            [0.09, 0.07, 0.05],
            color="#8a8e90",
        )
        for x, y, z in _STREET_LAMPS_M
    ]
    delineators = [
        block((0.1, 0.9, 0.08), (x, 0.45, -z), color="#f0f0ec")
        for z in range(15, 150, 25)
        for x in (2.4, ONCOMING_X_M - LANE_M / 2 - 0.6)
    ]
    return [*poles, *delineators]


def _person() -> list[Mesh]:
    """Return a person in dark clothes at the edge of the road."""
    place = (1.55, 0.0, -25.0)
    coat = lathe(
        [(0.0, 0.5), (0.2, 0.5), (0.24, 0.9), (0.24, 1.25), (0.16, 1.48), (0.0, 1.5)],
        sides=14,
        color="#5c544c",
    )
    legs = [
        tube([(x, 0.0, 0.0), (x, 0.55, 0.0)], 0.085, color="#2c3038")
        for x in (-0.1, 0.1)
    ]
    head = placed(sphere(0.115, sides=14, color="#c09a80"), (0.0, 1.62, 0.0))
    return [placed(part, place) for part in (coat, *legs, head)]


def _lamps() -> list[Mesh]:
    """Return all lamps; their luminance is intensity over area."""
    found = []
    for distance_m in CAR_DISTANCES_M:
        for side in (-1.0, 1.0):
            center = (
                ONCOMING_X_M + side * HALF_TRACK_M,
                LAMP_HEIGHT_M,
                -distance_m + 0.02,
            )
            found.append(_round_lamp(center, HEADLAMP_RADIUS_M, LOW_BEAM_CD, "#fff4e0"))
    for side in (-1.0, 1.0):
        center = (side * HALF_TRACK_M, 0.78, -LEADER_DISTANCE_M + 0.02)
        found.append(_round_lamp(center, TAIL_LAMP_RADIUS_M, TAIL_LAMP_CD, "#ff0000"))
    for x, y, z in _STREET_LAMPS_M:
        side_m = np.sqrt(_STREET_LAMP_M2)
        glass = patch(
            (x - side_m, y - 0.12, z + 0.1), (2 * side_m, 0, 0), (0, side_m / 2, 0)
        )
        # What is seen from the road, far below the lamp's main direction.
        found.append(
            _emitting(glass, "#ffd9a0", 0.4 * _STREET_LAMP_CD / _STREET_LAMP_M2)
        )
    return found


def _round_lamp(
    center_m: tuple[float, float, float],
    radius_m: float,
    intensity_cd: float,
    color: str,
) -> Mesh:
    """Return a disc that faces the driver, with this intensity along its normal."""
    sides = 24
    angle = 2 * np.pi * np.arange(sides) / sides
    rim = radius_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = np.vstack([np.zeros((1, 3)), rim]) + np.array(center_m)
    k = np.arange(sides)
    faces = np.stack([0 * k, 1 + k, 1 + (k + 1) % sides], axis=1)
    area_m2 = sides / 2 * np.sin(2 * np.pi / sides) * radius_m**2
    return _emitting(new_mesh(points, faces), color, intensity_cd / area_m2)


def _emitting(mesh: Mesh, color: str, luminance_cd_m2: float) -> Mesh:
    """Return a mesh that emits a luminance in a color."""
    relative = float(linear_from_hex(color) @ (0.2126, 0.7152, 0.0722))
    return painted(mesh, color, emission=luminance_cd_m2 / WHITE_CD_M2 / relative)


def _speed_sign() -> Array:
    """Return the face of the speed limit, on the grey of its back board."""
    image = board((256, 256), [("50", 0.5, 130, "")], paper="#f4f4f0", ink="#101010")
    y, x = np.mgrid[0:256, 0:256] / 127.5 - 1.0
    radius = np.hypot(x, y)
    image = np.where(
        ((radius > 0.74) & (radius < 0.97))[..., None],
        linear_from_hex("#c01818"),
        image,
    )
    return np.where((radius >= 0.97)[..., None], linear_from_hex("#303438"), image)


def _town_sign() -> Array:
    """Return a direction sign, white on blue."""
    lines = [("Lakeside  4", 0.3, 62, ""), ("Old Mill  12", 0.7, 62, "")]
    image = board((512, 256), lines, paper="#1c4fa0", ink="#f6f6f2", grain=0.0)
    return framed(image, color="#f6f6f2", border_px=6, inset_px=8)
