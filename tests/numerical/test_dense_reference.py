"""The renderer's references and baselines against plain loops and convolutions."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from filter_service.rgbd_view import RgbdView
from tests.benchmarks import dense_reference as dense_module
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.image_measures import measures
from tests.benchmarks.layered_baselines import barsky, celaya, depth_objects, gonzalez
from tests.benchmarks.paper_baselines import (
    paper_dynamic,
    paper_on_axis,
    paper_quality,
    predecessor,
    splat_sources,
)
from tests.benchmarks.paper_layout import (
    ON_AXIS,
    LayerAxis,
    PaperGrid,
    interval_count,
    paper_texture,
)
from tests.benchmarks.view_sources import EyeState, Window, view_sources
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.numerical.synthetic import psnr_db, tangents, texture
from tests.numerical.test_renderer_field import (
    FOCUS_DPT,
    PUPIL_MM,
    FieldBench,
    splat_exactly,
    tangents_of,
)

pytestmark = pytest.mark.tools

WIDTH, HEIGHT = 56, 42


class ExactBench(FieldBench):
    """The renderer's bench without a renderer: `exact_kernels` alone."""

    def __init__(self, state):
        self.spec, self.eye = state.spec, state.eye


def eye_state(
    name, view_tangents, mode="quality", size=(WIDTH, HEIGHT), focus_dpt=FOCUS_DPT
):
    spec = grid_spec(
        width_px=size[0],
        height_px=size[1],
        tangents=view_tangents,
        pupil_range_mm=(PUPIL_MM, PUPIL_MM),
        focus_range_dpt=(focus_dpt, focus_dpt),
        mode=mode,
    )
    return EyeState(traced_eye(name, spec), spec, PUPIL_MM, focus_dpt)


def radial_view(state, color, distance_dpt):
    shape = color.shape[:2]
    distance_m = 1.0 / np.broadcast_to(np.asarray(distance_dpt, float), shape)
    return RgbdView(
        color.astype(np.float32),
        distance_m.astype(np.float32),
        state.spec.camera.tangents,
        "radial",
    )


def off_axis():
    """Small kernels of strong coma, off both axes."""
    return eye_state("keratoconus", tangents_of(10, 22, 5, 14))


def on_axis():
    narrow = tangents(WIDTH, HEIGHT, 9.0)
    return eye_state("keratoconus", narrow, mode="on-axis")


def test_one_surface_equals_the_splat_of_every_pixel(rng):
    state = off_axis()
    color = texture(rng, HEIGHT, WIDTH)
    slope_x, slope_y = np.meshgrid(
        np.linspace(-1.0, 1.0, WIDTH), np.linspace(-1.0, 1.0, HEIGHT)
    )
    for distance_dpt in (1.0, 0.9 + 0.05 * slope_x + 0.03 * slope_y):
        view = radial_view(state, color, distance_dpt)
        sources = view_sources(view, state.spec)
        planar_m = 1.0 / sources.distance_dpt.reshape(HEIGHT, WIDTH)
        left, right, up, down = state.spec.camera.tangents
        x = left + (right - left) * (np.arange(WIDTH) + 0.5) / WIDTH
        y = up + (down - up) * (np.arange(HEIGHT) + 0.5) / HEIGHT
        planar_m = planar_m / np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2)
        truth = splat_exactly(ExactBench(state), color, planar_m)
        mean, seen = (
            dense_reference(view, state, bins=False, accumulation=rule, kept=False)
            for rule in ("sum", "coverage")
        )
        assert np.allclose(mean, truth, atol=2e-6)
        # Coverage stops at one, the plain splat does not: where PSFs change this fast,
        # sums are a few per cent off one.
        assert psnr_db(seen, truth) >= 54.0


