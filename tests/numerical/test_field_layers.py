"""Layers over the field, mapped kernels, and kernels that would grow too large."""

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from estimator.psf.survey import survey_pupils
from filter_service.planning.node_wavefronts import PupilStates, state_frames
from filter_service.planning.plan import plan_cache
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.field_defocus import EyeDefocus
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import build_psf_store
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.synthetic import assert_same_frame, psnr_db, tangents, texture
from tests.numerical.test_renderer_field import FieldBench, splat_exactly

STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}
STILL = {"pupil_range_mm": (5.0, 5.0), "focus_range_dpt": (0.5, 0.5)}


@pytest.mark.parametrize(
    ("name", "allowed_dpt"), [("emmetropia", 0.012), ("keratoconus", 0.025)]
)
def test_defocus_between_asked_directions_is_the_eyes(rng, name, allowed_dpt):
    spec = spec_for(640, 360, mode="dynamic", **STILL)
    eye = traced_eye(name, spec)
    state = {
        "pupil_diameter_mm": 5.0,
        "accommodation_dpt": eye.accommodation_dpt(0.5, pupil_diameter_mm=5.0),
    }
    _, found = EyeDefocus(eye, spec, h_deg=0.0, v_deg=0.0).state(**state)
    h_deg, v_deg = (rng.uniform(*ends, 400) for ends in spec.field_range_deg)
    exact_dpt = eye.total_defocus_dpt(
        h_deg=np.append(h_deg, 0.0),
        v_deg=np.append(v_deg, 0.0),
        wavelength_nm=spec.channel_wavelengths_nm[1],
        **state,
    )
    change_dpt = exact_dpt[:-1] - exact_dpt[-1]
    assert np.ptp(change_dpt) > 0.5
    np.testing.assert_allclose(found.at(h_deg, v_deg), change_dpt, atol=allowed_dpt)


def test_the_papers_grid_is_read_at_the_distance_of_the_object():
    spec = spec_for(64, 36, mode="dynamic", grid="paper", **STILL)
    eye = traced_eye("emmetropia", spec)
    _, found = EyeDefocus(eye, spec, h_deg=0.0, v_deg=0.0).state(
        pupil_diameter_mm=5.0,
        accommodation_dpt=eye.accommodation_dpt(0.5, pupil_diameter_mm=5.0),
    )
    assert found.range_dpt == (0.0, 0.0)


GAZE_RANGE_DEG = (14.0, 8.0)


@pytest.mark.parametrize(
    "gaze_deg",
    [
        (14.0, -8.0),
        pytest.param((0.0, 0.0), marks=pytest.mark.slow),
        pytest.param((-9.0, 4.0), marks=pytest.mark.slow),
    ],
)
@pytest.mark.long("every pixel's PSF is computed")
def test_a_turned_field_agrees_with_the_exact_psf_of_every_pixel(engine, rng, gaze_deg):
    """Kernels are mapped to pixels that differ by a third from those stored."""
    width, height = 48, 36
    bench = FieldBench(
        engine,
        "emmetropia",
        tangents(width, height, 55.0),
        size=(width, height),
        gaze_range_deg=GAZE_RANGE_DEG,
    )
    color = texture(rng, height, width, cell_px=3)
    depth_m = np.broadcast_to(np.float32(1.5), (height, width))
    result = bench.renderer.render(
        RgbdView(color, depth_m.copy(), bench.spec.camera.tangents),
        bench.handle,
        gaze_deg=gaze_deg,
        **STATE,
    )
    bench.spec = bench.spec.with_settings(gaze_deg=gaze_deg, gaze_range_deg=(0.0, 0.0))
    truth = splat_exactly(bench, color, depth_m)
    assert psnr_db(result.color, truth) >= 44.0


