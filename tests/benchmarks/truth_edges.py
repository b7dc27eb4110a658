"""Lamps beside edges, for `bench_truth`."""

import math

import numpy as np
from numpy.typing import NDArray

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
