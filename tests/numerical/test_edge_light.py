"""Light beyond the kernels of bright pixels, against brute force."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from estimator.psf.tables import N_EDGE
from filter_service import EyeFilter
from filter_service.camera import Camera
from filter_service.planning.plan import plan_cache
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import PsfStore
from filter_service.rendering import edge_kinds, edge_light
from filter_service.rendering.edge_kinds import (
    FADE_WHITE,
    BrightPixels,
    EyeAtFrame,
    SourceKinds,
)
from filter_service.rendering.edge_light import EdgeLight
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.frame import white_level
from filter_service.rendering.light_kernels import seen_by_edges
from filter_service.rendering.media_effects import begin_through_media, encoded
from filter_service.rgbd_view import RgbdView
from filter_service.settings import RenderOptions
from filter_service.view_state import State
from tests.grid_specs import grid_spec
from tests.numerical.synthetic import Bench, assert_same_frame, tangents, texture
from tests.reference.edge_light import lamp_light, ring_ratios

WIDTH, HEIGHT = 180, 160
X, Y, RADIUS = 90, 80, 40
WIDE_RADIUS = 56
"""Where the spot itself is 9 px wide."""

FIELD_DEG = np.degrees(HEIGHT * 0.7e-3)  # pixels of 0.7 mrad
EMMETROPE = {
    "kind": "prescription",
    "sphere_dpt": 0.0,
    "higher_order": "none",
    "age_years": 30,
}
ASTIGMAT = {**EMMETROPE, "sphere_dpt": -1.0, "cylinder_dpt": -4.0, "axis_deg": 30}
LAMP = 1000.0
PUPIL_MM = 4.0


class EyeBench(Bench):
    """A bench of a traced eye, whose pupil and wavefront change over the field."""

    def __init__(self, engine, profile, eccentricity_deg, **more):
        self.width_px, self.height_px = WIDTH, HEIGHT
        self.tangents = tangents(WIDTH, HEIGHT, FIELD_DEG)
        self.spec = grid_spec(
            width_px=WIDTH,
            height_px=HEIGHT,
            tangents=self.tangents,
            mode="quality",
            gaze_deg=(-eccentricity_deg, 0.0),
            pupil_range_mm=(PUPIL_MM, PUPIL_MM + 0.5),
            focus_range_dpt=(0.0, 3.0),
            object_range_dpt=(0.0, 2.5),
            **more,
        )
        eye, _ = eye_for_spec(parse_profile(profile), self.spec)
        self.store = PsfStore(eye, self.spec, plan_cache(eye, self.spec))
        self.gpu = engine.gpu
        self.renderer = engine.new_renderer()
        self.handle = self.renderer.load(self.store)


BENCHES = {}


def bench_of(engine, profile=EMMETROPE, eccentricity_deg=0.0):
    """Return one bench for each eye: frames depend on their input alone."""
    key = engine.name, repr(profile), eccentricity_deg
    if key not in BENCHES:
        BENCHES[key] = EyeBench(engine, profile, eccentricity_deg)
    return BENCHES[key]


def dark():
    return np.zeros((HEIGHT, WIDTH, 3), np.float32)


def request_of(bench, color, depth_m=1e6, focus_dpt=0.0, hidden=None, **more):
    view = bench.view(color, depth_m, "radial")
    if hidden is not None:
        hidden_color, hidden_m = hidden
        view = replace(view, hidden_color=hidden_color, hidden_depth_m=hidden_m)
    return ViewRequest(view, bench.handle, State(PUPIL_MM, focus_dpt), **more)


def seen(bench, *given, **more):
    return begin_through_media(
        bench.renderer, request_of(bench, *given, **more), None
    )().color


def without(bench, *given, **more):
    return bench.renderer.begin(request_of(bench, *given, **more))().color


def around(color, radius_px=RADIUS):
    """Green within a radius of the lamp, as shares of its light."""
    rows, columns = (slice(at - radius_px, at + radius_px + 1) for at in (Y, X))
    return color[rows, columns, 1] / LAMP


def lamp_at(x=X, y=Y):
    color = dark()
    color[y, x] = LAMP
    return color


@pytest.mark.long("the light of each pixel by quadrature")
@pytest.mark.parametrize(
    ("profile", "focus_dpt", "eccentricity_deg"),
    [
        (EMMETROPE, 1.0, 0.0),
        (ASTIGMAT, 0.0, 30.0),
        pytest.param(EMMETROPE, 0.0, 0.0, marks=pytest.mark.slow),
        pytest.param(EMMETROPE, 0.0, 30.0, marks=pytest.mark.slow),
        pytest.param(EMMETROPE, 1.0, 30.0, marks=pytest.mark.slow),
        pytest.param(EMMETROPE, 3.0, 0.0, marks=pytest.mark.slow),
        pytest.param(EMMETROPE, 3.0, 30.0, marks=pytest.mark.slow),
        pytest.param(ASTIGMAT, 0.0, 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_lamp_has_the_exact_halo(engine, profile, focus_dpt, eccentricity_deg):
    """Rings within 6 %, and sixteenths of rings, which are the streaks, within 10 %.

    At the tips of an astigmatic spot, a caustic meets the end of the kernel.
    """
    ring_error, sector_error = (0.10, 0.15) if profile is ASTIGMAT else (0.06, 0.10)
    radius_px = WIDE_RADIUS if focus_dpt == 3.0 else RADIUS
    bench = bench_of(engine, profile, eccentricity_deg)
    color = lamp_at()
    whole = without(bench, color, focus_dpt=focus_dpt)
    plain = around(whole, radius_px)
    found = around(seen(bench, color, focus_dpt=focus_dpt), radius_px)
    exact = lamp_light(
        bench.store,
        *(X, Y),
        pupil_mm=PUPIL_MM,
        focus_dpt=focus_dpt,
        object_dpt=1e-6,
        radius_px=radius_px,
        channel=1,
    )
    ratios = ring_ratios(found, exact, plain <= 0.0, 6, 16)
    assert np.abs(ratios[:, -1] - 1.0).max() <= ring_error
    assert np.nanmax(np.abs(ratios - 1.0)) <= sector_error
    inside, total = plain > 0.0, whole[..., 1].sum() / LAMP
    assert found[inside].sum() == pytest.approx(exact[inside].sum() * total, rel=1e-3)


@pytest.mark.long("the light of each pixel by quadrature")
@pytest.mark.both_engines
@pytest.mark.parametrize("apart_px", [pytest.param(2, marks=pytest.mark.slow), 0])
def test_a_half_hidden_lamp_has_the_halo_of_the_rest_of_the_pupil(engine, apart_px):
    """An edge at 0.5 m beside the lamp, or in front of it: its right half is hidden."""
    bench = bench_of(engine)
    depth_m = np.full((HEIGHT, WIDTH), 1e6, np.float32)
    depth_m[:, X + apart_px :] = 0.5
    hidden = dark(), np.where(depth_m < 1.0, np.float32(1e6), np.float32(0.0))
    (hidden[0] if apart_px <= 0 else (color := dark()))[Y, X] = LAMP
    if apart_px <= 0:
        color = dark()
    found = around(seen(bench, color, depth_m, hidden=hidden))
    exact = lamp_light(
        bench.store,
        *(X, Y),
        pupil_mm=PUPIL_MM,
        focus_dpt=0.0,
        object_dpt=1e-6,
        radius_px=RADIUS,
        channel=1,
        cut_mm=(apart_px - 0.5) * 0.7 / 2.0,
    )
    spot = around(without(bench, lamp_at())) > 0.0
    ratios = ring_ratios(found, exact, ~spot, 3, 8)
    assert np.abs(ratios[:, -1] - 1.0).max() <= 0.05
    assert np.nanmax(np.abs(ratios - 1.0)) <= 0.10


def test_a_hidden_lamp_does_not_leak(engine):
    bench = bench_of(engine)
    depth_m = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    depth_m[:, : X - 40] = 1e6
    hidden = lamp_at(), np.where(depth_m < 1.0, np.float32(1e6), np.float32(0.0))
    arguments = {"depth_m": depth_m, "hidden": hidden}
    found, plain = (f(bench, dark(), **arguments) for f in (seen, without))
    ratio = 1.0 - 0.02  # the lamp is dimmed by the light beyond its kernel
    assert np.all(found <= plain + 1e-7)
    assert np.all(found >= ratio * plain - 1e-7)


@pytest.mark.parametrize("beside_px", [1, 3, 5])
def test_an_edge_hides_a_lamp_gradually(beside_px):
    """From each element of the pupil's edge, while the pupil grows."""
    size_px, edge_px = 48, 20
    depth_m = np.full((size_px, size_px), 4.0, np.float32)
    depth_m[:, :edge_px] = 0.5
    color = np.zeros((size_px, size_px, 3), np.float32)
    color[20, edge_px - 1 + beside_px] = 1.0
    view = RgbdView(color, depth_m, (-0.1, 0.1, 0.1, -0.1), "radial")
    pixels = BrightPixels.of(view, 0.0)
    angle = 2.0 * np.pi * np.arange(N_EDGE) / N_EDGE
    disc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = np.concatenate(
        [
            seen_by_edges(view, pixels, np.zeros(1, int), shift_px * disc[None])
            for shift_px in np.linspace(0.2, 4.0, 400)
        ]
    )
    assert seen.min() == 0.0
    assert np.abs(np.diff(seen, axis=0)).max() < 0.1


