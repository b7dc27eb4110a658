"""Lamps beside edges, and windows of frames, for `bench_truth`."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.photograph import motorcycle
from tests.benchmarks.truth_points import (
    PITCH_MRAD,
    PointState,
    PointTruth,
    camera_at,
    filtered,
    opened,
    placed,
    wavefronts_of,
)

SIZE_PX = 161, 121
EDGE_X_PX, LAMP_Y_PX = 80, 60
PUPIL_MM = 6.0
AWAY_DPT = 2.0
"""Distance of the lamp from the edge: blur of 6 px."""

PUPIL_POINTS = 401
"""Points across the pupil from which rays start."""

EDGES_DPT = {"emmetropia": 3.0, "myopia": 8.0, "post_lasik": 3.0}
"""Eyes, and a distance that they can focus on."""


def lamp_energies(
    eye_name: str,
    engine: str,
    truth: PointTruth,
    *,
    tolerances: tuple[float, ...] = (0.0, 1.0),
    distances_px: tuple[int, ...] = (1, 2, 3, 4, 5, 6),
) -> dict[tuple[str, str, float], tuple[NDArray, NDArray, NDArray]]:
    """Return lights of a lamp by place (behind, before), layers and tolerance.

    Each is relative to the lamp's, by distance and color (n, 3): that in the frame, the
    share of the lamp's image that does not fall on nearer pixels, and the share of the
    pupil whose rays to the lamp pass the edge, wherever aberrations send their light.

    The surface at the left, up to `EDGE_X_PX`, is black and in focus.  The lamp is a
    pixel of the other one, whose pixel center is 0.5 px less than its distance from the
    edge.  With two layers, the farther surface continues, black, behind the nearer one.
    """
    edge_dpt = EDGES_DPT[eye_name]
    camera = camera_at(0.0, 0.0, SIZE_PX)
    width, height = SIZE_PX
    is_left = np.broadcast_to(np.arange(width) < EDGE_X_PX, (height, width))
    settings = {
        "mode": "quality",
        "focus_range_dpt": (0.0, edge_dpt + 0.5),
        "object_range_dpt": (0.0, 12.0),
    }
    found = {}
    with opened(eye_name, camera, engine, **settings) as eye_filter:
        for place, lamp_dpt in (
            ("behind", edge_dpt - AWAY_DPT),
            ("before", edge_dpt + AWAY_DPT),
        ):
            state = PointState(PUPIL_MM, edge_dpt, lamp_dpt)
            depth_m = np.where(is_left, 1.0 / edge_dpt, 1.0 / lamp_dpt)
            far_m = max(1.0 / edge_dpt, 1.0 / lamp_dpt)
            is_near = is_left if place == "behind" else ~is_left
            hidden = (
                np.zeros((height, width, 3), np.float32),
                np.where(is_near, far_m, 0.0).astype(np.float32),
            )
            shares = None  # the whole image
            if place == "behind":
                shares = _visible_shares(
                    *(eye_filter, camera, state, truth, distances_px),
                    *(is_near, edge_dpt),
                )
            for layers, layer in (("one layer", (None, None)), ("two layers", hidden)):
                for tolerance in tolerances:
                    rows = []
                    for distance_px in distances_px:
                        color = np.zeros((height, width, 3), np.float32)
                        color[LAMP_Y_PX, EDGE_X_PX + distance_px - 1] = 1.0
                        seen = filtered(
                            *(eye_filter, color, depth_m.astype(np.float32)),
                            *(camera, state),
                            hidden=layer,
                            render_tolerance=tolerance,
                        )
                        rows.append(seen.color.sum(axis=(0, 1), dtype=np.float64))
                    found[place, layers, tolerance] = (
                        *(np.array(rows), *(shares or (np.ones((len(rows), 3)),) * 2)),
                    )
    return found


def _visible_shares(
    eye_filter, camera, state, truth, distances_px, is_hidden, edge_dpt
):
    """Return the shares (n, 3) of images and of rays that are not hidden.

    Lamps are at most 0.2 degrees from the middle one, whose image they have.
    """
    lamps_px = [EDGE_X_PX + distance_px - 1 for distance_px in distances_px]
    middle_px = lamps_px[len(lamps_px) // 2]
    points = wavefronts_of(eye_filter, camera, middle_px, LAMP_Y_PX, state)
    hidden = [
        [placed(image, x, LAMP_Y_PX, SIZE_PX)[is_hidden].sum() for x in lamps_px]
        for image in truth.images(points, max(SIZE_PX))
    ]
    # From a point u of the pupil, the lamp is at the angle of the edge's distance that
    # it has from the center, plus u times the difference of vergence.
    across = np.linspace(-1.0, 1.0, PUPIL_POINTS)
    x, y = (
        v[np.hypot(*np.meshgrid(across, across)) <= 1.0]
        for v in np.meshgrid(across, across)
    )
    passing = []
    for point in points:
        center_x, _, major, minor, angle = point.pupil_ellipse
        u_mm = center_x + major * x * math.cos(angle) - minor * y * math.sin(angle)
        moved_px = u_mm * (edge_dpt - state.object_dpt) / PITCH_MRAD
        passing.append(
            [float(np.mean(x_px + 0.5 + moved_px > EDGE_X_PX)) for x_px in lamps_px]
        )
    return 1.0 - np.transpose(hidden), np.transpose(passing)


CROP_FULL_PX, CROP_PX, CROP_AT_PX = (361, 241), (223, 163), (67, 35)
"""Size of a full frame, and size and place of a window in it."""

CROP_STATE = PointState(4.3, 0.5, 0.5)


def crop_errors_db(
    eye_name: str, engine: str, *, mode: str, tolerances: tuple[float, ...] = (0.0, 1.0)
) -> dict[float, float]:
    """Return the PSNR of a window against the same part of the full frame.

    Pixels nearer to the border of the window than light reaches are left out.  Linear
    light, with 1 as its peak; by tolerance.
    """
    full = camera_at(0.0, 0.0, CROP_FULL_PX)
    view = picture(full)
    (x, y), (width, height) = CROP_AT_PX, CROP_PX
    left, right, up, down = full.tangents
    across = (right - left) / full.width_px, (up - down) / full.height_px
    window = Camera(
        width,
        height,
        (
            *(left + across[0] * x, left + across[0] * (x + width)),
            *(up - across[1] * y, up - across[1] * (y + height)),
        ),
    )
    part = slice(y, y + height), slice(x, x + width)
    seen: dict[float, list[np.ndarray]] = {tolerance: [] for tolerance in tolerances}
    for camera, place in ((full, (slice(None), slice(None))), (window, part)):
        with opened(eye_name, camera, engine, mode=mode) as eye_filter:
            for tolerance, colors in seen.items():
                found = filtered(
                    *(eye_filter, np.ascontiguousarray(view.color[place])),
                    *(np.ascontiguousarray(view.depth_m[place]), camera, CROP_STATE),
                    render_tolerance=tolerance,
                )
                colors.append(found.color.astype(np.float64))
            reach_px = max(
                point.spot_px() + EDGE_REACH_PX
                for object_dpt in (1.0 / view.depth_m.max(), 1.0 / view.depth_m.min())
                for point in wavefronts_of(
                    *(eye_filter, camera, width // 2, height // 2),
                    replace(CROP_STATE, object_dpt=float(object_dpt)),
                )
            )
    border = math.ceil(reach_px)
    if 2 * border >= min(width, height):
        raise ValueError(f"light reaches {border} px: the window has none left")
    inner = slice(border, height - border), slice(border, width - border)
    return {
        tolerance: -10.0
        * math.log10(max(float(np.mean((whole[part] - own)[inner] ** 2)), 1e-30))
        for tolerance, (whole, own) in seen.items()
    }


EDGE_REACH_PX = 12.0
"""Distance from the rays at which kernels of 99 % of the light have ended."""


def picture(camera: Camera) -> RgbdView:
    """Return a photograph with depth in linear light, in a camera's view."""
    size = camera.width_px, camera.height_px
    color, depth_m = motorcycle(2 * size[0], 2 * size[1])
    color, depth_m = (
        np.ascontiguousarray(image[: 2 * size[1] : 2, : 2 * size[0] : 2])
        for image in (color, depth_m)
    )
    light = linear_from_srgb(color).astype(np.float32)
    return RgbdView(light, depth_m, camera.tangents, "radial")