def test_a_perfect_eye_stays_sharp_wherever_it_looks(engine, rng):
    width, height = 128, 72
    spec = grid_spec(
        width_px=width,
        height_px=height,
        tangents=tangents(width, height, 70.0),
        pupil_range_mm=(3.0, 3.0),
        focus_range_dpt=(0.0, 0.0),
        object_range_dpt=(0.0, 0.0),
        mode="quality",
        diffraction=False,
        chromatic=False,
        gaze_range_deg=(15.0, 8.0),
    )
    profile = parse_profile({"kind": "prescription", "sphere_dpt": 0.0})
    eye, _ = eye_for_spec(profile, spec.with_settings(eye_model="wavefront"))
    renderer = engine.new_renderer()
    handle = renderer.load(build_psf_store(eye, spec))
    image = texture(rng, height, width, cell_px=1)
    far_m = np.full(image.shape[:2], np.inf, np.float32)
    for gaze_deg in ((0.0, 0.0), (15.0, 8.0), (-15.0, 0.0)):
        seen = renderer.render(
            RgbdView(image, far_m, spec.camera.tangents),
            handle,
            pupil_diameter_mm=3.0,
            focus_dpt=0.0,
            gaze_deg=gaze_deg,
        ).color
        assert psnr_db(seen, image) >= 60.0


@pytest.fixture(scope="module")
def small_bench(engine):
    size = width, height = 64, 48
    return FieldBench(engine, "myopia", tangents(width, height, 40.0), size)


@pytest.fixture
def bench(engine, small_bench):
    """A bench without kernels of other frames."""
    small_bench.renderer = engine.new_renderer()
    return small_bench


def test_larger_cells_serve_where_kernels_take_too_much_memory(
    engine, bench, rng, monkeypatch
):
    width, height = bench.spec.camera.width_px, bench.spec.camera.height_px
    color = texture(rng, height, width, cell_px=3)
    depth_m = np.full((height, width), 2.0, np.float32)
    usual = bench.render(color, depth_m)
    limit = usual.kernel_texel_count // 5
    engine.limit_kernels(monkeypatch, limit, width * height)
    bench.renderer = engine.new_renderer()
    smaller = bench.render(color, depth_m)
    assert smaller.kernel_count < usual.kernel_count // 3
    if engine.gpu is not None:  # native limits single kernels, and tells all levels
        assert smaller.kernel_texel_count <= limit
    assert psnr_db(smaller.color, usual.color) >= 40.0
    # Where cells cannot grow any more, memory decides alone.
    engine.limit_kernels(monkeypatch, 1, width * height)
    bench.renderer = engine.new_renderer()
    assert np.isfinite(bench.render(color, depth_m).color).all()