def gathered(state, view, rule):
    """Sorted gather of every pixel in plain loops."""
    sources = view_sources(view, state.spec)
    psfs = state.exact_psfs(sources.h_deg, sources.v_deg, sources.distance_dpt)
    height, width = view.depth_m.shape
    out = np.empty((height, width, 3))
    order = np.argsort(-sources.distance_dpt, kind="stable")
    weights = np.zeros((height * width, 3, height, width))
    for n in range(height * width):
        y, x = divmod(n, width)
        for c in range(3):
            kernel = psfs[3 * n + c].kernel
            r = kernel.shape[0] // 2
            wide = np.zeros((height + 2 * r, width + 2 * r))
            wide[y : y + 2 * r + 1, x : x + 2 * r + 1] = kernel
            weights[n, c] = wide[r : r + height, r : r + width]
    for y, x, c in np.ndindex(height, width, 3):
        light, coverage = 0.0, 0.0
        # The four distances of the test blur more than 1 px apart: four depths.
        for distance_dpt in np.unique(sources.distance_dpt)[::-1]:
            here = [n for n in order if sources.distance_dpt[n] == distance_dpt]
            own = weights[here, c, y, x].astype(float)
            if rule != "coverage":
                for n, weight in zip(here, own, strict=True):
                    room = 1.0 - coverage
                    weight = weight * room
                    light += weight * sources.color[n, c]
                    coverage += weight
                continue
            share = min((1.0 - coverage) / max(own.sum(), 1e-12), 1.0)
            light += share * (own @ sources.color[here, c])
            coverage += share * own.sum()
        out[y, x, c] = light / coverage
    return out


def four_depths(rng, mode="quality"):
    size = (20, 14)
    state = eye_state("emmetropia", tangents_of(10, 14, 5, 8), mode, size=size)
    color = rng.random((size[1], size[0], 3))
    distance_dpt = rng.choice([0.25, 2.0, 4.0, 6.0], size=color.shape[:2])
    return state, radial_view(state, color, distance_dpt)


@pytest.mark.parametrize("rule", ["coverage", "paper"])
def test_surfaces_in_front_of_each_other_equal_a_sorted_gather(rng, rule):
    state, view = four_depths(rng)
    seen = dense_reference(view, state, bins=False, accumulation=rule, kept=False)
    assert np.allclose(seen, gathered(state, view, rule), atol=1e-6)


