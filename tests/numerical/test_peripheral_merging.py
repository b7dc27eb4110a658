"""Merging that follows the gaze, against a twin in float64 and published thresholds."""

import numpy as np
import pytest

from filter_service import constants as c
from filter_service.planning.grid import unit_direction
from filter_service.rendering.frame import (
    MODE_TOLERANCE_RATIO,
    detection_gain,
    smallest_spread_px,
    white_level,
)
from filter_service.rendering.frame_kernels import frame_kernels
from filter_service.rendering.image_cells import image_cells
from filter_service.rgbd_view import RgbdView
from tests.numerical.made_fragments import made_fragments
from tests.numerical.synthetic import Bench, psnr_db, texture
from tests.numerical.test_renderer_field import FieldBench, tangents_of

SIZE = 160
FOV_DEG = 90.0
ROUNDING_RATIO = 3e-4
"""Of float32 in the spread of a kernel and in the gain."""

ON_AXIS_CONTRAST = MODE_TOLERANCE_RATIO["on-axis"] * c.MERGE_CONTRAST

REACH_DEG = 3.0
"""From the gaze's margin inward: a block, and the kernels around it."""

STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}
WIDE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.0}


class MergeBench(Bench):
    """A camera of 90 degrees before an eye, with the gpu that its frames are on."""

    def __init__(self, engine, **settings):
        size = {"width_px": SIZE, "height_px": SIZE, "vertical_fov_deg": FOV_DEG}
        profile = {"kind": "preset", "name": "myopia"}
        super().__init__(engine, profile, **size, **settings)


@pytest.fixture(scope="module")
def bench(engine):
    return MergeBench(engine)


@pytest.fixture
def color(rng):
    """Texture of low contrast, so that blocks differ in how far they merge."""
    contrast = np.linspace(0.0, 0.06, SIZE)[:, None, None]
    return (0.4 + contrast * texture(rng, SIZE, SIZE)).astype(np.float32)


