"""What a frame asks of an eye, read from its depth."""

import numpy as np
import pytest

from filter_service.building.jobs import LookAt
from filter_service.filtering.one_image import image_spec, object_range_dpt
from filter_service.filtering.view_use import frame_use, planes_of_view_dpt
from filter_service.rendering.frame import fill_missing_depth
from filter_service.rgbd_view import LEAST_DEPTH_M, RgbdView
from filter_service.settings import PLANE_ROOM_DPT

TANGENTS = (-0.6, 0.6, 0.4, -0.4)


def view(depth_m, depth_kind="planar", **hidden):
    color = np.zeros((*depth_m.shape, 3), np.float32)
    if hidden:
        hidden["hidden_color"] = color
    return RgbdView(color, depth_m.astype(np.float32), TANGENTS, depth_kind, **hidden)


def planes(*depths_m):
    """Stripes of equal depth."""
    depth_m = np.empty((80, 120))
    depth_m[:] = np.repeat(depths_m, 120 // len(depths_m))
    return depth_m


@pytest.mark.parametrize(
    ("depths_m", "expected_dpt"),
    [
        ((np.inf,), (0.0,)),
        ((0.5,), (2.0,)),
        ((np.inf, 0.25), (0.0, 4.0)),
        ((0.25, 2.0, 1.0), (0.5, 1.0, 4.0)),
        ((np.nan, 0.25), (4.0,)),
        ((0.0, -1.0), ()),
        ((5.0, 4.0, 3.0, 2.0, 1.0), ()),
        ((1.0, 0.02), ()),  # nearer than any PSF
    ],
)
def test_planes_are_found(depths_m, expected_dpt):
    assert planes_of_view_dpt(view(planes(*depths_m))) == pytest.approx(expected_dpt)


def test_depth_that_wavers_by_less_than_blur_shows_is_a_plane(rng):
    depth_m = planes(0.5) * (1.0 + 1e-3 * rng.uniform(-1.0, 1.0, (80, 120)))
    assert planes_of_view_dpt(view(depth_m)) == pytest.approx((2.0,), abs=2e-3)
    slope_m = 1.0 / np.linspace(1.0, 1.0 + 20 * PLANE_ROOM_DPT, 120)
    assert planes_of_view_dpt(view(np.tile(slope_m, (80, 1)))) == ()


def test_a_small_thing_before_a_plane_is_seen_and_distance_from_the_eye_is_none():
    depth_m = planes(2.0)
    depth_m[40:44, 61:65] = np.linspace(0.4, 0.6, 16).reshape(4, 4)
    found = planes_of_view_dpt(view(depth_m))
    assert len(found) != 1  # not the wall alone
    assert planes_of_view_dpt(view(planes(2.0), "radial")) == ()


@pytest.mark.parametrize("depth_m", [0.4, 0.4095, 0.41, 2.03, 7.7])
def test_all_of_a_plane_lies_within_its_range(depth_m):
    one = view(planes(depth_m))
    spec = image_spec(one, pupil_diameter_mm=4.0, focus_dpt=1.0)
    assert len(spec.settings.object_planes_dpt) == 1
    ((low_dpt, high_dpt),) = spec.object_ranges_dpt
    nearest_dpt = 1.0 / float(one.depth_m[0, 0])
    assert low_dpt <= nearest_dpt / spec.camera.corner_distance_ratio
    assert nearest_dpt <= high_dpt


def test_one_pixel_at_another_distance_counts_in_an_image():
    depth_m = planes(2.0)
    depth_m[41, 63] = 1.0
    assert planes_of_view_dpt(view(depth_m)) == (0.5,)
    spec = image_spec(view(depth_m), pupil_diameter_mm=4.0, focus_dpt=1.0)
    assert spec.settings.object_planes_dpt == (0.5, 1.0)


def test_what_is_hidden_counts():
    both = view(planes(0.5), hidden_depth_m=planes(4.0).astype(np.float32))
    assert planes_of_view_dpt(both) == pytest.approx((0.25, 2.0))


def test_views_of_a_frame_share_their_planes_and_ranges():
    look_at = LookAt(4.0, 1.0)
    use = frame_use([view(planes(0.5)), view(planes(2.0))], look_at, at_s=1.0)
    assert use.planes_dpt == pytest.approx((0.5, 2.0))
    stretch = np.sqrt(1.0 + 0.6**2 + 0.4**2)
    assert use.object_dpt == pytest.approx((0.5 / stretch, 2.0))
    scene = view(np.random.default_rng(0).uniform(1.0, 3.0, (80, 120)))
    assert frame_use([view(planes(0.5)), scene], look_at, at_s=1.0).planes_dpt == ()
    nothing = frame_use([view(planes(0.0))], look_at, at_s=1.0)
    assert nothing.object_dpt == (0.0, 0.0) and nothing.planes_dpt == ()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("depth_kind", ["planar", "radial"])
def test_depth_too_small_to_have_a_reciprocal_is_missing(depth_kind):
    denormal_m = np.finfo(np.float32).smallest_subnormal
    plain = planes(0.5)
    depth_m = plain.copy()
    depth_m[:4] = denormal_m
    depth_m[4:8] = 0.99 * LEAST_DEPTH_M
    hidden_m = np.full_like(depth_m, denormal_m)
    seen = view(depth_m, depth_kind, hidden_depth_m=hidden_m.astype(np.float32))
    filled_m, count = fill_missing_depth(seen.depth_m)
    assert count == 8 * 120 and (filled_m == 0.5).all()
    assert planes_of_view_dpt(seen) == planes_of_view_dpt(view(plain, depth_kind))
    look_at = LookAt(4.0, 0.0)
    ranges = [
        frame_use((v,), look_at, at_s=0.0).object_dpt
        for v in (seen, view(plain, depth_kind))
    ]
    assert ranges[0] == ranges[1]
    assert np.isfinite(object_range_dpt(seen)).all()