@pytest.mark.parametrize("rule", ["coverage", "paper"])
def test_baselines_add_up_as_they_say(rng, rule):
    """Layers of exact PSFs, so that nothing but the rule is left."""
    state, view = four_depths(rng, mode="on-axis")
    sources = view_sources(view, state.spec)
    nodes_dpt, node_of = np.unique(sources.distance_dpt, return_inverse=True)
    psfs = state.exact_psfs(*np.zeros((2, nodes_dpt.size)), nodes_dpt)
    radius = int(psfs.radius_px.max())
    layers = np.zeros((nodes_dpt.size, 3, 2 * radius + 1, 2 * radius + 1), np.float32)
    for n, psf in enumerate(psfs):
        inner = slice(radius - psf.radius_px, radius + psf.radius_px + 1)
        layers[n // 3, n % 3, inner, inner] = psf.kernel
    layer_of = np.repeat(node_of.reshape(-1, 1, 1), 3, axis=1)
    each = np.full(node_of.size, radius)
    ones = np.ones(layer_of.shape)
    seen, _ = splat_sources(view, state, sources, layers, layer_of, ones, each, rule)
    assert np.allclose(seen, gathered(state, view, rule), atol=1e-6)
    shared = dense_reference(view, state, bins=False, kept=False)
    assert np.allclose(seen, shared, atol=1e-6) == (rule == "coverage")


def test_a_near_plane_hides_the_blur_of_a_far_one():
    narrow = tangents(WIDTH, HEIGHT, 2.0)
    state = eye_state("emmetropia", narrow, mode="on-axis", focus_dpt=2.5)
    bright = np.zeros((HEIGHT, WIDTH, 3))
    bright[:, WIDTH // 2 :] = 1.0
    is_dark = np.arange(WIDTH)[None] < WIDTH // 2
    # The dark side is in focus; the bright one 2.5 dpt behind or before it.
    hidden, spilt = (
        dense_reference(
            radial_view(state, bright, np.where(is_dark, 2.5, bright_dpt)),
            state,
            bins=False,
            kept=False,
        )
        for bright_dpt in (0.01, 5.0)
    )
    psfs = state.exact_psfs(np.zeros(2), np.zeros(2), np.array([0.01, 5.0]))
    assert psfs.blur_radius_px.min() >= 5.0
    # green, in focus; away from the borders, beyond which nothing covers
    beside = (slice(12, -12), WIDTH // 2 - 4, 1)
    assert hidden[beside].max() <= 0.01
    assert spilt[beside].min() >= 0.05


def test_bins_cost_little(rng):
    state = off_axis()
    color = texture(rng, HEIGHT, WIDTH)
    view = radial_view(state, color, np.linspace(0.4, 1.4, WIDTH)[None])
    exact, in_bins = (
        dense_reference(view, state, bins=bins, kept=False) for bins in (False, True)
    )
    assert 55.0 <= psnr_db(in_bins, exact) <= 120.0


def test_a_window_is_that_part_of_the_whole(rng, monkeypatch):
    state = off_axis()
    color = texture(rng, HEIGHT, WIDTH)
    view = radial_view(state, color, np.linspace(0.4, 1.4, WIDTH)[None])
    places = view_sources(view, state.spec)
    reach_px = state.exact_psfs(
        places.h_deg[::7], places.v_deg[::7], places.distance_dpt[::7]
    ).radius_px.max()
    window = Window(x=WIDTH // 2, y=5, width_px=9, height_px=7)
    whole = dense_reference(view, state, bins=True, kept=False)
    monkeypatch.setattr(dense_module, "WINDOW_REACH_PX", int(reach_px) + 1)
    part = dense_reference(view, state, bins=True, kept=False, window=window)
    np.testing.assert_allclose(part, window.of(whole), rtol=1e-12)
    monkeypatch.setattr(dense_module, "WINDOW_REACH_PX", int(reach_px) // 2)
    with pytest.raises(ValueError, match="windows take in"):
        dense_reference(view, state, bins=True, kept=False, window=window)


def convolved(color, kernels):
    """Plain convolution, divided by what a white image gives."""
    planes = []
    for c, kernel in enumerate(kernels):
        white = fftconvolve(np.ones(color.shape[:2]), kernel, mode="same")
        planes.append(fftconvolve(color[..., c], kernel, mode="same") / white)
    return np.stack(planes, axis=-1)


PLANE_DPT = 1.125


@pytest.mark.parametrize("method", [barsky, celaya, gonzalez])
def test_layers_of_one_plane_are_a_convolution(rng, method):
    state = on_axis()
    color = texture(rng, HEIGHT, WIDTH)
    view = radial_view(state, color, PLANE_DPT)
    psfs = state.exact_psfs(np.zeros(1), np.zeros(1), np.array([PLANE_DPT]))
    plain = convolved(color, [psf.kernel.astype(float) for psf in psfs])
    assert np.allclose(method(view, state).color, plain, atol=1e-5)


@pytest.mark.parametrize("method", [predecessor, paper_on_axis])
def test_textures_of_one_plane_are_a_convolution(rng, method):
    state = on_axis()
    color = texture(rng, HEIGHT, WIDTH)
    view = radial_view(state, color, PLANE_DPT)
    made = paper_texture(state, ON_AXIS)
    layer = int(made.distance.position(np.array([PLANE_DPT]))[0][0])
    node = int(np.flatnonzero(np.isclose(ON_AXIS.distance_dpt, PLANE_DPT))[0])
    assert layer == made.distance.first_layer[node]
    kernels = made.weights[layer].astype(float)
    assert np.allclose(kernels.sum(axis=(1, 2)), 1.0, atol=1e-5)
    seen = method(view, state)
    assert np.allclose(seen.color, convolved(color, kernels), atol=2e-5)
    psfs = state.exact_psfs(np.zeros(1), np.zeros(1), np.array([PLANE_DPT]))
    exact = convolved(color, [psf.kernel.astype(float) for psf in psfs])
    assert psnr_db(seen.color, exact) >= 45.0
    assert seen.tap_count > 0


def test_off_axis_baselines_turn_kernels_the_right_way(rng):
    state = off_axis()
    color = texture(rng, HEIGHT, WIDTH, cell_px=2)
    view = radial_view(state, color, PLANE_DPT)
    exact = dense_reference(view, state, bins=False, kept=False)
    assert psnr_db(gonzalez(view, state, grid=(5, 5, 1)).color, exact) >= 47.0
    assert psnr_db(celaya(view, state, grid=(5, 5, 1)).color, exact) >= 47.0
    grid = PaperGrid(
        np.linspace(10.0, 22.0, 6),
        np.linspace(*state.spec.field_range_deg[1], 6),
        np.linspace(0.125, 2.125, 3),
        reduction=(1.0, 0.5),
    )
    assert psnr_db(paper_quality(view, state, grid=grid).color, exact) >= 45.0


def test_textures_blend_over_pupil_and_focus(rng):
    spec = grid_spec(
        width_px=WIDTH,
        height_px=HEIGHT,
        tangents=tangents_of(10, 13, 5, 7.25),
        pupil_range_mm=(4.0, 5.0),
        focus_range_dpt=(0.125, 1.125),
        mode="quality",
    )
    eye = traced_eye("emmetropia", spec)
    grid = PaperGrid(
        np.linspace(*spec.field_range_deg[0], 3),
        np.linspace(*spec.field_range_deg[1], 3),
        np.linspace(0.125, 2.125, 3),
        reduction=(100.0, 100.0),
    )
    at_nodes = EyeState(eye, spec, 5.0, 1.125)
    view = radial_view(at_nodes, texture(rng, HEIGHT, WIDTH), 0.125)
    blended = paper_dynamic(view, at_nodes, grid=grid)
    alone = paper_quality(view, at_nodes, grid=grid)
    assert np.allclose(blended.color, alone.color, atol=1e-6)
    between = EyeState(eye, spec, 4.5, 0.625)
    exact = dense_reference(view, between, bins=False, kept=False)
    seen = paper_dynamic(view, between, grid=grid).color
    # coarse on purpose: half-way on every axis
    assert psnr_db(seen, exact) >= 37.0
    assert psnr_db(seen, exact) >= psnr_db(alone.color, exact) + 6.0


def test_slices_of_a_slope_have_no_seams(rng):
    state = on_axis()
    color = texture(rng, HEIGHT, WIDTH)
    view = radial_view(state, color, np.linspace(0.4, 1.4, WIDTH)[None])
    exact = dense_reference(view, state, bins=False, kept=False)
    with_objects = barsky(view, state, slice_count=5).color
    without = barsky(view, state, slice_count=5, finds_objects=False).color
    assert psnr_db(with_objects, exact) >= psnr_db(without, exact) + 2.0


def test_objects_end_at_steps_of_depth():
    distance_dpt = np.full((6, 8), 1.0) + 0.01 * np.arange(8)
    distance_dpt[1:4, 2:5] = 2.0
    labels = depth_objects(distance_dpt)
    assert np.unique(labels).size == 2
    assert np.array_equal(labels == labels[2, 3], distance_dpt == 2.0)


def test_transitional_layers_follow_the_equations():
    radius_px = np.array([1.0, 1.4, 5.7, 2.5])
    # Eq. 8: ceil of the change, less one, between; one step more than layers.
    assert interval_count(radius_px, 0, None).tolist() == [1, 5, 4]
    assert interval_count(radius_px, 0, (1.0, 0.5)).tolist() == [1, 2, 2]
    assert interval_count(radius_px, 0, (100.0, 100.0)).tolist() == [1, 1, 1]
    # Eqs. 9 to 11: the largest over the other axes.
    field = np.stack([radius_px, radius_px[::-1]], axis=1)
    assert interval_count(field, 0, None).tolist() == [4, 5, 4]
    axis = LayerAxis.of(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1, 5, 4]))
    assert axis.count == 11
    lower, share = axis.position(np.array([-1.0, 0.5, 1.3, 3.0]))
    assert (lower + share).tolist() == pytest.approx([0.0, 0.5, 2.5, 10.0])
    assert np.allclose(
        axis.base + axis.fraction,
        np.interp(np.arange(11), axis.first_layer, np.arange(4)),
    )


def test_an_error_of_a_tenth_of_white_is_20_db(rng):
    image = rng.random((20, 30, 3))
    assert measures(image + 0.1, image).psnr_db == pytest.approx(20.0)
    # 8-bit sRGB of 0.2140 and 0.2159 is 127 and 128
    dark, bright = (np.full((4, 4, 3), light) for light in (0.2140, 0.2159))
    step_db = -20.0 * np.log10(1.0 / 255.0)
    assert measures(dark, bright).psnr_srgb8_db == pytest.approx(step_db)
