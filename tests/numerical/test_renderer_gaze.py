"""A gaze that frames turn: the visual field goes with it, as far as was prepared."""

import numpy as np
import pytest

from filter_service.errors import BadMessage
from filter_service.rendering.engine import clamped_gaze
from filter_service.rgbd_view import RgbdView
from tests.grid_specs import grid_spec
from tests.numerical.synthetic import assert_same_frame, tangents, texture
from tests.numerical.test_renderer_field import (
    OBJECT_M,
    FieldBench,
    radial_depth_m,
)

WIDTH, HEIGHT = 160, 80
RANGE_DEG = (10.0, 6.0)


def bench_of(engine, size):
    return FieldBench(
        engine,
        "keratoconus",
        tangents(*size, 24.0),
        size=size,
        gaze_range_deg=RANGE_DEG,
        tolerance="normal",
    )


@pytest.fixture(scope="module")
def bench(engine):
    return bench_of(engine, (WIDTH, HEIGHT))


def see(bench, color, gaze_deg=None):
    depth_m = radial_depth_m(bench.spec, OBJECT_M).astype(np.float32)
    return bench.renderer.render(
        RgbdView(color, depth_m, bench.spec.camera.tangents),
        bench.handle,
        pupil_diameter_mm=5.0,
        focus_dpt=0.5,
        gaze_deg=gaze_deg,
    )


@pytest.mark.long("PSFs of an eye are computed for a gaze")
@pytest.mark.parametrize(
    "gaze_deg", [pytest.param((9.0, 0.0), marks=pytest.mark.slow), (-9.0, 3.0)]
)
def test_a_point_of_light_becomes_the_psf_of_its_direction_from_the_gaze(
    engine, gaze_deg
):
    """Against exact PSFs for gazes on the way there and beyond: this one is nearest.

    Pixels are finer than the PSFs' shapes, which the way through nodes smooths.
    """
    width, height = 4 * WIDTH, 4 * HEIGHT
    bench = bench_of(engine, (width, height))
    x, y, radius = width // 2 - round(16 * gaze_deg[0]), height // 2, 96
    point = np.zeros((height, width, 3), np.float32)
    point[y, x] = 1.0
    part = (slice(y - radius, y + radius + 1), slice(x - radius, x + radius + 1))
    seen = see(bench, point, gaze_deg).color[part].astype(float)
    errors, straight = {}, bench.spec
    for share in (0.0, 0.5, 0.75, 1.0, 1.25):
        turned = tuple(share * angle_deg for angle_deg in gaze_deg)
        bench.spec = straight.with_settings(gaze_deg=turned)
        psfs = bench.exact_kernels(np.array(x), np.array(y), OBJECT_M, radius)
        exact = np.stack([psf.kernel for psf in psfs], axis=-1)
        errors[share] = np.linalg.norm(seen - exact) / np.linalg.norm(exact)
    bench.spec = straight
    assert min(errors, key=errors.__getitem__) == 1.0, errors
    assert errors[1.0] <= 0.3, errors


def test_a_gaze_out_of_range_is_clamped_and_says_both(engine, bench, rng):
    color = texture(rng, HEIGHT, WIDTH)
    beyond, at_limit = see(bench, color, (25.0, -40.0)), see(bench, color, (10.0, -6.0))
    assert beyond.gaze_deg == at_limit.gaze_deg == (10.0, -6.0)
    is_exact = engine.name == "native"
    assert_same_frame(beyond.color, at_limit.color, is_exact=is_exact)
    (note,) = set(beyond.notes) - set(at_limit.notes)
    assert "(25, -40) deg" in note
    assert "(10, -6) deg used" in note
    straight = see(bench, color)
    assert straight.gaze_deg == (0.0, 0.0)
    assert np.abs(straight.color - beyond.color).max() > 0.01
    again = see(bench, color, (0.0, 0.0))
    assert_same_frame(again.color, straight.color, is_exact=is_exact)


@pytest.mark.parametrize("gaze_deg", [(np.nan, 0.0), (0.0, np.inf), (1.0,)])
def test_a_gaze_that_is_no_direction_is_refused(bench, gaze_deg):
    with pytest.raises(BadMessage, match="gaze_deg"):
        see(bench, np.zeros((HEIGHT, WIDTH, 3), np.float32), gaze_deg)


def spec_of(h_half_deg, **settings):
    right = float(np.tan(np.radians(h_half_deg)))
    return grid_spec(
        width_px=64,
        height_px=32,
        tangents=(-right, right, right / 2, -right / 2),
        **{"mode": "dynamic", **settings},
    )


def test_one_direction_for_the_whole_image_does_not_follow_the_gaze():
    spec = spec_of(20.0, mode="on-axis", gaze_range_deg=(30.0, 30.0))
    used_deg, notes = clamped_gaze(spec, (5.0, 0.0))
    assert used_deg == (0.0, 0.0)
    assert "on-axis" in notes[0]


def test_a_range_of_gaze_keeps_the_image_within_the_field():
    spec_of(40.0, gaze_deg=(10.0, 0.0), gaze_range_deg=(29.0, 0.0))
    with pytest.raises(ValueError, match=r"31 deg with a field of -50 to 30.* 80"):
        spec_of(40.0, gaze_deg=(10.0, 0.0), gaze_range_deg=(31.0, 0.0))
    with pytest.raises(ValueError, match="gaze_range_deg"):
        spec_of(40.0, gaze_range_deg=(0.0, -1.0))
    with pytest.raises(ValueError, match="gaze_deg"):
        spec_of(40.0, gaze_deg=(float("nan"), 0.0))