def test_a_frame_of_many_distances_leaves_nothing_to_the_next(
    engine, bench, rng, monkeypatch
):
    """Its cells are wider, for memory is short; those of a frame of few are not."""
    width, height = bench.spec.camera.width_px, bench.spec.camera.height_px
    color = texture(rng, height, width, cell_px=3)
    plain_m = np.full((height, width), 2.0, np.float32)
    deep_m = rng.uniform(0.3, 3.0, (height, width)).astype(np.float32)
    counts = [bench.render(color, d).kernel_texel_count for d in (plain_m, deep_m)]
    assert counts[0] < 0.5 * counts[1]
    engine.limit_kernels(monkeypatch, sum(counts) // 2, width * height)
    bench.renderer = engine.new_renderer()
    first = bench.render(color, plain_m).color.copy()
    assert bench.render(color, deep_m).kernel_texel_count < counts[1]
    again = bench.render(color, plain_m).color
    assert_same_frame(again, first, is_exact=engine.name == "native")


@pytest.mark.long("an eye is traced and planned to the edge of its field")
def test_plans_end_where_kernels_may_not_grow():
    """At the edge of its model's field the cataract's defocus goes on to -40 dpt."""
    spec = spec_for(
        1280,
        720,
        mode="dynamic",
        object_range_dpt=(0.0, 1.0),
        focus_range_dpt=(9.0, 10.0),
        pupil_range_mm=(6.0, 7.0),
    )
    eye = traced_eye("cataract", spec, periphery="model")
    plan = plan_cache(eye, spec)
    defocus, shrink_ratio = plan.nodes.defocus, plan.nodes.shrink_ratio
    assert plan.nodes.is_limited.any()
    pupil, used, v, h = np.unravel_index(defocus.group_of_node, plan.group_shape)
    states = PupilStates.of(
        h_deg=plan.h_deg[h],
        v_deg=plan.v_deg[v],
        pupil_diameter_mm=plan.pupils_mm[pupil],
        accommodation_dpt=plan.accommodations_dpt[used],
        wavelength_nm=spec.channel_wavelengths_nm[2],
        total_defocus_dpt=defocus.values_dpt,
    )
    survey = survey_pupils(state_frames(eye, spec, states))
    shrunk = shrink_ratio[defocus.group_of_node]
    assert (shrunk * survey.blur_radius_px).max() <= spec.max_blur_radius_px
    # only where even the sharpest blur is too large, and never on the axis
    is_whole = (shrink_ratio == 1.0).reshape(plan.group_shape)
    assert 0.9 < is_whole.mean() < 1.0
    axis = np.abs(plan.v_deg).argmin(), np.abs(plan.h_deg).argmin()
    assert is_whole[:, :, *axis].all()


@pytest.fixture(scope="module")
def limited():
    """An eye whose kernels may not grow to the blur of the nearest objects."""
    spec = spec_for(
        96,
        54,
        mode="dynamic",
        tolerance="loose",
        max_blur_radius_px=6,
        **STILL,
    )
    # nearer than settings allow: much blur in an image of few pixels
    object.__setattr__(spec.settings, "object_range_dpt", (0.0, 40.0))
    eye = traced_eye("emmetropia", spec)
    return build_psf_store(eye, spec)


def limit_notes(store, **range_dpt):
    layers = frame_layers(store, State(**STATE))
    fields = np.arange(store.fields_count)
    return layers.limit_notes(fields, **range_dpt)


def test_a_frame_says_where_its_blur_is_limited(limited):
    (note,) = limit_notes(limited, low_dpt=0.0, high_dpt=40.0)
    assert "limited to a radius of 6 px" in note
    assert note.code == "blur_limited"
    assert limited.reach_px.max() <= 6


def test_a_frame_that_needs_no_limit_says_nothing_of_it(limited):
    assert limit_notes(limited, low_dpt=0.5, high_dpt=0.5) == ()
    assert limit_notes(limited, low_dpt=0.0, high_dpt=1.0) == ()


def test_the_limit_is_where_rays_reach_the_largest_kernel(limited):
    """Geometrical blur: a pupil of P mm and t dpt send rays P t / 2 mrad away."""
    layers, spec = frame_layers(limited, State(**STATE)), limited.spec
    axis = limited.plan.axis_node
    pitch_mrad = min(spec.pixel_pitch_mrad)
    rays_px = 0.5 * STATE["pupil_diameter_mm"] * layers.limits.high_dpt[axis]
    assert rays_px / pitch_mrad == pytest.approx(0.86 * 6, rel=0.1)


@pytest.mark.long("a frame is filtered by each engine")
@pytest.mark.parametrize(("distance_m", "is_limited"), [(2.0, False), (0.026, True)])
def test_both_engines_report_a_limit_only_where_a_frame_exceeds_it(
    engine, limited, distance_m, is_limited
):
    renderer = engine.new_renderer()
    view = RgbdView(
        np.full((54, 96, 3), 128, np.uint8),
        np.full((54, 96), distance_m, np.float32),
        limited.spec.camera.tangents,
    )
    notes = renderer.render(view, renderer.load(limited), **STATE).notes
    assert ("blur_limited" in [note.code for note in notes]) == is_limited
