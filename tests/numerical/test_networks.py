"""The trained networks in networks/weights, judged by ray tracing on fresh eyes.

What a card states is what fresh eyes must show; no figure here is a network's own.
"""

import subprocess
import sys

import numpy as np
import pytest

from estimator.estimate.estimation import GOOD_FIT_UM, estimate_eye, network_guess
from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.assembly import accommodated_vectors, eye_surfaces
from estimator.eye.parameters import EyeParameters, column, random_vectors
from estimator.eye.tracing import TraceFailed, zernike_of_vectors
from estimator.networks import inference as networks
from estimator.networks.inference import (
    INPUTS,
    NETWORK_NAMES,
    OutOfDomain,
    WeightsMissing,
    load_network,
    network_aberrations,
    network_eye,
    network_focus,
    network_zernike,
)
from estimator.optics.zernike import nm_from_index
from estimator.profiles.parse import parse_profile, preset_names
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.field_wavefronts import rim_from_ellipse
from tests.numerical.eye_cases import as_profile, random_eye_profiles
from tests.source_tree import ROOT
from training.population import population_eyes

WORSE_RATIO = 1.5
"""Mean error on fresh eyes over the one that the card states."""

N_EYES = 300
ROWS = ("table_2", "population")
"""Where fresh eyes are drawn from, as cards have it."""

OPEN_RATIO = 0.999


def inside(card, features):
    """Rows (P,) of inputs that lie within a card's ranges."""
    return np.all((features >= card.low) & (features <= card.high), axis=1)


def range_of(card, name):
    place = INPUTS[card.network].index(name)
    return card.low[place], card.high[place]


def draw(card, name, rng, size=None):
    return rng.uniform(*range_of(card, name), size)


def fresh_vectors(rows, count, rng):
    """Eyes of the paper's ranges, or as people have them."""
    if rows == "table_2":
        return random_vectors(count, rng)
    return population_eyes(rng.random((count, 45)), rng.random(count))


@pytest.mark.slow
@pytest.mark.parametrize("rows", ROWS)
def test_the_discriminator_has_its_stated_error(rng, rows):
    card = load_network("discriminator").card
    vectors, stated = fresh_vectors(rows, N_EYES, rng), card.error_by_rows[rows]
    errors_um = []
    for part in np.array_split(vectors, 10):
        state = {
            "pupil_diameter_mm": draw(card, "pupil_diameter_mm", rng),
            "wavelength_nm": draw(card, "wavelength_nm", rng),
        }
        difference_um = network_zernike(part, **state) - zernike_of_vectors(
            part, **state
        )
        errors_um.append(np.abs(difference_um[:, 1:]))
    assert stated.unit == "um"
    assert np.nanmean(np.concatenate(errors_um)) < WORSE_RATIO * stated.mean_abs


@pytest.mark.slow
@pytest.mark.parametrize("rows", ROWS)
def test_the_eye_network_s_eyes_have_the_stated_error(rng, rows):
    card = load_network("eye").card
    errors_um, stated = [], card.error_by_rows[rows]
    for vector in fresh_vectors(rows, N_EYES, rng):
        state = {
            "pupil_diameter_mm": draw(card, "pupil_diameter_mm", rng),
            "wavelength_nm": draw(card, "wavelength_nm", rng),
        }
        zernike_um = zernike_of_vectors(vector[None], **state)[0]
        if not np.isfinite(zernike_um).all():
            continue
        profile = as_profile(zernike_um, **state, name="random eye")
        found = estimate_eye(profile, method="network")
        if found.method == "network":
            errors_um.append(found.mean_abs_error_um)
    assert len(errors_um) > N_EYES // 2, "most random eyes are in the domain"
    assert stated.unit == "um"
    assert np.mean(errors_um) < WORSE_RATIO * stated.mean_abs


@pytest.mark.slow
@pytest.mark.parametrize("rows", ROWS)
def test_the_focus_network_has_its_stated_error(rng, rows):
    """Where the lens is at no bound: there any answer beyond it is right."""
    card = load_network("focus").card
    inputs, traced_mm = [], []
    for vector in fresh_vectors(rows, N_EYES, rng):
        pupil_mm = draw(card, "pupil_diameter_mm", rng)
        try:
            eye = AccommodatingEye(
                EyeParameters.from_vector(vector), pupil_diameter_mm=pupil_mm
            )
        except TraceFailed:
            continue
        focus_dpt = draw(card, "focus_dpt", rng)
        used_dpt = eye.accommodations_at_cornea_dpt(np.array([-focus_dpt]))
        if not 0.0 < used_dpt[0] < eye.lens_range_dpt:
            continue
        (state,) = eye.states_at(used_dpt)
        inputs.append([*vector, pupil_mm, focus_dpt])
        traced_mm.append(
            [state.lens_diameter_change_mm, state.aqueous_thickness_change_mm]
        )
    inputs, traced_mm = np.array(inputs), np.array(traced_mm)
    known = inside(card, inputs)
    assert known.mean() > 0.5
    found_mm = network_focus(
        inputs[known, :45],
        pupil_diameter_mm=inputs[known, 45],
        focus_dpt=inputs[known, 46],
    )
    error_mm = np.abs(np.stack(found_mm, axis=-1) - traced_mm[known])
    stated = card.error_by_rows[rows]
    assert stated.unit == "mm"
    assert error_mm.mean() < WORSE_RATIO * stated.mean_abs


