"""The planner: what it covers, what it predicts, and what blending really costs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.profiles.files import load_profile
from estimator.profiles.measured_wavefront import MeasuredWavefront
from filter_service.planning.grid import defocus_nodes_dpt, pupil_nodes_mm
from filter_service.planning.nodes import (
    RaggedNodes,
    bracket_axis,
)
from filter_service.planning.plan import (
    QUALITY_DB,
    TOLERANCE_DB,
    PlanTooLarge,
    plan_cache,
    unchecked_plan,
)
from filter_service.planning.state_samples import (
    allowed_difference_px,
    blend_error,
    combined_error,
    equal_share,
    sample_states,
)
from filter_service.psfs.store import build_psf_store
from tests.lens_truth import worn_eye
from tests.numerical.plan_cases import (
    mean_db,
    node_errors,
    sampled_errors,
    spec_for,
    traced_eye,
)

TRACED = pytest.mark.long("an eye is traced at several pupils and accommodations")

FACTOR_TWO_DB = 20.0 * math.log10(2.0)
ONE_STATE = {"pupil_range_mm": (4.0, 4.0), "focus_range_dpt": (0.5, 0.5)}
BREATHING = {"pupil_range_mm": (4.0, 4.4), "focus_range_dpt": (0.0, 0.5)}
SMALL = {"width_px": 160, "height_px": 90}
"""Pixels of 10 mrad: an eighth of the nodes.  For what holds at any pixel size."""

GAZE_CAMERA = {"tangents": (-0.5, 1.1, 0.7, -0.4)}


def measured_eye(name):
    return MeasuredWavefront.from_profile(load_profile(name))


def measured_db(eye, spec, plan, *, count=24, seed=0):
    """Return the mean error of images at ``count`` random states."""
    return mean_db(
        sampled_errors(eye, spec, plan, count=count, seed=seed, sample_count=256)
    )


# ----- nodes and their neighbors


def test_brackets_are_those_of_each_group():
    rng = np.random.default_rng(1)
    groups = [np.sort(rng.normal(0, 3, n)) for n in (1, 2, 7, 30)]
    nodes = RaggedNodes.of(groups)
    group = rng.integers(0, 4, 500)
    t = rng.normal(0, 5, 500)
    lower, upper, share = nodes.bracket(group, t)
    values = (1 - share) * nodes.values_dpt[lower] + share * nodes.values_dpt[upper]
    clipped = [
        np.clip(x, groups[g][0], groups[g][-1]) for g, x in zip(group, t, strict=True)
    ]
    np.testing.assert_allclose(values, clipped, atol=1e-9)
    assert np.all(nodes.group_of_node[lower] == group)
    assert np.all(nodes.group_of_node[upper] == group)
    assert np.all((upper - lower == 1) | (nodes.counts[group] == 1))


@pytest.mark.parametrize("groups", [[], [np.zeros(0)], [np.array([1.0, 1.0])]])
def test_groups_that_are_no_nodes_are_refused(groups):
    with pytest.raises(ValueError, match=r"at least one node|ascend"):
        RaggedNodes.of(groups)


# ----- on axis


def expected_defocus(eye, spec):
    """Nodes on axis, by the rule in words: what frames read, pupil by pupil."""
    pupils_mm = pupil_nodes_mm(
        [eye.usable_pupil_mm(p) for p in spec.settings.pupil_range_mm]
    )
    ranges = spec.settings.focus_range_dpt, (pupils_mm[0], pupils_mm[-1])
    used_dpt = eye.accommodation_nodes_dpt(ranges[0], pupil_range_mm=ranges[1])
    groups = []
    for i, pupil_mm in enumerate(pupils_mm):
        for j in range(len(used_dpt)):
            ends = []
            for other_mm in pupils_mm[max(i - 1, 0) : i + 2]:
                read_dpt = (
                    used_dpt[max(j - 1, 0) : j + 2]
                    if len(used_dpt) > 1
                    else eye.accommodation_range_dpt(
                        ranges[0], pupil_range_mm=ranges[1]
                    )
                )
                at_infinity_dpt = eye.total_defocus_dpt(
                    pupil_diameter_mm=other_mm,
                    accommodation_dpt=np.array(read_dpt)[:, None],
                    wavelength_nm=spec.channel_wavelengths_nm,
                )
                for d in spec.settings.object_range_dpt:
                    ends.append((at_infinity_dpt + d) * other_mm / pupil_mm)
            groups.append(
                defocus_nodes_dpt(
                    min(float(e.min()) for e in ends),
                    max(float(e.max()) for e in ends),
                    blur_px_per_dpt=spec.blur_px_per_dpt(pupil_mm),
                    max_blur_step_px=spec.max_blur_step_px,
                )
            )
    return groups


@pytest.mark.parametrize(
    ("model", "name"),
    [
        ("wavefront", "emmetropia"),
        ("wavefront", "myopia"),
        ("wavefront", "keratoconus"),
        pytest.param("traced", "emmetropia", marks=pytest.mark.slow),
        pytest.param("traced", "myopia", marks=pytest.mark.slow),
        ("traced", "keratoconus"),
    ],
)
def test_on_axis_nodes_follow_the_blur_alone(name, model):
    spec = spec_for()
    eye = measured_eye(name) if model == "wavefront" else traced_eye(name, spec)
    plan = plan_cache(eye, spec)
    expected = expected_defocus(eye, spec)
    assert plan.group_shape[2:] == (1, 1)
    np.testing.assert_array_equal(plan.nodes.defocus.counts, [len(g) for g in expected])
    np.testing.assert_allclose(
        plan.nodes.defocus.values_dpt, np.concatenate(expected), atol=1e-12
    )


@pytest.mark.parametrize("model", ["wavefront", "traced"])
def test_one_distance_in_one_state_is_one_exact_psf_a_channel(model):
    spec = spec_for(**ONE_STATE, object_range_dpt=(1.5, 1.5))
    eye = measured_eye("myopia") if model == "wavefront" else traced_eye("myopia", spec)
    plan = plan_cache(eye, spec)
    assert plan.prediction.psf_count == 3
    expected_dpt = eye.vergence.vergence_dpt(1.5) + eye.total_defocus_dpt(
        pupil_diameter_mm=4.0,
        accommodation_dpt=plan.accommodations_dpt[0],
        wavelength_nm=spec.channel_wavelengths_nm,
    )
    np.testing.assert_allclose(
        plan.nodes.defocus.values_dpt + plan.nodes.channel_shift_dpt[0],
        expected_dpt,
        atol=1e-9,
    )


# ----- whatever frames read is there


@pytest.mark.parametrize(
    ("name", "model", "settings"),
    [
        pytest.param(
            "emmetropia", "traced", {"mode": "on-axis"}, marks=pytest.mark.slow
        ),
        pytest.param(
            *("keratoconus", "traced", {"mode": "dynamic"}), marks=pytest.mark.slow
        ),
        pytest.param(
            "keratoconus",
            "traced",
            {"mode": "dynamic", "gaze_deg": (12.0, -8.0)} | BREATHING,
            marks=TRACED,
        ),
        ("emmetropia", "wavefront", {"mode": "dynamic"}),
        pytest.param(
            *("emmetropia", "traced", {"mode": "dynamic"} | BREATHING),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "keratoconus",
            "traced",
            {"mode": "dynamic", "object_planes_dpt": (0.0, 3.0)} | BREATHING,
            marks=TRACED,
        ),
    ],
)
def test_every_defocus_that_frames_read_lies_between_nodes(name, model, settings):
    spec = spec_for(**{"tolerance": "loose", **SMALL, **settings})
    eye = measured_eye(name) if model == "wavefront" else traced_eye(name, spec)
    plan = plan_cache(eye, spec)
    sample = sample_states(eye, spec, 400)
    states = sample.states
    channel = (states.wavelength_nm[:, None] == spec.channel_wavelengths_nm).argmax(
        axis=1
    )
    for v in bracket_axis(plan.v_deg, states.v_deg)[:2]:
        for h in bracket_axis(plan.h_deg, states.h_deg)[:2]:
            total_dpt = sample.vergence_dpt + eye.total_defocus_dpt(
                h_deg=plan.h_deg[h],
                v_deg=plan.v_deg[v],
                pupil_diameter_mm=states.pupil_diameter_mm,
                accommodation_dpt=states.accommodation_dpt,
                wavelength_nm=states.wavelength_nm,
            )
            for i in bracket_axis(plan.pupils_mm, states.pupil_diameter_mm)[:2]:
                for j in bracket_axis(
                    plan.accommodations_dpt, states.accommodation_dpt
                )[:2]:
                    group = np.ravel_multi_index((i, j, v, h), plan.group_shape)
                    read = total_dpt * states.pupil_diameter_mm / plan.pupils_mm[i]
                    read = read - plan.nodes.channel_shift_dpt[group, channel]
                    defocus = plan.nodes.defocus
                    low = defocus.values_dpt[defocus.starts[group]]
                    high = defocus.values_dpt[defocus.starts[group + 1] - 1]
                    # Pupils and accommodations between nodes bend their defocus.
                    assert np.all(read > low - 0.02)
                    assert np.all(read < high + 0.02)


def test_field_nodes_span_the_image_where_the_eye_looks_aside():
    spec = spec_for(mode="dynamic", tolerance="loose").with_settings(
        gaze_deg=(15.0, 5.0)
    )
    camera = replace(spec.camera, **GAZE_CAMERA)
    spec = replace(spec, camera=camera).with_settings(**ONE_STATE)
    plan = plan_cache(traced_eye("emmetropia", spec), spec)
    (h_low, h_high), (v_low, v_high) = spec.field_range_deg
    assert (plan.h_deg[0], plan.h_deg[-1]) == pytest.approx((h_low, h_high))
    assert (plan.v_deg[0], plan.v_deg[-1]) == pytest.approx((v_low, v_high))
    assert h_low < -35.0
    assert 25.0 < h_high < 40.0


# ----- tolerance, prediction and measurement


@pytest.mark.long("exact kernels of states of two plans")
def test_finer_tolerances_take_more_psfs_and_err_less_as_predicted():
    counts, found_db = [], []
    for tolerance in ("loose", "fine"):
        size = {"width_px": 240, "height_px": 135}
        spec = spec_for(mode="dynamic", tolerance=tolerance, **size, **BREATHING)
        eye = traced_eye("emmetropia", spec)
        plan = plan_cache(eye, spec)
        counts.append(plan.prediction.psf_count)
        found_db.append(measured_db(eye, spec, plan))
        assert plan.prediction.psf_count == 3 * len(plan.nodes.defocus.values_dpt)
        assert plan.prediction.interpolation_db > TOLERANCE_DB[tolerance] - 0.5
        difference_db = found_db[-1] - plan.prediction.interpolation_db
        assert abs(difference_db) < FACTOR_TWO_DB
    assert counts == sorted(set(counts))
    assert np.all(np.diff(found_db) > 4.0)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("keratoconus", {"mode": "quality", "tolerance": "loose"}),
        pytest.param("post_lasik", {"mode": "dynamic"}, marks=pytest.mark.slow),
        pytest.param(
            *("myopia", {"mode": "dynamic", "vertical_fov_deg": 20.0}),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("emmetropia", {"mode": "quality", "grid": "paper", **ONE_STATE}),
            marks=pytest.mark.slow,
        ),
        ("astigmatism", {"mode": "dynamic", "model": "wavefront"}),
        pytest.param(
            *("emmetropia", {"mode": "dynamic"} | BREATHING), marks=pytest.mark.slow
        ),
        pytest.param(
            *(
                "myopia",
                {"mode": "dynamic", "object_planes_dpt": (0.0, 4.0)} | BREATHING,
            ),
            marks=pytest.mark.slow,
        ),
    ],
)
@pytest.mark.long("exact kernels of many states")
def test_errors_are_predicted_within_a_factor_of_two(name, settings):
    settings = dict(settings)
    model = settings.pop("model", "traced")
    spec = spec_for(**settings)
    eye = measured_eye(name) if model == "wavefront" else traced_eye(name, spec)
    plan = plan_cache(eye, spec)
    found_db = measured_db(eye, spec, plan, seed=3)
    assert abs(found_db - plan.prediction.interpolation_db) < FACTOR_TWO_DB


@pytest.mark.long("exact kernels of a lens with several foci")
def test_errors_are_predicted_behind_a_lens_with_several_foci():
    """Frames read its pupils at the same defocus: for equal blur they had 38 dB."""
    eye = worn_eye(design="bifocal", add_dpt=3.0)
    spec = spec_for(mode="dynamic", **BREATHING)
    plan = plan_cache(eye, spec)
    found_db = measured_db(eye, spec, plan)
    assert found_db == pytest.approx(plan.prediction.interpolation_db, abs=3.0)


def test_quality_errs_half_as_much_as_dynamic_in_a_state():
    plans = {}
    for mode in ("dynamic", "quality"):
        spec = spec_for(mode=mode, **SMALL, **ONE_STATE)
        plans[mode] = plan_cache(measured_eye("keratoconus"), spec).prediction
    assert plans["dynamic"].interpolation_db > TOLERANCE_DB["normal"] - 0.5
    assert plans["quality"].interpolation_db > QUALITY_DB["normal"] - 0.5
    assert plans["quality"].psf_count < 4.0 * plans["dynamic"].psf_count


def test_foci_that_share_the_light_need_few_psfs():
    """Twice those of one focus; eight times, were all light in each."""
    spec = spec_for(mode="dynamic", **SMALL)
    bifocal, monofocal = (
        plan_cache(worn_eye(**lens), spec).prediction.psf_count
        for lens in ({"design": "bifocal", "add_dpt": 3.0}, {"design": "monofocal"})
    )
    assert monofocal < bifocal < 2.5 * monofocal


@pytest.mark.long("exact kernels of states of two plans")
@pytest.mark.parametrize(
    "name", ["emmetropia", pytest.param("keratoconus", marks=pytest.mark.slow)]
)
def test_a_part_of_all_ranges_is_planned_as_well_with_a_tenth_of_the_psfs(name):
    size = {"width_px": 240, "height_px": 135}
    whole = spec_for(mode="dynamic", tolerance="loose", **size)
    part = whole.with_settings(**BREATHING, object_range_dpt=(0.0, 3.0))
    eye = traced_eye(name, whole)
    plans = [unchecked_plan(eye, spec) for spec in (whole, part)]
    found_db = [measured_db(eye, part, plan) for plan in plans]
    assert found_db[1] > found_db[0] - 3.0
    counts = [plan.prediction.psf_count for plan in plans]
    assert counts[1] < 0.1 * counts[0]


@pytest.mark.slow
def test_two_planes_take_fewer_psfs_than_all_between_them():
    state = {"pupil_range_mm": (3.5, 4.5), "focus_range_dpt": (1.0, 1.5)}
    size = {"width_px": 1280, "height_px": 720, "vertical_fov_deg": 20.0}
    spec = spec_for(mode="dynamic", **size, **state, object_range_dpt=(0.0, 5.0))
    planes = spec.with_settings(object_planes_dpt=(0.0, 5.0))
    eye = traced_eye("emmetropia", spec)
    wide, split = (unchecked_plan(eye, own) for own in (spec, planes))
    assert split.prediction.psf_count < 0.4 * wide.prediction.psf_count
    # 57 and 52.3 dB over all samples; the plan of two planes predicts 53.5
    found_db = [measured_db(eye, planes, plan, count=256) for plan in (wide, split)]
    assert found_db[0] > found_db[1]
    assert found_db[1] == pytest.approx(split.prediction.interpolation_db, abs=3.0)


def test_memory_is_predicted_for_the_cache_that_is_built():
    spec = spec_for(mode="quality", tolerance="loose", **SMALL, **ONE_STATE)
    eye = traced_eye("keratoconus", spec)
    store = build_psf_store(eye, spec)
    predicted = store.plan.prediction
    assert store.psf_count == predicted.psf_count
    assert predicted.memory_mb == pytest.approx(store.memory_mb, rel=0.2)
    assert predicted.build_s > 0.0


def test_the_law_is_zero_for_equal_psfs_and_inverts():
    rng = np.random.default_rng(0)
    slopes = rng.normal(0, 2, (5, 80, 2))
    half, unit = np.full(5, 0.5), np.full(5, 0.1)
    same = blend_error(slopes, slopes, slopes, share_ratio=half, unit_px=unit)
    np.testing.assert_array_equal(same, 0.0)
    covariance = np.array([[4.0, 4.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    allowed_px = allowed_difference_px(
        covariance, unit_px=np.full(3, 0.1), half_way_error=3e-3
    )
    assert allowed_px[0] > allowed_px[1] > allowed_px[2] > 0.0
    shares = [1e-6, 3e-6]
    more = equal_share(2e-5, spent=shares, count=3)
    assert combined_error([*shares, more, more, more]) == pytest.approx(2e-5)


# ----- the paper's grids


@pytest.mark.parametrize(
    ("mode", "count"),
    [("quality", 17577), pytest.param("dynamic", 201825, marks=pytest.mark.slow)],
)
@pytest.mark.long("plans of the paper's many PSFs")
def test_the_papers_grids_have_its_psf_counts(mode, count):
    ranges = {"pupil_range_mm": (2.0, 6.0), "focus_range_dpt": (0.125, 4.125)}
    spec = spec_for(mode=mode, grid="paper", **ranges)
    eye = traced_eye("emmetropia", spec)
    plan = unchecked_plan(eye, spec)
    assert plan.prediction.psf_count == count
    assert plan.h_deg[0] == -45.0
    if mode == "quality":  # at a node of all axes nothing is blended: storage alone
        assert mean_db(node_errors(eye, spec, plan, count=24)) > 60.0


# ----- too large, and degenerate


def test_a_plan_beyond_its_budget_is_refused_with_one_that_fits():
    spec = spec_for(mode="dynamic", tolerance="normal", **SMALL, **ONE_STATE)
    eye = measured_eye("myopia")
    needed, smaller = (
        unchecked_plan(eye, spec.with_settings(tolerance=tolerance)).prediction
        for tolerance in ("normal", "loose")
    )
    budget_mb = 0.5 * (needed.memory_mb + smaller.memory_mb)
    with pytest.raises(PlanTooLarge) as refused:
        plan_cache(eye, replace(spec, memory_budget_mb=budget_mb))
    assert refused.value.prediction == needed
    assert refused.value.budget_mb == budget_mb
    text = str(refused.value)
    assert f"need {needed.memory_mb:.2g} MB for {needed.psf_count} PSFs" in text
    smaller_words = f"{smaller.memory_mb:.2g} MB for {smaller.psf_count} PSFs"
    assert f'tolerance "loose" needs {smaller_words}' in text
    fitting = replace(spec, memory_budget_mb=budget_mb).with_settings(tolerance="loose")
    assert plan_cache(eye, fitting).prediction == smaller


def test_where_nothing_fits_the_refusal_says_so():
    spec, reported = spec_for(memory_budget_mb=0.001), []
    with pytest.raises(PlanTooLarge, match=r"even .* needs"):
        plan_cache(measured_eye("myopia"), spec, progress=reported.append)
    assert reported == sorted(reported)
    assert reported[-1] == pytest.approx(1.0)


def test_a_plan_reports_each_axis_and_state():
    spec, reported = spec_for(mode="on-axis", **SMALL), []
    plan = unchecked_plan(measured_eye("myopia"), spec, progress=reported.append)
    n_states = len(plan.pupils_mm) * len(plan.accommodations_dpt)
    assert n_states > 3
    assert len(set(reported)) >= n_states
    assert reported == sorted(reported)


DEGENERATE = {
    "one state": ({**ONE_STATE, "object_range_dpt": (1.0, 1.0)}, (1, 1, None, None)),
    "one degree": (
        {"width_px": 40, "height_px": 23, "vertical_fov_deg": 1.0},
        (None, None, 2, 2),
    ),
    "one pixel": (
        {"width_px": 1, "height_px": 1, "vertical_fov_deg": 4.0},
        (None, None, 2, 2),
    ),
    "tall": ({"width_px": 12, "height_px": 180}, (None, None, None, None)),
    "rays": ({"chromatic": False, "diffraction": False}, (None, None, None, None)),
}


@pytest.mark.parametrize(
    ("model", "name"),
    [
        *(("wavefront", name) for name in DEGENERATE),
        pytest.param("traced", "one state", marks=pytest.mark.slow),
        pytest.param("traced", "one degree", marks=pytest.mark.slow),
        pytest.param("traced", "one pixel", marks=pytest.mark.slow),
        ("traced", "tall"),
        pytest.param("traced", "rays", marks=pytest.mark.slow),
    ],
)
def test_degenerate_ranges_are_planned(model, name):
    settings, shape = DEGENERATE[name]
    settings = {"mode": "dynamic", "tolerance": "loose", **BREATHING, **settings}
    settings = {**SMALL, **settings}
    spec = spec_for(**settings)
    eye = (
        measured_eye("myopia")
        if model == "wavefront"
        else traced_eye("emmetropia", spec)
    )
    plan = plan_cache(eye, spec)
    for found, expected in zip(plan.group_shape, shape, strict=True):
        assert found == expected if expected else found >= 1
    channels = 3 if spec.settings.chromatic else 1
    assert plan.prediction.psf_count == channels * len(plan.nodes.defocus.values_dpt)
    assert len(plan.nodes.defocus.starts) == 1 + math.prod(plan.group_shape)
    assert plan.prediction.memory_mb > 0.0
    assert plan.prediction.interpolation_db > 39.0
