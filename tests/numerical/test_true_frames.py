"""Points, lateral color and windows of frames with a render tolerance of 0."""

import math

import numpy as np
import pytest

from filter_service.camera import Camera
from filter_service.planning.plan import plan_axes
from filter_service.psfs.store import PsfStore
from filter_service.rgbd_view import RgbdView
from tests.conftest import Engine
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.numerical.synthetic import psnr_db, texture
from tests.reference.point_image import point_wavefronts

SIDE_PX = 61
MIDDLE = SIDE_PX // 2
STATE = {"pupil_diameter_mm": 4.3, "focus_dpt": 1.0}
OBJECT_DPT = 1.7
PLACE_DEG = 12.0, 6.0


def camera_at(place_deg, size_px=(SIDE_PX, SIDE_PX)):
    """Camera of pixels of 1 mrad around a direction."""
    h, v = np.radians(place_deg)
    x, y = math.tan(h), math.tan(v) / math.cos(h)
    half_x, half_y = (0.0005 * n for n in size_px)
    return Camera(*size_px, (x - half_x, x + half_x, y + half_y, y - half_y))


def store_of(eye_name, camera, **settings):
    ranges = {"pupil_range_mm": (4.0, 4.6), "focus_range_dpt": (0.5, 3.0)}
    spec = grid_spec(camera, **(ranges | settings))
    eye = traced_eye(eye_name, spec)
    return PsfStore(eye, spec, plan_axes(eye, spec))


def exact_image(store, **state):
    """Image (SIDE_PX, SIDE_PX, 3) of the middle pixel, by quadrature."""
    points = point_wavefronts(
        *(store.eye, store.spec.camera, MIDDLE, MIDDLE),
        **(STATE | {"object_dpt": OBJECT_DPT} | state),
        wavelengths_nm=store.spec.wavelengths_nm,
        lateral_color=store.spec.settings.lateral_color,
    )
    images = [point.image(max_radius_px=MIDDLE) for point in points]
    return np.stack(
        [
            np.pad(image, MIDDLE - len(image) // 2)  # narrower images are whole
            for image in images
        ],
        axis=-1,
    )


def point_image(engine, store, **state):
    """Image of the middle pixel, in a frame that is black elsewhere."""
    renderer = engine.new_renderer()
    color = np.zeros((SIDE_PX, SIDE_PX, 3), np.float32)
    color[MIDDLE, MIDDLE] = 1.0
    object_dpt = state.pop("object_dpt", OBJECT_DPT)
    depth_m = np.full((SIDE_PX, SIDE_PX), 1.0 / object_dpt, np.float32)
    view = RgbdView(color, depth_m, store.spec.camera.tangents, "radial")
    seen = renderer.render(
        view, renderer.load(store), **(STATE | state), render_tolerance=0.0
    )
    return seen.color.astype(np.float64)


@pytest.fixture(scope="module")
def point():
    """Store of keratoconus, and the exact image of a point."""
    store = store_of("keratoconus", camera_at(PLACE_DEG), mode="quality")
    return store, exact_image(store)


@pytest.mark.both_engines
def test_a_point_has_the_image_of_its_own_direction_and_state(engine, point):
    store, exact = point
    seen = point_image(engine, store)
    assert np.abs(seen - exact).sum(axis=(0, 1)).max() / 2.0 < 0.015
    np.testing.assert_allclose(seen.sum(axis=(0, 1)), 1.0, atol=2e-3)


def test_faint_light_around_a_sharp_point_is_not_doubled():
    # The stored kernel and the frame's kernel are both cut to whole steps, which raised
    # the same pixels: light between 8 and 16 px was 1.8 times the truth.
    state = {"pupil_diameter_mm": 3.0, "focus_dpt": 0.5, "object_dpt": 0.5}
    store = store_of(
        *("emmetropia", camera_at((0.0, 0.0))),
        mode="on-axis",
        pupil_range_mm=(3.0, 3.0),
        focus_range_dpt=(0.5, 0.5),
    )
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] - MIDDLE
    is_around = (np.hypot(rows, columns) > 8.0) & (np.hypot(rows, columns) < 16.0)
    seen = point_image(Engine("native"), store, **state)[is_around].sum(axis=0)
    exact = exact_image(store, **state)[is_around].sum(axis=0)
    np.testing.assert_allclose(seen / exact, 1.0, atol=0.35)


COLOR_STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 1.0, "object_dpt": 1.0}


@pytest.fixture(scope="module")
def colored():
    """Store with lateral color off the axis, and the exact image of a sharp point."""
    store = store_of(
        "emmetropia", camera_at(PLACE_DEG), mode="quality", lateral_color=True
    )
    return store, exact_image(store, **COLOR_STATE)


def apart_px(image, radius_px=24):
    """Centroids x, y (2, 2) of red and blue minus that of green."""
    inner = slice(MIDDLE - radius_px, MIDDLE + radius_px + 1)
    light, along = image[inner, inner], np.arange(-radius_px, radius_px + 1.0)
    centroids = np.stack(
        [np.einsum("yxc,x->c", light, along), np.einsum("yxc,y->c", light, along)]
    ) / light.sum(axis=(0, 1))
    return centroids[:, [0, 2]] - centroids[:, 1:2]


@pytest.mark.both_engines
def test_red_and_blue_lie_where_their_chief_rays_do(engine, colored):
    store, exact = colored
    expected_px = apart_px(exact)
    assert np.linalg.norm(expected_px, axis=0).min() > 0.4
    seen = point_image(engine, store, **COLOR_STATE)
    np.testing.assert_allclose(apart_px(seen), expected_px, atol=0.02)


WINDOW_AT, WINDOW_PX, BORDER_PX = (13, 7), (71, 55), 20


@pytest.fixture(scope="module")
def windows(engine):
    """The same part of a full frame, and of the frame of a camera's window."""
    full = camera_at(PLACE_DEG, (97, 73))
    color = texture(np.random.default_rng(3), 73, 97)
    (x, y), (width, height) = WINDOW_AT, WINDOW_PX
    left, _, up, _ = full.tangents
    window = Camera(
        *WINDOW_PX,
        (
            *(left + 0.001 * x, left + 0.001 * (x + width)),
            *(up - 0.001 * y, up - 0.001 * (y + height)),
        ),
    )
    part = slice(y, y + height), slice(x, x + width)
    seen = []
    for camera, own in ((full, color), (window, color[part])):
        store = store_of("myopia", camera, mode="quality")
        renderer = engine.new_renderer()
        depth_m = np.full(own.shape[:2], 0.5, np.float32)
        view = RgbdView(np.ascontiguousarray(own), depth_m, camera.tangents, "radial")
        frame = renderer.render(
            view, renderer.load(store), **STATE, render_tolerance=0.0
        )
        seen.append(frame.color)
    return seen[0][part], seen[1]


def test_a_window_equals_its_part_of_the_full_frame(windows):
    inner = slice(BORDER_PX, -BORDER_PX)
    expected, seen = (frame[inner, inner] for frame in windows)
    assert psnr_db(seen, expected) >= 60.0