def test_a_lamp_in_front_is_not_hidden_by_what_is_behind(engine):
    bench = bench_of(engine)
    depth_m = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    depth_m[:, X + 3 :] = 1e6
    beside, alone = (
        seen(bench, lamp_at(), depth, focus_dpt=2.0) for depth in (depth_m, 0.5)
    )
    far = np.abs(np.arange(WIDTH) - X) > 20
    np.testing.assert_allclose(beside[Y, far], alone[Y, far], rtol=1e-5)


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32])
def test_pictures_of_displayed_range_have_no_bright_pixels(engine, rng, dtype):
    bench = bench_of(engine)
    color = rng.random((HEIGHT, WIDTH, 3))
    color = (
        (255.0 * color).astype(np.uint8) if dtype == np.uint8 else color.astype(dtype)
    )
    request = request_of(bench, color, output="srgb8")
    begin_through_media(bench.renderer, request, None)()
    assert "edge_light_ms" not in request.times.ms
    off = {"output": "srgb8", "options": RenderOptions(bright_pixels=False)}
    found, plain = (f(bench, color, **off) for f in (seen, without))
    assert_same_frame(found, plain, is_exact=engine.name == "native")


def lit(level):
    """A lamp of a level in a gray room, which is white."""
    color = np.full((HEIGHT, WIDTH, 3), 1.0, np.float32)
    color[Y - 1 : Y + 2, X - 1 : X + 2] = level
    return color


