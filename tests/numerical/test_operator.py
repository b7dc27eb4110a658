"""The linear operator: whole matrices, inner products, and the filter itself."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import lsqr

from estimator.profiles.parse import parse_profile
from filter_service import BadMessage, EyeFilter
from filter_service.camera import Camera
from filter_service.filtering.operator import ViewOperator, operator_options
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.media_effects import MediaEffects, begin_through_media
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.grid_specs import grid_spec

STATE = State(4.0, 0.5)
SMALL = Camera.from_fov(1.5, width_px=24, height_px=16)
LARGE = Camera.from_fov(4.0, width_px=83, height_px=57)

EYES = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)
HARDEST, FEW = "keratoconus", ("myopia", "keratoconus", "cataract")


def slow(value):
    return pytest.param(value, marks=pytest.mark.slow)


MEDIA = {
    "straylight": {"cataract": "nuclear"},
    "age_years": 70,
    "yellowing": "seen",
    "correction": {"sphere_dpt": -4.0, "cylinder_dpt": -1.5, "axis_deg": 30.0},
    "spectacle_magnification": True,
}


@pytest.fixture(scope="module")
def opened():
    """Return a function that returns the loaded store of a camera and an eye."""
    renderer, found = NativeRenderer(), {}

    def of(camera, name):
        if (camera, name) not in found:
            spec = grid_spec(camera=camera, mode="dynamic")
            profile = parse_profile({"kind": "preset", "name": name})
            found[camera, name] = renderer.load(build_psf_store(profile, spec))
        return found[camera, name]

    for camera, name in itertools.product((SMALL, LARGE), FEW):
        of(camera, name)
    yield of
    renderer.close()


def scene(kind, camera):
    """A view with black surfaces: flat, slanted, with an edge, or with a hidden layer.

    All but the flat one have edges of depth; the slanted one has pixels without depth.
    """
    height, width = camera.height_px, camera.width_px
    y, x = np.mgrid[:height, :width]
    disc = np.hypot(x - 0.45 * width, y - 0.5 * height) < 0.25 * height
    black = np.zeros((height, width, 3), np.uint8)
    depth_m = np.full((height, width), 3.0, np.float32)
    if kind == "slanted":
        depth_m = (0.4 + 3.0 * y / height + 0.5 * (x > width // 2)).astype(np.float32)
        depth_m[3:5, 7:9] = np.nan
    elif kind != "flat":
        depth_m[disc] = 0.5
    view = RgbdView(black, depth_m, camera.tangents)
    if kind != "hidden":
        return view
    hidden_m = np.where(disc, np.float32(3.0), np.float32(0.0))
    return replace(view, hidden_color=black, hidden_depth_m=hidden_m)


def operator_of(handle, view, *, effects=None, render_tolerance=1.0, n_threads=None):
    options = operator_options(render_tolerance)
    request = ViewRequest(view, handle, STATE, options=options)
    return ViewOperator.of(request, effects, n_threads=n_threads)


def media_of(name):
    profile = parse_profile({"kind": "preset", "name": name, **MEDIA})
    effects = MediaEffects.of(profile, "common")
    assert effects.straylight is not None
    assert effects.magnification_ratio is not None
    return effects


def impulses(shape, value):
    """Yield the index of each pixel, and its image; colors do not mix."""
    for at in np.ndindex(shape[:-1]):
        image = np.zeros(shape, np.float32)
        image[at] = value
        yield at, image


def matrices(operator):
    """Return matrix and transposed adjoint (image, color, 3), column by column.

    Columns of the adjoint are negative impulses.
    """
    color_shape, image_shape = operator.color_shape, operator.color_shape[-3:]
    of_forward = np.empty((*image_shape[:2], *color_shape))
    of_adjoint = np.empty_like(of_forward)
    for at, color in impulses(color_shape, 1.0):
        index = (slice(None), slice(None), *at)
        of_forward[index] = operator.forward(color)
    for at, image in impulses(image_shape, -2.0):
        of_adjoint[at] = operator.adjoint(image) / -2.0
    return of_forward, of_adjoint


@pytest.mark.parametrize("name", FEW)
@pytest.mark.parametrize("render_tolerance", [1.0, slow(0.0)])
def test_the_adjoint_is_the_transposed_matrix(opened, name, render_tolerance):
    view = scene("hidden", SMALL)
    handle = opened(SMALL, name)
    operator = operator_of(handle, view, render_tolerance=render_tolerance)
    forward, adjoint = matrices(operator)
    assert np.abs(adjoint - forward).max() <= 1e-6 * forward.max()
    assert forward.min() >= 0.0
    np.testing.assert_allclose(forward.sum(axis=(2, 3, 4)), 1.0, atol=2e-6)
    # The hidden layer takes part, and the disc does where it is blurred.
    assert forward[:, :, 1].sum() > 5.0
    assert 0.0 < forward[8, 1, 0, 8, 10, 1] + forward[8, 4, 0, 8, 6, 1] < 1.0


def test_the_adjoint_is_the_transposed_matrix_with_haze_and_spectacles(opened):
    view = scene("edge", SMALL)
    handle = opened(SMALL, "keratoconus")
    operator = operator_of(handle, view, effects=media_of("keratoconus"))
    forward, adjoint = matrices(operator)
    assert np.abs(adjoint - forward).max() <= 1e-6 * forward.max()
    assert forward.min() > 0.0  # straylight reaches every pixel


def test_colors_do_not_mix(opened, rng):
    operator = operator_of(opened(SMALL, "myopia"), scene("hidden", SMALL))
    color = rng.standard_normal(operator.color_shape).astype(np.float32)
    color[..., 1] = 0.0
    image = operator.forward(color)
    assert np.all(image[..., 1] == 0.0)
    assert np.abs(image[..., [0, 2]]).max() > 0.1
    back = operator.adjoint(color[0])
    assert np.all(back[..., 1] == 0.0)


def inner(first, second):
    return float(np.vdot(first.astype(float), second.astype(float)))


@pytest.mark.parametrize("name", [HARDEST, *(slow(n) for n in EYES if n != HARDEST)])
@pytest.mark.parametrize("kind", ["flat", "slanted", "edge", "hidden"])
def test_inner_products_agree(opened, rng, name, kind):
    """With haze and spectacles, and the same bytes for any number of threads."""
    view, effects = scene(kind, LARGE), media_of(name)
    found = []
    for n_threads in (1, 2):
        operator = operator_of(
            opened(LARGE, name), view, effects=effects, n_threads=n_threads
        )
        if not found:
            x = rng.random(operator.color_shape, dtype=np.float32)
            y = rng.random(operator.color_shape[-3:], dtype=np.float32)
        found.append((operator.forward(x), operator.adjoint(y)))
    (image, color), (image_2, color_2) = found
    assert image.tobytes() == image_2.tobytes()
    assert color.tobytes() == color_2.tobytes()
    assert inner(image, y) == pytest.approx(inner(x, color), rel=1e-5)


def filtered(view, handle, effects=None, **options):
    options = replace(operator_options(1.0), **options)
    request = ViewRequest(view, handle, STATE, options=options, output="linear")
    renderer = NativeRenderer()
    found = begin_through_media(renderer, request, effects)()
    renderer.close()
    return found.color


def lit(view, rng, gain=1.0):
    """Return a view with random colors, some of them very bright, and its colors."""
    shape = view.surface_count, view.height_px, view.width_px, 3
    colors = rng.random(shape, dtype=np.float32)
    colors[:, 4:6, 5::9] *= gain
    hidden = colors[1] if view.surface_count == 2 else None
    return replace(view, color=colors[0], hidden_color=hidden), colors


@pytest.mark.parametrize("kind", ["slanted", "edge", "hidden"])
@pytest.mark.parametrize("has_media", [False, True])
def test_it_is_the_filter_without_merging_and_bright_pixels(
    opened, rng, kind, has_media
):
    view, colors = lit(scene(kind, LARGE), rng, gain=300.0)
    handle = opened(LARGE, "keratoconus")
    effects = media_of("keratoconus") if has_media else None
    image = operator_of(handle, view, effects=effects).forward(
        colors if kind == "hidden" else colors[0]
    )
    expected = filtered(view, handle, effects)
    # Rounding: the filter divides by the coverage, the operator multiplies.
    np.testing.assert_allclose(image, expected, rtol=2e-6, atol=1e-6)
    special = filtered(view, handle, effects, bright_pixels=True)
    assert np.abs(special - expected).max() > 1e-3 * expected.max()


def test_without_bright_pixels_the_filter_is_linear(engine, opened, rng):
    """Sums and negative factors of images with edges, a hidden layer and lamps."""
    renderer = engine.new_renderer()
    handle = opened(LARGE, "myopia")
    if engine.gpu is not None:
        handle = renderer.load(handle.store)
    views = [lit(scene("hidden", LARGE), rng, gain=300.0)[0] for _ in range(2)]
    both = replace(
        views[0],
        color=views[0].color - 0.5 * views[1].color,
        hidden_color=views[0].hidden_color - 0.5 * views[1].hidden_color,
    )
    state = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
    errors = {}
    for bright_pixels in (False, True):
        options = {"merge": False, "bright_pixels": bright_pixels}
        one, other, sum_ = (
            renderer.render(view, handle, **state, **options).color.astype(float)
            for view in (*views, both)
        )
        errors[bright_pixels] = np.abs(one - 0.5 * other - sum_).max() / one.max()
    assert errors[False] <= 3e-6
    assert errors[True] > 1e-5


def test_an_empty_hidden_layer_has_no_effect(opened, rng):
    view = scene("hidden", SMALL)
    view = replace(view, hidden_depth_m=np.zeros_like(view.depth_m))
    operator = operator_of(opened(SMALL, "myopia"), view)
    x = rng.random(operator.color_shape, dtype=np.float32)
    image = operator.forward(x)
    x[1] = 7.0
    assert np.array_equal(image, operator.forward(x))
    color = operator.adjoint(image)
    assert color.shape == operator.color_shape
    assert not color[1].any()
    assert color[0].any()


def test_values_that_are_not_finite_count_as_0(opened):
    operator = operator_of(opened(SMALL, "myopia"), scene("edge", SMALL))
    x = np.zeros(operator.color_shape, np.float32)
    x[4, 5] = np.nan
    x[6, 7] = np.inf
    assert not operator.forward(x).any()
    assert not operator.adjoint(x).any()


@pytest.fixture(scope="module")
def eye_filter():
    with EyeFilter("myopia", SMALL, {"mode": "on-axis"}, engine="native") as made:
        made.wait()
        yield made


SEE = {"pupil_diameter_mm": STATE.pupil_diameter_mm, "focus_dpt": STATE.focus_dpt}


def test_an_eye_filter_returns_the_operator_of_its_frames(eye_filter, rng):
    view, (color,) = lit(scene("edge", SMALL), rng)
    operator = eye_filter.operator(view.depth_m, **SEE)
    assert operator.color_shape == operator.image_shape == (16, 24, 3)
    assert operator.shape == (1152, 1152)
    seen = eye_filter.filter(
        view, **SEE, merge=False, bright_pixels=False, output="linear"
    )
    image = operator.forward(color)
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, seen.color, rtol=2e-6, atol=1e-7)
    assert np.array_equal(eye_filter.operator(view, **SEE).forward(color), image)


def test_the_operator_of_several_views_has_their_number_first(eye_filter, rng):
    views = [scene("edge", SMALL), scene("slanted", SMALL)]
    operator = eye_filter.operator(views, **SEE)
    assert operator.color_shape == operator.image_shape == (2, 16, 24, 3)
    x = rng.random(operator.color_shape, dtype=np.float32)
    image, color = operator.forward(x), operator.adjoint(x)
    for view, own, seen, back in zip(views, x, image, color, strict=True):
        single = eye_filter.operator(view, **SEE)
        assert np.array_equal(single.forward(own), seen)
        assert np.array_equal(single.adjoint(own), back)
    with pytest.raises(BadMessage, match=r"views\[1\].*\(2, 16, 24, 3\)"):
        eye_filter.operator([views[0], scene("hidden", SMALL)], **SEE)


def test_scipy_solves_for_the_color(eye_filter, rng):
    """A sharp image is recovered from a blurred one: the far half of a picture."""
    operator = eye_filter.operator(scene("hidden", SMALL), **SEE)
    linear = operator.as_linear_operator()
    assert linear.shape == operator.shape == (1152, 2304)
    color = rng.random(operator.color_shape)
    image = linear @ color.ravel()
    solution = lsqr(linear, image, iter_lim=60)[0]
    assert np.abs(linear @ solution - image).max() <= 0.02 * image.max()
    y = rng.random(linear.shape[0])
    assert (linear.T @ y) @ color.ravel() == pytest.approx(y @ image, rel=1e-5)


@pytest.mark.parametrize(
    ("array", "shown"),
    [
        (np.zeros((16, 24, 3), np.uint8), "uint8"),
        (np.zeros((16, 24), np.float32), r"\(16, 24\)"),
        (np.zeros((16, 24, 3), complex), "complex128"),
    ],
)
def test_wrong_arrays_are_refused_by_shape_and_type(eye_filter, array, shown):
    operator = eye_filter.operator(scene("flat", SMALL), **SEE)
    for name, call in (("color", operator.forward), ("image", operator.adjoint)):
        with pytest.raises(BadMessage, match=rf"{name}.*{shown}.*\(16, 24, 3\)"):
            call(array)


def test_wrong_arguments_are_refused(eye_filter):
    with pytest.raises(BadMessage, match="depth"):
        eye_filter.operator(np.ones((16, 24)), **SEE)  # float64
    with pytest.raises(BadMessage, match="pupil_diameter_mm"):
        eye_filter.operator(scene("flat", SMALL), pupil_diameter_mm=40, focus_dpt=0)


def test_the_operator_outlives_its_filter(eye_filter, rng):
    with EyeFilter("myopia", SMALL, {"mode": "on-axis"}, engine="native") as short:
        operator = short.operator(scene("edge", SMALL), **SEE)
    x = rng.random(operator.color_shape, dtype=np.float32)
    same = eye_filter.operator(scene("edge", SMALL), **SEE).forward(x)
    np.testing.assert_allclose(operator.forward(x), same, rtol=1e-5)