def eccentricity_deg(view_tangents, size_px, gaze_deg, pitch_px=1):
    """Angles (rows, columns) of squares of pixels from a gaze."""
    width, height = (n // pitch_px for n in size_px)
    left, right, up, down = view_tangents
    x = left + (np.arange(width) + 0.5) / width * (right - left)
    y = up + (np.arange(height) + 0.5) / height * (down - up)
    sources = np.stack(np.broadcast_arrays(x, y[:, None], -1.0), axis=-1)
    sources /= np.linalg.norm(sources, axis=-1, keepdims=True)
    return np.degrees(np.arccos(np.minimum(sources @ unit_direction(*gaze_deg), 1.0)))


def spread_px(bench, dpt):
    """Spread of the kernel of one distance, on axis."""
    layers = bench.layers(**WIDE)
    image = image_cells(bench.spec, bench.store.plan)
    used = np.ones((image.count, len(layers.layer_dpt) - 1), bool)
    kernels = frame_kernels(bench.store, layers, image, used)
    dpt = float(layers.vergence.vergence_dpt(dpt))
    place = np.interp(dpt, layers.layer_dpt, np.arange(len(layers.layer_dpt)))
    part = place - int(place)
    return float(kernels.spread_px[int(place)] @ (1.0 - part, part))


def merged_squares(linear, spread, gain):
    """Levels (rows, columns) of the square that each pixel is in, by the rule.

    Of one distance; `gain` (rows, columns) is of blocks.
    """
    level_of = np.zeros(linear.shape[:2], int)
    low = high = linear
    white = white_level(linear)
    is_whole = np.ones(linear.shape[:2], bool)
    for level in range(1, c.MAX_LEVEL + 1):
        shape = low.shape[0] // 2, 2, low.shape[1] // 2, 2
        low = low.reshape(*shape, 3).min(axis=(1, 3))
        high = high.reshape(*shape, 3).max(axis=(1, 3))
        is_whole = is_whole.reshape(shape).all(axis=(1, 3))
        factor = gain.repeat(8 >> level, axis=0).repeat(8 >> level, axis=1)
        scaled = spread / 2 ** (level - 1)
        most = ON_AXIS_CONTRAST * factor * white * scaled**c.MERGE_CONTRAST_POWER
        is_whole = is_whole & (scaled >= smallest_spread_px(factor))
        is_whole &= (high - low).max(axis=-1) <= most
        pixels = is_whole.repeat(2**level, axis=0).repeat(2**level, axis=1)
        level_of[pixels] = level
    return level_of


@pytest.mark.parametrize("gaze_deg", [(0.0, 0.0), (20.0, -12.0)])
def test_squares_are_those_of_the_twin(bench, color, gaze_deg):
    """Also for a gaze beyond the prepared range: the viewer looks there."""
    view = bench.view(color, 0.8, "radial")
    options = {"peripheral_merging": True, "gaze_deg": gaze_deg}
    bench.render(view, **WIDE, **options)
    found = made_fragments(bench, SIZE, SIZE)
    gain = detection_gain(eccentricity_deg(view.tangents, (SIZE, SIZE), gaze_deg, 8))
    assert gain.min() == 1.0
    assert gain.max() == 8.0
    spread = spread_px(bench, 1.0 / 0.8)
    assert 0.4 < spread < c.MERGE_MIN_SPREAD_PX  # the default merges nothing
    fewer, more = (
        merged_squares(color.astype(float), spread * ratio, gain)
        for ratio in (1.0 - ROUNDING_RATIO, 1.0 + ROUNDING_RATIO)
    )
    assert set(np.unique(more)) >= {0, 1, 2}
    assert np.mean(fewer != more) < 0.01
    edge_px = np.zeros((SIZE, SIZE), int)
    for x, y, edge in zip(found.x, found.y, found.edge_px, strict=True):
        edge_px[y : y + edge, x : x + edge] = edge
    assert np.all((edge_px == 2**fewer) | (edge_px == 2**more))


@pytest.mark.parametrize(
    "options",
    [
        {"peripheral_merging": False, "gaze_deg": (3.0, 0.0)},
        {"peripheral_merging": True},  # nobody knows where the viewer looks
        {"peripheral_merging": True, "gaze_deg": (3.0, 0.0), "merge": False},
        {"peripheral_merging": True, "gaze_deg": (3.0, 0.0), "accumulation": "paper"},
    ],
)
def test_frames_without_it_keep_their_bytes(bench, color, options):
    view = bench.view(color, 0.8, "radial")
    own = {name: options[name] for name in ("merge", "accumulation") if name in options}
    plain = bench.render(view, **WIDE, **own).color.copy()
    assert np.array_equal(bench.render(view, **WIDE, **options).color, plain)


def test_frames_with_and_without_it_alternate(bench, color):
    """Kernels that a state keeps have the levels that a frame merges by."""
    view = bench.view(color, 0.8, "radial")
    merged = {"peripheral_merging": True, "gaze_deg": (0.0, 0.0)}
    seen = [
        bench.render(view, **WIDE, **(merged if is_on else {})).color.copy()
        for is_on in (False, True, False, True)
    ]
    assert np.array_equal(seen[0], seen[2])
    assert np.array_equal(seen[1], seen[3])
    assert not np.array_equal(seen[0], seen[1])


@pytest.fixture(scope="module")
def field_bench(engine):
    return FieldBench(
        engine,
        "myopia",
        tangents_of(-40.0, 40.0, -40.0, 40.0),
        size=(3 * SIZE, 3 * SIZE),
        mode="dynamic",
        tolerance="normal",
        gaze_range_deg=(15.0, 0.0),
    )


def see_field(bench, color, gaze_deg, **options):
    depth_m = np.full(color.shape[:2], 1.0, np.float32)
    view = RgbdView(color, depth_m, bench.spec.camera.tangents)
    options = {**STATE, "gaze_deg": gaze_deg, **options}
    return bench.renderer.render(view, bench.handle, **options)


@pytest.mark.parametrize("gaze_deg", [(0.0, 0.0), (12.0, 0.0)])
def test_the_surroundings_of_the_gaze_stay_and_errors_follow_the_threshold(
    field_bench, rng, gaze_deg
):
    color = texture(rng, 3 * SIZE, 3 * SIZE)
    color[:16] = 1.0  # white
    assert white_level(color) == pytest.approx(1.0, rel=0.01)
    exact, plain, merged = (
        see_field(field_bench, color, gaze_deg, **options)
        for options in ({"merge": False}, {}, {"peripheral_merging": True})
    )
    assert merged.fragment_count < 0.7 * plain.fragment_count
    angle_deg = eccentricity_deg(
        field_bench.spec.camera.tangents, color.shape[:2], gaze_deg
    )
    within = angle_deg < c.DETECTION_MARGIN_DEG - REACH_DEG
    assert within.sum() > 100
    assert np.array_equal(merged.color[within], plain.color[within])
    wanted = exact.color.astype(float)
    default_db = psnr_db(plain.color[within], wanted[within])
    for low_deg in range(5, 45, 5):
        ring = (angle_deg >= low_deg) & (angle_deg < low_deg + 5)
        allowed_db = default_db - 20.0 * np.log10(detection_gain(low_deg + 5.0))
        assert psnr_db(merged.color[ring], wanted[ring]) >= allowed_db


def test_the_gain_stays_below_published_thresholds():
    """Contrast sensitivity at angles from the gaze, relative to the fovea's."""
    published = {  # deg: sensitivity, in order of angle from 0
        "Virsu & Rovamo 1979, 0.5 c/deg": {0: 177.2, 10: 58.5, 20: 29.0, 30: 16.3},
        "Virsu & Rovamo 1979, 1 c/deg": {0: 260.5, 10: 109.8, 20: 35.1, 30: 12.0},
        "Virsu & Rovamo 1979, 2 c/deg": {0: 334.4, 10: 114.2, 20: 19.1, 30: 3.0},
        "Virsu et al. 1982, 1 c/deg, 1 Hz": {0: 36.5, 7.5: 9.5, 14: 5.6, 30: 2.8},
        "Virsu et al. 1982, 1 c/deg, 18 Hz": {0: 22.5, 7.5: 10.5, 14: 5.6, 30: 2.6},
        "OSA 1988, TUH3, 3.2 c/deg, for 200 in the fovea": {0: 200.0, 30: 10.0},
    }
    for name, sensitivity in published.items():
        for angle_deg, value in sensitivity.items():
            assert detection_gain(angle_deg) <= sensitivity[0] / value, name