@pytest.mark.both_engines
def test_the_light_of_a_pixel_is_proportional_to_it(engine):
    """Whether squares of pixels send it or, from 4 to 8 times white on, it itself."""
    bench = bench_of(engine)
    levels = np.array([*np.linspace(*FADE_WHITE, 5), 100.0])
    added = [
        seen(bench, lit(level))[Y, X + 12, 1] - without(bench, lit(level))[Y, X + 12, 1]
        for level in levels
    ]
    # Squares of 4 px send 0.82 of it here, 12 px away; lamps alone 1.00 to 1.02.
    np.testing.assert_allclose(added / (levels - 1.0), added[-1] / 99.0, rtol=0.2)


@pytest.mark.parametrize("level", [1.0, 5.0, 20.0, 1000.0])
def test_one_bright_pixel_does_not_move_the_white_level(rng, level):
    """At most to those of its neighbors, if it is next to a sample."""
    color = texture(rng, HEIGHT, WIDTH) ** 2
    white = white_level(color)
    assert 0.7 * color.max() < white <= color.max()
    for y, x in 8 * rng.integers((HEIGHT // 8, WIDTH // 8), size=(20, 2)):
        one = color.copy()
        one[y, x] = level * white
        assert white_level(one) == pytest.approx(white, rel=0.01)
        assert white_level(4.0 * one) == pytest.approx(4.0 * white_level(one))


@pytest.mark.parametrize("share", [0.001, 0.03, 0.08])
def test_lamps_do_not_set_the_white_level(rng, share):
    """A window may fill nearly a tenth of the image."""
    color = texture(rng, HEIGHT, WIDTH) ** 2
    white = white_level(color)
    edge_px = int(np.sqrt(share * HEIGHT * WIDTH))
    color[60 : 60 + edge_px, 64 : 64 + edge_px] = LAMP
    assert 0.95 * white < white_level(color) < 1.7 * white


@pytest.mark.parametrize("level", [1.0, 20.0])
def test_other_pixels_keep_their_light_beside_a_bright_pixel(engine, rng, level):
    """Neither does another lamp change."""
    bench = bench_of(engine)
    color = texture(rng, HEIGHT, WIDTH) ** 2
    color[Y, X] = 60.0
    before = without(bench, color, 0.4)
    color[8, 16] = level
    after = without(bench, color, 0.4)
    far = np.hypot(*(np.indices((HEIGHT, WIDTH)) - [[[8]], [[16]]])) > 60.0
    np.testing.assert_array_equal(after[far], before[far])
    assert np.abs(after[~far] - before[~far]).max() > 1e-3


@pytest.mark.both_engines
def test_the_light_is_conserved(engine):
    """What is beyond the image is missing: 1e-3 of the light of a sharp lamp."""
    bench = bench_of(engine)
    found, plain = (f(bench, lamp_at()).sum(axis=(0, 1)) for f in (seen, without))
    np.testing.assert_allclose(found, plain, rtol=1.5e-3)


@pytest.mark.parametrize("unit", [1e-3, 2.0**-20])
def test_the_light_scales_with_the_scene(engine, unit):
    bench = bench_of(engine)
    color = lit(900.0)
    scaled = seen(bench, (unit * color).astype(np.float32)) / unit
    np.testing.assert_allclose(scaled, seen(bench, color), rtol=2e-5)


def test_half_floats_are_like_their_floats(engine):
    bench = bench_of(engine)
    color = lit(900.0)
    half = seen(bench, color.astype(np.float16))
    np.testing.assert_allclose(half, seen(bench, color), rtol=2e-3)


@pytest.mark.both_engines
@pytest.mark.parametrize("output", ["srgb8", "linear16"])
def test_outputs_are_encodings_of_the_same_light(engine, output):
    bench = bench_of(engine)
    from filter_service.rendering.media_effects import (
        half_from_linear,
        srgb_from_linear,
    )

    linear = seen(bench, lit(900.0))
    found = seen(bench, lit(900.0), output=output).astype(
        int if output == "srgb8" else float
    )
    wanted = {"srgb8": srgb_from_linear, "linear16": half_from_linear}[output](linear)
    tolerance = 1 if output == "srgb8" else 1e-6
    assert np.abs(found - wanted.astype(found.dtype)).max() <= tolerance


def test_values_that_are_not_finite_are_no_sources(engine):
    bench = bench_of(engine)
    color = lit(900.0)
    color[3, 4] = [np.inf, np.nan, 1e6]
    found = seen(bench, color)
    assert np.isfinite(found).all()
    assert found[3, 4, 0] < 1.0 < found[3, 4, 2]


def test_any_light_can_be_encoded():
    """A value that is not a number must not become an index beyond the table."""
    values = [np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 0.0, 0.5, 1.0]
    color = np.array(values * 3, np.float32).reshape(2, 4, 3)
    found = encoded(color, "srgb8").reshape(-1)[:8]
    np.testing.assert_array_equal(found, [0, 255, 0, 255, 0, 0, 188, 255])


@pytest.mark.parametrize(
    ("dtype", "level"), [(np.float32, 3e37), (np.float32, 1e30), (np.float16, 6e4)]
)
@pytest.mark.parametrize("output", ["linear", "srgb8"])
def test_the_brightest_light_remains_finite(engine, rng, dtype, level, output):
    """A third of the pixels at any distance, some of which are missing."""
    bench = bench_of(engine)
    color = rng.random((HEIGHT, WIDTH, 3))
    color[rng.random((HEIGHT, WIDTH)) < 0.3] = level
    depth_m = rng.choice([0.05, 1.0, np.inf, np.nan, 0.0], size=(HEIGHT, WIDTH))
    found = seen(bench, color.astype(dtype), depth_m.astype(np.float32), output=output)
    assert np.isfinite(found).all()


def scattered(rng):
    """Sixty lamps of several levels, and a window, before two distances."""
    color = np.full((HEIGHT, WIDTH, 3), 0.4, np.float32)
    at = rng.integers(0, HEIGHT * WIDTH, 60)
    color.reshape(-1, 3)[at] = rng.uniform(20.0, 600.0, (60, 1))
    color[20:40, 100:140] = 30.0
    depth_m = np.where(np.arange(WIDTH) < 70, 0.6, 4.0).astype(np.float32)
    return color, np.broadcast_to(depth_m, (HEIGHT, WIDTH)).copy()


@pytest.mark.parametrize("max_kinds", [edge_kinds.MAX_KINDS, 4])
def test_shared_kernels_and_merged_pixels_are_near_the_exact_sum(
    engine, rng, monkeypatch, max_kinds
):
    """Of the light added, as rms: 15 %; without limits, every pixel is by itself."""
    monkeypatch.setattr(edge_kinds, "MAX_KINDS", max_kinds)
    bench = bench_of(engine)
    color, depth_m = scattered(rng)
    limited, plain = (f(bench, color, depth_m) for f in (seen, without))
    for module, name in (
        (edge_kinds, "MAX_SOURCES"),
        (edge_kinds, "MAX_KINDS"),
        (edge_kinds, "MAX_KINDS_PX"),
        (edge_light, "MAX_FAR_KINDS"),
        (edge_light, "MAX_PARTLY_HIDDEN"),
        (edge_light, "MAX_NEAR_PRODUCTS"),
    ):
        monkeypatch.setattr(module, name, 10**12)
    monkeypatch.setattr(edge_light, "LEFT_OUT_RATIO", 0.0)
    exact = seen(bench, color, depth_m)
    room = exact.max(axis=2) < 1.0
    error = np.sqrt(np.mean((limited - exact)[room] ** 2))
    assert error <= 0.15 * np.sqrt(np.mean((exact - plain)[room] ** 2))


@pytest.mark.parametrize("n_lamps", [40, 400])
def test_lamps_share_the_same_kernels_in_all_states(engine, rng, n_lamps):
    """Otherwise their light jumps when one changes its kind."""
    bench = bench_of(engine)
    color = np.full((HEIGHT, WIDTH, 3), 0.4, np.float32)
    at = rng.integers(0, HEIGHT * WIDTH, n_lamps)
    color.reshape(-1, 3)[at] = rng.uniform(20.0, 600.0, (n_lamps, 1))
    depth_m = rng.uniform(0.4, 4.0, (HEIGHT, WIDTH)).astype(np.float32)
    kinds = []
    for pupil_mm, focus_dpt in ((4.0, 0.5), (4.0, 0.6), (4.4, 0.6)):
        request = request_of(bench, color, depth_m, focus_dpt)
        state = State(pupil_mm, focus_dpt)
        pixels = BrightPixels.of(request.view, 0.4)
        kinds.append(
            SourceKinds.of(EyeAtFrame.of(replace(request, state=state)), pixels)
        )
    first = kinds[0]
    assert len(first.place) > 3
    for other in kinds[1:]:
        np.testing.assert_array_equal(other.of_source, first.of_source)
        np.testing.assert_array_equal(other.place, first.place)


@pytest.mark.parametrize(("diffraction", "rings"), [(False, None), (True, "rings")])
def test_eyes_without_light_from_the_edge_alone_keep_their_kernels(diffraction, rings):
    """PSFs by rays, and ring lenses, whose steps diffract as well."""
    store = SimpleNamespace(
        spec=SimpleNamespace(settings=SimpleNamespace(diffraction=diffraction)),
        eye=SimpleNamespace(rings=rings),
    )
    view = RgbdView(
        lamp_at(), np.ones((HEIGHT, WIDTH), np.float32), (-0.1, 0.1, 0.1, -0.1)
    )
    request = ViewRequest(
        view, SimpleNamespace(store=store), State(4.0, 0.0), white_level=1.0
    )
    assert EdgeLight.of(request, view) is None


def test_missing_depth_of_a_lamp_is_that_of_its_surroundings(engine):
    bench = bench_of(engine)
    depth_m = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    known = seen(bench, lamp_at(), depth_m)
    depth_m[Y - 2 : Y + 3, X - 2 : X + 3] = np.nan
    np.testing.assert_allclose(seen(bench, lamp_at(), depth_m), known, rtol=1e-5)


@pytest.mark.long("a process builds an eye")
@pytest.mark.both_engines
def test_frames_of_an_eye_filter_have_the_light(engine):
    """Through the public call, with a hidden layer and both eyes' engine of streams."""
    camera = Camera(WIDTH, HEIGHT, tangents(WIDTH, HEIGHT, FIELD_DEG))
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    settings = {"mode": "on-axis", "eye_model": "wavefront"}
    with EyeFilter(EMMETROPE, camera, settings, engine=engine.name) as eye_filter:
        state = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": 0.5, "output": "linear"}
        lamp = eye_filter.filter(lamp_at(), depth_m, **state)
        dim = eye_filter.filter(lamp_at() / LAMP + 0.5, depth_m, **state)
    assert lamp.stage_times_ms["edge_light_ms"] > 0.0
    assert "edge_light_ms" not in dim.stage_times_ms
    beyond = lamp.color[Y, X + 12 : X + 40, 1]
    assert np.all(beyond > 0.0)
    assert np.all(np.diff(beyond) < 0.0)