def test_the_focus_network_finds_lenses_whose_conic_changes():
    """It was trained on lenses that keep theirs: alone it is 0.01 to 0.06 mm off."""
    eye = AccommodatingEye(EyeParameters.mean_eye(), pupil_diameter_mm=5.0)
    used_dpt = np.array([1.0, 3.0, 5.0])
    found_mm, aqueous_mm = network_focus(
        eye.parameters.to_vector(),
        pupil_diameter_mm=5.0,
        focus_dpt=-eye.at_cornea_dpt(used_dpt),
    )
    expected_mm = eye.changes_mm(used_dpt)
    np.testing.assert_allclose(found_mm, expected_mm[:, 0], atol=1.5e-3)
    np.testing.assert_allclose(aqueous_mm, expected_mm[:, 1], atol=1.5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("rows", ROWS)
def test_the_aberration_network_has_its_stated_error(rng, rows):
    card = load_network("aberration").card
    stated = card.error_by_rows[rows]
    errors_um, rim_errors_mm = [], []
    lens, ratios = column("lens_diameter_mm"), rng.uniform(0.9, 1.0, N_EYES)
    for vector, ratio in zip(fresh_vectors(rows, N_EYES, rng), ratios, strict=True):
        focused = accommodated_vectors(vector, lens_diameter_mm=vector[lens] * ratio)[0]
        state = {
            name: draw(card, name, rng)
            for name in ("pupil_diameter_mm", "wavelength_nm", "h_deg", "v_deg")
        }
        if not inside(card, np.array([[*focused, *state.values()]]))[0]:
            continue
        traced = wavefront_grid(
            eye_surfaces(EyeParameters.from_vector(focused)),
            fields_deg=[[state["h_deg"], state["v_deg"]]],
            wavelengths_nm=[state["wavelength_nm"]],
            pupil_diameters_mm=[state["pupil_diameter_mm"]],
        )
        if not traced.open_ratio[0, 0, 0] > OPEN_RATIO:
            continue
        found = network_aberrations(focused, **state)
        one = (0, 0, 0)
        errors_um.append(np.abs(found.zernike_um - traced.zernike_um[one])[1:])
        rim_mm = rim_from_ellipse(traced.ellipse_mm[one])
        rim_errors_mm.append(np.abs(found.rim_mm - rim_mm))
    assert len(errors_um) > N_EYES // 3, "most random eyes are in the domain"
    assert stated.unit == "um"
    assert np.mean(errors_um) < WORSE_RATIO * stated.mean_abs
    assert np.mean(rim_errors_mm) < 0.1  # of 1 to 4 mm: the right columns


@pytest.mark.parametrize("name", NETWORK_NAMES)
def test_every_range_is_enforced(name):
    network = load_network(name)
    middle = 0.5 * (network.card.low + network.card.high)
    assert np.isfinite(network(middle[None])).all()
    width = np.maximum(network.card.high - network.card.low, 1e-3)
    for place in range(middle.size):
        for end, sign in ((network.card.low, -1.0), (network.card.high, 1.0)):
            features = np.repeat(middle[None], 2, axis=0)
            features[1, place] = end[place] + sign * 0.01 * width[place]
            with pytest.raises(OutOfDomain) as refused:
                network(features)
            (excess,) = refused.value.excesses
            assert excess.value == features[1, place]


@pytest.mark.parametrize("name", NETWORK_NAMES)
def test_a_batch_is_its_rows(name, rng):
    network = load_network(name)
    n = networks.BATCH + 3
    features = rng.uniform(network.card.low, network.card.high, (n, middle_size(name)))
    together = network(features)
    for row in (0, 1, networks.BATCH - 1, networks.BATCH, n - 1):
        alone = network(features[row][None])[0]
        np.testing.assert_allclose(together[row], alone, rtol=1e-4, atol=1e-5)


def middle_size(name):
    return load_network(name).card.low.size


def test_arguments_broadcast_and_a_single_eye_has_a_single_answer():
    card = load_network("aberration").card
    vector = 0.5 * (card.low + card.high)[:45]
    low_mm, high_mm = range_of(card, "pupil_diameter_mm")
    pupils_mm = np.linspace(low_mm, high_mm, 3)
    state = {"wavelength_nm": 555.0, "v_deg": 1.0}
    found = network_aberrations(
        vector, pupil_diameter_mm=pupils_mm[:, None], h_deg=[-2.0, 5.0], **state
    )
    assert found.zernike_um.shape == (3, 2, 28)
    assert found.zernike_radius_mm.shape == (3, 2)
    assert found.rim_mm.shape == (3, 2, 5)
    assert np.all(found.zernike_um[..., 0] == 0.0)
    one = network_aberrations(
        vector, pupil_diameter_mm=pupils_mm[2], h_deg=-2.0, **state
    )
    assert one.zernike_um.shape == (28,)
    assert one.zernike_radius_mm.shape == ()
    np.testing.assert_allclose(one.zernike_um, found.zernike_um[2, 0], atol=1e-4)


def test_a_network_is_loaded_once():
    assert load_network("eye") is load_network("eye")


def test_piston_and_tilt_of_a_measurement_say_nothing(rng):
    profile, _ = random_eye_profiles(1, rng)[0]
    state = {
        "pupil_diameter_mm": profile.pupil_diameter_mm,
        "wavelength_nm": profile.wavelength_nm,
    }
    card = load_network("eye").card
    zernike_um = np.concatenate([[0.0] * 3, 0.5 * (card.low + card.high)[:25]])
    tilted_um = zernike_um.copy()
    tilted_um[:3] = 7.0
    vector = network_eye(zernike_um, **state)
    assert vector.shape == (45,)
    np.testing.assert_array_equal(network_eye(tilted_um, **state), vector)


def measurement(profile, h_deg=0.0):
    terms = {
        "{},{}".format(*nm_from_index(j)): float(c)
        for j, c in enumerate(profile.zernike_um)
    }
    return {
        "zernike_um": terms,
        "h_deg": h_deg,
        "pupil_diameter_mm": profile.pupil_diameter_mm,
        "wavelength_nm": profile.wavelength_nm,
    }


def test_of_several_measurements_the_axial_one_is_asked_of():
    profile = parse_profile({"kind": "preset", "name": "myopia"})
    measurements = [measurement(profile, h_deg=10.0), measurement(profile)]
    measurements[0]["zernike_um"]["2,0"] += 1.0
    several = parse_profile(
        {"kind": "zernike_set", "measurements": measurements, "periphery": "model"}
    )
    np.testing.assert_allclose(network_guess(several), network_guess(profile))
    found = estimate_eye(several, method="network")
    assert found.method == "network"
    assert found.mean_abs_error_um > 0.01


def test_refined_eyes_do_not_depend_on_where_they_start(rng):
    for profile, _ in random_eye_profiles(2, rng):
        table = estimate_eye(profile, starts=("table",))
        network = estimate_eye(profile, starts=("network",))
        both = estimate_eye(profile, starts=("table", "network"))
        assert table.start == "table"
        assert both.start in ("table", "network")
        assert both.mean_abs_error_um < 1e-2
        assert network.mean_abs_error_um < max(1e-2, 2 * table.mean_abs_error_um)


@pytest.mark.parametrize("name", preset_names())
def test_a_poor_fit_from_one_start_is_tried_from_the_other(name):
    profile = parse_profile({"kind": "preset", "name": name})
    table = estimate_eye(profile)
    both = estimate_eye(profile, starts=("table", "network"))
    assert both.mean_abs_error_um <= max(GOOD_FIT_UM, table.mean_abs_error_um)


def test_a_wavefront_out_of_the_domain_is_refined_with_a_note():
    card = load_network("eye").card
    _, high_mm = range_of(card, "pupil_diameter_mm")
    zernike_um = np.zeros(28)
    zernike_um[4] = 0.5
    profile = as_profile(
        zernike_um,
        pupil_diameter_mm=high_mm + 0.4,
        wavelength_nm=555.0,
        name="wide pupil",
    )
    found = estimate_eye(profile, method="network")
    exact = estimate_eye(profile, starts=("table",))
    assert found.method == "refined"
    assert found.start == "table"
    assert "pupil_diameter_mm" in found.notes[0]
    np.testing.assert_array_equal(
        found.parameters.to_vector(), exact.parameters.to_vector()
    )


def test_without_weights_a_refined_eye_starts_at_the_table(monkeypatch):
    def missing(name):
        raise WeightsMissing(f"{name}.onnx is missing")

    monkeypatch.setattr(networks, "load_network", missing)
    profile = parse_profile({"kind": "preset", "name": "myopia"})
    found = estimate_eye(profile, starts=("table", "network"))
    assert found.start == "table"
    assert "missing" in found.network_reason
    with pytest.raises(WeightsMissing):
        estimate_eye(profile, method="network")


def test_an_unknown_start_is_refused():
    profile = parse_profile({"kind": "preset", "name": "myopia"})
    with pytest.raises(ValueError, match="starts"):
        estimate_eye(profile, starts=("guess",))


@pytest.mark.long("a process imports and estimates")
def test_everything_runs_with_torch_absent_and_without_a_warning():
    script = (
        "import sys\n"
        "sys.modules['torch'] = sys.modules['onnx'] = None\n"
        "import estimator.networks.inference, filter_service.service.supervisor\n"
        "from estimator.estimate.estimation import estimate_eye\n"
        "from estimator.profiles.parse import parse_profile\n"
        "profile = parse_profile({'kind': 'preset', 'name': 'myopia'})\n"
        "found = estimate_eye(profile, method='network')\n"
        "assert found.method == 'network', found.notes\n"
        "assert estimate_eye(profile).mean_abs_error_um < 1e-3\n"
    )
    finished = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    assert finished.stderr == ""
