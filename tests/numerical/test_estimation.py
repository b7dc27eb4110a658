"""Estimation: the eye found has the wavefront, keeps its ranges, says what it knows."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from estimator.estimate.bounded_fit import FitFailed, box_minimum, fit_bounded
from estimator.estimate.estimation import POOR_FIT_UM, estimate_eye, table_vectors
from estimator.estimate.problem import (
    compared_terms,
    prior_for_refraction,
    search_loss,
    search_weights,
)
from estimator.eye.parameters import (
    PARAMETER_NAMES,
    PARAMETERS,
    EyeParameters,
    allowed_ranges,
    column,
    mean_vector,
    random_vectors,
)
from estimator.eye.tracing import on_axis_zernike_um, zernike_of_vectors
from estimator.optics.zernike import nm_from_index, rescale_pupil
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile, preset_names
from estimator.wavefront.aberrations import wavefront_aberrations
from tests.numerical.eye_cases import population_profiles, random_eye_profiles

PRESET_LIMIT_UM = 2e-3
MEDIAN_LIMIT_UM = 1e-2


def preset(name, **more):
    return parse_profile({"kind": "preset", "name": name, **more})


def measured_body(vector, pupil_mm, h_deg=0.0, v_deg=0.0):
    """A measurement of the eye of a vector, as a profile holds it."""
    zernike_um = zernike_of_vectors(
        vector[None],
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=555.0,
        h_deg=h_deg,
        v_deg=v_deg,
    )[0]
    terms = {"{},{}".format(*nm_from_index(j)): c for j, c in enumerate(zernike_um)}
    body = {"pupil_diameter_mm": pupil_mm, "wavelength_nm": 555.0, "zernike_um": terms}
    return body | {"h_deg": h_deg, "v_deg": v_deg}


@pytest.mark.parametrize("name", preset_names())
def test_every_condition_is_met_below_the_stated_error(name):
    profile = preset(name)
    found = estimate_eye(profile)
    assert found.mean_abs_error_um <= PRESET_LIMIT_UM
    unusual = [note for note in found.notes if note.startswith("unusual")]
    assert list(found.notes) == unusual
    assert bool(unusual) == (name == "cataract")
    vector = found.parameters.to_vector()
    low, high = allowed_ranges().T
    assert np.all((vector >= low) & (vector <= high))
    # what it says of itself is what tracing its parameters gives
    again_um = on_axis_zernike_um(
        found.parameters,
        pupil_diameter_mm=profile.pupil_diameter_mm,
        wavelength_nm=profile.wavelength_nm,
    )
    error_um = np.abs(compared_terms(again_um - profile.zernike_um))
    assert np.mean(error_um) == pytest.approx(found.mean_abs_error_um, rel=1e-6)
    assert found.residual_um[3:] == pytest.approx(
        again_um[3:] - profile.zernike_um[3:], abs=1e-12
    )


@pytest.mark.parametrize("name", preset_names())
def test_the_stop_limited_wavefront_of_the_eye_is_the_measured_one(name):
    """The other way to the coefficients: rays that fill the stop, not the circle."""
    profile = preset(name)
    found = estimate_eye(profile)
    traced = wavefront_aberrations(
        found.accommodating.states_at([0.0])[0].surfaces,
        wavelength_nm=profile.wavelength_nm,
        pupil_diameter_mm=profile.pupil_diameter_mm,
    )
    measured_um = rescale_pupil(
        profile.zernike_um,
        radius_ratio=traced.zernike_radius_mm / found.zernike_radius_mm,
    )
    error_um = np.abs(compared_terms(traced.zernike_um - measured_um))
    assert np.mean(error_um) <= PRESET_LIMIT_UM


def _errors_um(profiles):
    return np.array([estimate_eye(p).mean_abs_error_um for p in profiles])


def test_random_eyes_are_met(rng):
    errors_um = _errors_um([p for p, _ in random_eye_profiles(8, rng)])
    assert np.median(errors_um) <= MEDIAN_LIMIT_UM / 20.0
    assert errors_um.max() <= MEDIAN_LIMIT_UM


def test_population_wavefronts_are_met(rng):
    errors_um = _errors_um(population_profiles(8, rng))
    assert np.median(errors_um) <= MEDIAN_LIMIT_UM / 20.0
    assert errors_um.max() <= MEDIAN_LIMIT_UM


@pytest.mark.slow
def test_200_random_eyes_and_200_population_wavefronts_are_met(rng):
    for profiles in (
        [p for p, _ in random_eye_profiles(200, rng)],
        population_profiles(200, rng),
    ):
        found = [estimate_eye(profile) for profile in profiles]
        errors_um = np.array([f.mean_abs_error_um for f in found])
        assert np.median(errors_um) <= MEDIAN_LIMIT_UM
        assert np.percentile(errors_um, 95) <= MEDIAN_LIMIT_UM
        assert np.median([f.time_ms for f in found]) <= 100.0


@pytest.mark.slow
def test_100000_random_eyes_are_traced_on_axis_or_say_why_not(rng):
    lost = 0
    for _ in range(20):
        vectors = random_vectors(5000, rng)
        zernike_um = zernike_of_vectors(
            vectors, pupil_diameter_mm=6.0, wavelength_nm=555.0
        )
        failed = np.isnan(zernike_um).any(axis=1)
        lost += int(failed.sum())
        for vector in vectors[failed][:20]:
            assert _reason(vector), "an eye without coefficients must have a status"
    assert lost <= 0.001 * 100_000


def _reason(vector):
    from estimator.eye.assembly import eye_surfaces

    found = wavefront_aberrations(
        eye_surfaces(EyeParameters.from_vector(vector)),
        wavelength_nm=555.0,
        stop_diameter_mm=5.0,
    )
    return found.notes


def test_one_condition_has_a_plausible_eye():
    found = estimate_eye(preset("myopia"))
    p = found.parameters
    # a myope of 6 dpt has a long eye: 23.58 + 0.299 * 6 = 25.4 mm (Atchison 2006)
    assert p.eye_length_mm == pytest.approx(25.4, abs=0.7)
    assert found.on_bound == ()
    unit = prior_for_refraction(-6.0).to_unit(p.to_vector())
    assert np.abs(unit).max() < 2.0


def test_a_worn_correction_and_age_act_on_focus_and_not_on_the_eye():
    bare, corrected = (
        estimate_eye(preset("myopia", age_years=30, **more))
        for more in ({}, {"correction": {"sphere_dpt": -6, "vertex_mm": 0}})
    )
    assert np.array_equal(bare.parameters.to_vector(), corrected.parameters.to_vector())
    assert corrected.refraction_dpt == pytest.approx(bare.refraction_dpt + 6.0)
    assert bare.amplitude_dpt == pytest.approx(7.33 - 0.0035 * 27.0**2)


def test_what_cannot_be_reached_is_said():
    body = {
        "kind": "zernike",
        "pupil_diameter_mm": 3,
        "wavelength_nm": 555,
        "zernike_um": {"6,6": 2.0},
    }
    found = estimate_eye(parse_profile(body))
    assert found.mean_abs_error_um > POOR_FIT_UM
    assert "reaches this wavefront only" in found.notes[0]
    assert found.on_bound


def test_determined_shares_are_shares_and_tell_length_from_tilt():
    found = estimate_eye(preset("emmetropia"))
    assert set(found.determined_ratio) == set(PARAMETER_NAMES)
    ratios = np.array(list(found.determined_ratio.values()))
    assert np.all((ratios >= 0.0) & (ratios <= 1.0))
    # 25 coefficients fix at most 25 directions of 45
    assert ratios.sum() <= 25.0
    assert found.determined_ratio["eye_length_mm"] > 0.2
    assert found.determined_ratio["cornea_thickness_mm"] < 0.05


def test_fields_and_pupils_together_determine_more_of_the_eye(rng):
    truth = mean_vector() + 0.3 * (random_vectors(1, rng)[0] - mean_vector())
    views = [(6.0, 0.0, 0.0), (3.0, 0.0, 0.0), (4.0, 20.0, 0.0), (4.0, 0.0, -15.0)]
    bodies = [measured_body(truth, *view) for view in views]
    one = estimate_eye(
        parse_profile({"kind": "zernike_set", "measurements": bodies[:1]})
    )
    several = estimate_eye(
        parse_profile(
            {"kind": "zernike_set", "measurements": bodies, "periphery": "model"}
        )
    )
    assert several.mean_abs_error_um <= PRESET_LIMIT_UM
    for name in ("lens_decentration_x_mm", "aqueous_thickness_mm"):
        assert several.determined_ratio[name] > one.determined_ratio[name] + 0.2
    depth = column("aqueous_thickness_mm")
    miss_one, miss_several = (
        abs(found.parameters.to_vector()[depth] - truth[depth])
        for found in (one, several)
    )
    assert miss_several < 0.5 * miss_one


def test_a_given_eye_is_returned_as_it_is():
    parameters = EyeParameters.mean_eye().to_mapping()
    profile = parse_profile({"kind": "eye", "parameters": parameters})
    found = estimate_eye(profile)
    assert found.method == "given"
    assert found.parameters.to_mapping() == parameters
    assert found.surfaces().retina.z_mm == parameters["eye_length_mm"]
    # the wavefront-only path sees the same refraction, traced at 6 mm
    measured = MeasuredWavefront(profile)
    assert measured.refraction_dpt == pytest.approx(found.refraction_dpt, abs=2e-3)
    assert not found.rest(549.0).residue_um.any()
    assert not found.rest(549.0).color_dpt.any()


def test_unknown_method_is_refused():
    with pytest.raises(ValueError, match="refined, search"):
        estimate_eye(preset("myopia"), method="guess")


def test_start_table_traces_and_stays_in_the_allowed_ranges():
    vectors = table_vectors()
    low, high = allowed_ranges().T
    assert len(vectors) > 15
    assert np.all((vectors >= low - 1e-6) & (vectors <= high + 1e-6))
    zernike_um = zernike_of_vectors(vectors, pupil_diameter_mm=7.0, wavelength_nm=555.0)
    assert np.all(np.isfinite(zernike_um))


@pytest.mark.long("a search is given 0.4 s")
def test_search_gets_nearer_the_longer_it_runs():
    profile = preset("astigmatism")
    short, longer = (
        estimate_eye(profile, method="search", max_time_s=t) for t in (0.05, 0.4)
    )
    assert longer.n_evaluations > short.n_evaluations
    assert longer.mean_abs_error_um < short.mean_abs_error_um
    assert longer.method == "search"


def test_search_loss_has_the_published_weights():
    weights = search_weights()
    by_order = {nm_from_index(j)[0]: weights[j] for j in range(1, 28)}
    assert by_order == {1: 0.5, 2: 1.0, 3: 1.0, 4: 2.0, 5: 4.0, 6: 4.0}
    target_um = np.zeros(28)
    target_um[4] = 0.1
    same_sign, other_sign = np.zeros((2, 28))
    same_sign[4], other_sign[4] = 0.2, -0.0001
    assert search_loss(same_sign, target_um) == pytest.approx(200 * 0.1**2)
    expected = 200 * 10 * 0.1001**2
    assert search_loss(other_sign, target_um) == pytest.approx(expected)


@pytest.mark.parametrize("tightness", [10.0, 1.0, 0.1])
def test_box_minimum_equals_scipys_active_set(tightness, rng):
    matrix, right = rng.normal(size=(60, 20)), rng.normal(size=60)
    room = (-tightness * rng.random(20), tightness * rng.random(20))
    found = box_minimum(matrix.T @ matrix, matrix.T @ right, room)
    expected = lsq_linear(matrix, right, bounds=room, method="bvls").x
    assert found == pytest.approx(expected, abs=1e-9)


def test_bounded_fit_stops_on_the_bound_of_a_curved_valley():
    def valley(q):
        return np.stack([q[:, 1] - q[:, 0] ** 2, 2.0 - q[:, 0]], axis=-1)

    fit = fit_bounded(
        valley,
        target_um=np.zeros(2),
        start=np.array([-1.0, 1.0]),
        bounds=(np.array([-3.0, -3.0]), np.array([1.5, 5.0])),
        noise_um=1e-4,
    )
    assert fit.position_ratio == pytest.approx([1.5, 2.25], abs=1e-4)


def test_bounded_fit_says_that_its_start_has_no_answer():
    with pytest.raises(FitFailed, match="start"):
        fit_bounded(
            lambda q: np.full((len(q), 1), np.nan),
            target_um=np.zeros(1),
            start=np.zeros(1),
            bounds=(-np.ones(1), np.ones(1)),
            noise_um=1e-4,
        )


def test_prior_mean_follows_the_refraction_and_is_the_table_at_none():
    assert prior_for_refraction(0.0).from_unit(np.zeros(45)) == pytest.approx(
        [row.mean for row in PARAMETERS]
    )
    long_mm = prior_for_refraction(-6.0).from_unit(np.zeros(45))[0]
    assert long_mm == pytest.approx(23.82 + 6 * 0.299)
