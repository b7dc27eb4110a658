"""Light of all pixels beyond their kernels."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimator.native import core
from filter_service.camera import Camera
from filter_service.planning.grid import GridSpec
from filter_service.planning.plan import plan_cache
from filter_service.psfs.compute_kernels import computed_kernels, psf_engine
from filter_service.psfs.store import PsfStore
from filter_service.rendering import tails
from filter_service.rendering.edge_kinds import EdgeElements, EyeAtFrame
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.media_effects import (
    begin_through_media,
    linear_from_srgb,
    srgb_from_linear,
)
from filter_service.rendering.native import NativeRenderer
from filter_service.rendering.tails import KernelTails
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings, RenderOptions
from filter_service.view_state import State
from tests.numerical.plan_cases import traced_eye
from tests.numerical.synthetic import tangents
from tests.reference import tails as twin

WIDTH, HEIGHT = 206, 170  # not whole squares
PUPIL_MM, FOCUS_DPT = 4.5, 1.0
UNMERGED = RenderOptions(merge=False)


def letters():
    """White on black: bars of 4 px, and a block."""
    color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    color[30:90, 40:80:9] = color[30:90, 41:80:9] = 255
    color[30:90, 42:80:9] = color[30:90, 43:80:9] = 255
    color[40:80, 110:125] = 255
    return color


@cache
def store_of(eye_name, kept_energy_ratio=0.99, object_dpt=1.0):
    angle = tangents(WIDTH, HEIGHT, math.degrees(HEIGHT * 0.7e-3))
    settings = FilterSettings(
        mode="on-axis",
        pupil_range_mm=(PUPIL_MM, PUPIL_MM),
        focus_range_dpt=(FOCUS_DPT, FOCUS_DPT),
        object_planes_dpt=(object_dpt,),
    )
    spec = replace(
        GridSpec(Camera(WIDTH, HEIGHT, angle), settings),
        kept_energy_ratio=kept_energy_ratio,
    )
    eye = traced_eye(eye_name, spec)
    return PsfStore(eye, spec, plan_cache(eye, spec))


@cache
def native():
    return NativeRenderer()


def request_of(renderer, color, eye_name="emmetropia", depth_m=1.0, **more):
    store = store_of(eye_name, more.pop("kept", 0.99), more.pop("object_dpt", 1.0))
    depth = np.broadcast_to(np.float32(depth_m), color.shape[:2]).copy()
    view = RgbdView(color, depth, store.spec.camera.tangents, "radial")
    state = State(PUPIL_MM, FOCUS_DPT)
    more.setdefault("options", UNMERGED)
    return ViewRequest(view, renderer.load(store), state, **more)


def seen(request, renderer):
    return begin_through_media(renderer, request, None)().color


def plain(request, renderer):
    return renderer.begin(request)().color


@pytest.mark.parametrize(
    ("eye_name", "ratio"), [("emmetropia", 3.0), ("keratoconus", 3.0)]
)
def test_letters_are_as_through_uncut_kernels(eye_name, ratio):
    """The error of cut kernels falls to less than a third."""
    color, renderer = letters(), native()
    request = request_of(renderer, color, eye_name)
    uncut = plain(request_of(renderer, color, eye_name, kept=0.9995), renderer)
    errors = [
        np.sqrt(np.square(f(request, renderer) - uncut).mean()) for f in (plain, seen)
    ]
    assert errors[0] > ratio * errors[1]


@pytest.mark.parametrize(
    "eye_name", ["emmetropia", "myopia", "astigmatism", "keratoconus", "cataract"]
)
def test_points_keep_their_light(eye_name):
    """Kernels and tails contain 99.8 % of the light, and not more than there is."""
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    request = request_of(native(), white, eye_name)
    store = request.handle.store
    squares = KernelTails.of(request, None).squares
    added = squares[squares.shape[0] // 2, squares.shape[1] // 2, 4:7].mean()
    psfs = np.flatnonzero(store.tables.is_computed)
    packed, _ = computed_kernels(
        store.eye, store.spec, store.plan.nodes, psfs, psf_engine()
    )
    kept = 1.0 - packed.lost_energy_ratio.mean() + added
    assert 1.0 - packed.lost_energy_ratio.mean() < 0.996
    assert 0.998 <= kept <= 1.002


@pytest.mark.both_engines
@pytest.mark.parametrize("output", ["srgb8", "linear"])
def test_a_uniform_image_does_not_change(engine, output):
    renderer = engine.new_renderer()
    color = np.full((HEIGHT, WIDTH, 3), (188, 60, 7), np.uint8)
    depth_m = np.where(np.arange(WIDTH) < 77, 0.4, 3.0)
    request = request_of(renderer, color, depth_m=depth_m, output=output)
    found = seen(request, renderer)
    expected = color if output == "srgb8" else linear_from_srgb(color)
    np.testing.assert_allclose(found, expected, rtol=3e-6)


@pytest.mark.both_engines
@pytest.mark.parametrize("output", ["linear", "linear16", "srgb8"])
def test_pixels_receive_the_light_of_squares(engine, output):
    """The sum is that of NumPy in both engines."""
    renderer = engine.new_renderer()
    color = letters()
    request = request_of(renderer, color)
    squares = KernelTails.of(request, None).squares
    light = twin.enlarged(squares.astype(float), color.shape[:2], 4)
    before = plain(request, renderer).astype(float)
    expected = before * (1.0 - light[..., 4:7]) + light[..., :3]
    found = seen(replace(request, output=output), renderer)
    if output == "srgb8":
        wrong = found.astype(int) - srgb_from_linear(expected)
        assert np.abs(wrong).max() <= 1 and np.mean(wrong != 0) < 1e-3
        return
    rtol = 3e-6 if output == "linear" else 1e-3
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=1e-7)


@pytest.mark.parametrize("object_dpt", [1.0, 3.0])
def test_tails_are_the_light_of_the_edge(object_dpt):
    """Near the box at steps, and farther out, as in NumPy."""
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    request = request_of(
        native(), white, depth_m=1.0 / object_dpt, object_dpt=object_dpt
    )
    state = EyeAtFrame.of(request)
    kinds, _ = tails._kinds(state, request.view)
    kernels = state.kernels(kinds, None)
    maps, reach_px = state.ends_of(kinds, kernels)
    step_px = np.maximum(2 ** np.ceil(np.log2(reach_px / tails.BOX_STEPS)), 1)
    near, far = tails._tails(state, kinds, maps, step_px.astype(np.int64))
    elements = EdgeElements.of(state, kinds).elements[0, 1]
    box_px = boxes_of(request.handle.store, state, kinds)

    def omitted(x, y):
        found = np.ones(x.shape)
        for weight, (left, right, up, down) in box_px:
            found -= weight * (
                share(x, -left, right, step_px[0]) * share(y, -up, down, step_px[0])
            )
        return np.where(np.maximum(abs(x), abs(y)) > 15 * step_px[0], 1.0, found)

    exact = twin.tails(elements, omitted, step_px[0])
    for found, expected in zip((near, far), exact, strict=True):
        side = int(np.sqrt(found.shape[1]))
        margin = (expected.shape[0] - side) // 2
        expected = expected[margin : margin + side, margin : margin + side]
        np.testing.assert_allclose(
            found[0, :, 1].reshape(side, side), expected, rtol=2e-3, atol=2e-7
        )


def share(at, low, high, step_px):
    """Share of steps between the outer pixels of a box."""
    first = np.clip((at - (low - 0.5)) / step_px + 0.5, 0.0, 1.0)
    return first * np.clip(((high + 0.5) - at) / step_px + 0.5, 0.0, 1.0)


def boxes_of(store, state, kinds):
    """Weights and sides of the stored green kernels that a kernel consists of."""
    tables, reads, layers = store.tables, state.layers.reads, state.layers
    found = []
    upper = min(kinds.interval[0] + 1, layers.layer_dpt.size - 1)
    part = kinds.part_ratio[0]
    for layer, of_layer in ((kinds.interval[0], 1.0 - part), (upper, part)):
        total_dpt = layers.layer_dpt[layer] + layers.layer_zero_dpt[0, 1]
        for corner, group in enumerate(reads.groups):
            first, last = tables.starts[group], tables.starts[group + 1]
            at = total_dpt * reads.scales[corner] - tables.channel_shift_dpt[group, 1]
            node = np.arange(first, last)
            for n in node:
                hat = np.zeros(node.size)
                hat[n - first] = of_layer * reads.weights[corner]
                weight = float(np.interp(at, tables.values_dpt[node], hat))
                if weight:
                    word = int(tables.reach_words[3 * n + 1])
                    sides = [word >> shift & 255 for shift in (0, 8, 16, 24)]
                    found.append((weight, sides))
    return found


def test_squares_receive_what_others_send():
    """Of one distance, in a picture of random colors."""
    color = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    request = request_of(native(), color)
    state = EyeAtFrame.of(request)
    kinds, _ = tails._kinds(state, request.view)
    maps, _ = state.ends_of(kinds, state.kernels(kinds, None))
    near, far = (
        t[0].reshape(int(np.sqrt(t.shape[1])), -1, 3)
        for t in tails._tails(state, kinds, maps, np.ones(1, np.int64))
    )
    rows, columns = -(-HEIGHT // 4), -(-WIDTH // 4)
    linear = linear_from_srgb(color)
    means = np.stack(
        [
            [
                linear[4 * y : 4 * y + 4, 4 * x : 4 * x + 4].mean(axis=(0, 1))
                for x in range(columns)
            ]
            for y in range(rows)
        ]
    )
    found = KernelTails.of(request, None).squares
    for first, sent in ((0, means), (4, np.ones_like(means))):
        expected = twin.received(sent, near, far)
        np.testing.assert_allclose(
            found[..., first : first + 3], expected, rtol=1e-4, atol=1e-8
        )


def test_squares_of_many_distances_receive_the_share_of_each():
    """White has the same share everywhere that the light of white has."""
    color = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    depth_m = 1.0 / np.linspace(0.2, 4.0, WIDTH)
    request = request_of(native(), color, depth_m=depth_m)
    squares = KernelTails.of(request, None).squares
    assert squares[..., 4:7].min() > 1e-3
    np.testing.assert_allclose(squares[..., :3], squares[..., 4:7], rtol=1e-6)
    assert not squares[..., [3, 7]].any()


def test_the_light_does_not_depend_on_threads(monkeypatch):
    color = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    depth_m = 1.0 / np.linspace(0.2, 4.0, WIDTH)
    request, found = request_of(native(), color, depth_m=depth_m), []
    for count in (1, 2, 5):
        threads = core().new_threads(count)
        monkeypatch.setattr(tails, "shared_threads", lambda threads=threads: threads)
        image = np.full(color.shape, 0.5, np.float32)
        light = KernelTails.of(request, None)
        light.add(image)
        found.append((light.squares, image))
        core().end_threads(threads)
    for squares, image in found[1:]:
        np.testing.assert_array_equal(squares, found[0][0])
        np.testing.assert_array_equal(image, found[0][1])


def test_values_that_are_not_finite_send_no_light():
    color = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    color[60, 80] = np.nan
    color[61, 80, 0] = np.inf
    dark = color.copy()
    dark[60:62, 80] = 0.0
    found, expected = (
        KernelTails.of(request_of(native(), c), None).squares for c in (color, dark)
    )
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("kept", "options"),
    [
        (0.99, RenderOptions(bright_pixels=False)),
        (0.99, RenderOptions(accumulation="paper")),
        (0.998, RenderOptions()),
    ],
)
def test_frames_without_this_light(kept, options):
    """Linear frames, frames as published, and kernels that contain the light."""
    request = request_of(native(), letters(), kept=kept, options=options)
    assert KernelTails.of(request, None) is None
    np.testing.assert_array_equal(seen(request, native()), plain(request, native()))
