"""What an estimated eye leaves of its measurement: on the axis nothing is lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimator import load_profile
from estimator.estimate.estimation import estimate_eye
from estimator.estimate.measured_residual import (
    FADE_DEG,
    OVERSHOOT,
    MeasuredResidual,
)
from estimator.field.traced_eye import TracedEye
from estimator.optics.vergence import (
    TYPICAL_ENTRANCE_PUPIL_MM,
    chromatic_refraction_dpt,
)
from estimator.optics.zernike import (
    nm_from_index,
    remove_central_tilt,
    rescale_pupil,
    summed_terms,
    zernike_values,
)
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile, preset_names
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.field_wavefronts import (
    polynomial_in_mm,
    rim_from_ellipse,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial, moved_wavefront
from filter_service.planning.grid import pupil_nodes_mm
from tests.numerical.eye_cases import population_profiles, random_eye_profiles
from tests.numerical.test_field_wavefronts import points_of
from tests.numerical.test_moved_plane import exact_wave

ABERROMETER_FILE = Path(__file__).parents[2] / "examples" / "data" / "aberrometer.csv"

WILD = {
    "kind": "zernike",
    "pupil_diameter_mm": 5.0,
    "wavelength_nm": 555.0,
    "zernike_um": {"2,0": 1.0, "3,3": 0.6, "4,-4": 0.5, "5,1": -0.3, "6,6": 0.25},
}
"""Farther from any eye than the 45 parameters reach."""


def on_axis_um(estimated):
    """Coefficients of the traced eye on its axis, in the measured pupil."""
    profile = estimated.profile
    pupil_mm, wavelength_nm = profile.pupil_diameter_mm, profile.wavelength_nm
    eye = TracedEye.trace(
        estimated,
        pupil_diameters_mm=[pupil_mm],
        focus_range_dpt=(-30.0, -30.0),  # relaxed, hyperopes too
        wavelengths_nm=[wavelength_nm],
    )
    state = {
        **{"h_deg": 0.0, "v_deg": 0.0, "pupil_diameter_mm": pupil_mm},
        **{"accommodation_dpt": 0.0, "wavelength_nm": wavelength_nm},
    }
    total_dpt = eye.total_defocus_dpt(**state)
    return eye.wavefronts(**state, total_defocus_dpt=total_dpt).zernike_um[0]


def axis_error_um(profile):
    """RMS, um, of what the traced eye has on its axis less what was measured."""
    estimated = estimate_eye(profile)
    ours_um, radius_mm = on_axis_um(estimated), profile.pupil_diameter_mm / 2.0
    at_cornea_um = polynomial_in_mm(remove_central_tilt(profile.zernike_um), radius_mm)
    in_pupil_um = moved_wavefront(
        at_cornea_um,
        depth_mm=estimated.accommodating.entrance_pupil_mm,
        radius_mm=radius_mm,
    )
    expected_um = zernike_from_polynomial(in_pupil_um, radius_mm)
    error_um = summed_terms(ours_um, -expected_um)
    return float(np.sqrt(np.sum(error_um[1:] ** 2)))


@pytest.mark.parametrize("name", preset_names())
def test_presets_are_exact_on_their_axis(name):
    assert axis_error_um(parse_profile({"kind": "preset", "name": name})) < 1e-9


def wavefront(zernike_um, pupil_mm):
    body = {"kind": "zernike", "pupil_diameter_mm": pupil_mm, "wavelength_nm": 555.0}
    terms = {"{},{}".format(*nm_from_index(j)): v for j, v in enumerate(zernike_um)}
    return parse_profile({**body, "zernike_um": terms})


def tenth_order():
    order = np.array([nm_from_index(j)[0] for j in range(66)])
    size_um = np.array([0, 0, 1.0, 0.3, 0.2, 0.08, 0.05, 0.03, 0.02, 0.015, 0.01])
    zernike_um = np.random.default_rng(4).normal(size=66) * size_um[order]
    return wavefront(zernike_um.tolist(), 6.0)


def keratoconus(ratio, pupil_mm):
    profile = parse_profile({"kind": "preset", "name": "keratoconus"})
    on_pupil = pupil_mm / profile.pupil_diameter_mm
    zernike_um = ratio * rescale_pupil(profile.zernike_um, radius_ratio=on_pupil)
    return wavefront(zernike_um.tolist(), pupil_mm)


MEASURED = {
    "keratoconus 5 mm": (keratoconus(1.0, 5.0), 28),
    "keratoconus 6 mm": (keratoconus(1.0, 6.0), 28),
    "severe keratoconus 5 mm": (keratoconus(1.5, 5.0), 28),
    "severe keratoconus 6 mm": (keratoconus(1.5, 6.0), 36),
    "aberrometer file": (load_profile(ABERROMETER_FILE), 28),
    "tenth order": (tenth_order(), 66),
}


def ray_error_um(profile, zernike_um, depth_mm):
    """RMS, um, of a wavefront in the pupil less that of the measurement's rays."""
    radius_mm = profile.pupil_diameter_mm / 2.0
    along = np.linspace(-radius_mm, radius_mm, 25)
    x, y = np.meshgrid(along, along)
    inside = np.hypot(x, y) <= radius_mm
    x, y = x[inside], y[inside]
    measured_um = polynomial_in_mm(remove_central_tilt(profile.zernike_um), radius_mm)
    measured_um[1:3] = 0.0
    values = zernike_values(x / radius_mm, y / radius_mm, n_terms=zernike_um.size)
    error_um = values @ zernike_um - exact_wave(measured_um, depth_mm, x, y)
    plane = np.stack([np.ones_like(x), x, y])  # tilt moves the image only
    error_um -= plane.T @ np.linalg.lstsq(plane.T, error_um)[0]
    return np.sqrt(np.mean(error_um**2))


@pytest.mark.parametrize("name", MEASURED)
def test_a_measured_wavefront_follows_the_rays_into_the_pupil(name):
    profile, n_terms = MEASURED[name]
    zernike_um = MeasuredWavefront(profile).zernike_um
    assert zernike_um.size == n_terms
    assert ray_error_um(profile, zernike_um, TYPICAL_ENTRANCE_PUPIL_MM) <= 0.005


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "tenth order"))
        for name in MEASURED
    ],
)
def test_a_traced_eye_follows_the_rays_on_its_axis(name):
    profile, _ = MEASURED[name]
    estimated = estimate_eye(profile)
    zernike_um = on_axis_um(estimated)
    depth_mm = estimated.accommodating.entrance_pupil_mm
    assert ray_error_um(profile, zernike_um, depth_mm) <= 0.005


@pytest.mark.parametrize(
    ("name", "n_terms"),
    [
        ("keratoconus 6 mm", 36),
        *(
            pytest.param(name, n_terms, marks=pytest.mark.slow)
            for name, n_terms in (
                ("keratoconus 5 mm", 28),
                ("severe keratoconus 5 mm", 36),
                ("severe keratoconus 6 mm", 45),
                ("aberrometer file", 36),
                ("tenth order", 36),
            )
        ),
    ],
)
def test_traced_wavefronts_follow_their_rays_off_the_axis(name, n_terms):
    """Against fits of tenth order to eight times the rays, over the pupil."""
    estimated = estimate_eye(replace(MEASURED[name][0], periphery="model"))
    pupil_mm = estimated.profile.pupil_diameter_mm
    h_deg = np.array([0.0, 10.0, 20.0, 30.0, 40.0])
    eye = TracedEye.trace(
        estimated,
        pupil_diameters_mm=[pupil_mm],
        focus_range_dpt=(-30.0, -30.0),
        wavelengths_nm=[555.0],
        field_range_deg=((0.0, 40.0), (0.0, 0.0)),
        nodes_deg=(h_deg, np.zeros(1)),
    )
    state = {"h_deg": h_deg, "v_deg": 0.0, "pupil_diameter_mm": pupil_mm}
    state |= {"accommodation_dpt": 0.0, "wavelength_nm": 555.0}
    found = eye.wavefronts(**state, total_defocus_dpt=eye.total_defocus_dpt(**state))
    dense = wavefront_grid(
        estimated.relaxed,
        fields_deg=np.stack([h_deg, np.zeros(5)], axis=-1),
        wavelengths_nm=[555.0],
        pupil_diameters_mm=[pupil_mm],
        plane="pupil",
        n_rings=14,
        n_azimuths=40,
        n_terms=66,
    )
    assert eye._field.grid.zernike_um.shape[-1] == n_terms
    rest, share = estimated.rest([555.0], n_traced_terms=66), eye._residual.left_share
    expected_um = summed_terms(
        polynomial_in_mm(dense.zernike_um, dense.zernike_radius_mm)[:, 0, 0],
        rest.residues_um(np.full(5, pupil_mm / 2.0), share(h_deg, 0.0 * h_deg)),
        rest.color_um(np.full(5, 555.0)),
    )
    radius_mm = found.circle_diameter_mm / 2.0
    expected_um = zernike_from_polynomial(expected_um, radius_mm)
    for k, ellipse in enumerate(rim_from_ellipse(found.pupil_ellipse)):
        x, y = points_of(ellipse).T / radius_mm[k]
        error_um = zernike_values(x, y, n_terms=66) @ summed_terms(
            expected_um[k], -found.zernike_um[k]
        )
        plane = np.stack([np.ones_like(x), x, y])
        error_um -= plane.T @ np.linalg.lstsq(plane.T, error_um)[0]
        assert error_um.std() <= 0.005


def test_a_wavefront_that_no_eye_has_is_exact_too_and_said():
    profile = parse_profile(WILD)
    estimated = estimate_eye(profile)
    assert estimated.rest(555.0).rms_um > 0.05
    assert any("the rest is added" in note for note in estimated.notes)
    assert axis_error_um(profile) < 1e-9


def test_random_eyes_are_exact_on_their_axis(rng):
    profiles = [p for p, _ in random_eye_profiles(2, rng)] + population_profiles(2, rng)
    assert max(map(axis_error_um, profiles)) < 1e-4


@pytest.mark.slow
def test_1000_random_eyes_are_exact_on_their_axis(rng):
    profiles = [p for p, _ in random_eye_profiles(500, rng)]
    profiles += population_profiles(500, rng)
    assert max(map(axis_error_um, profiles)) < 1e-4


def test_the_rest_fades_and_does_not_run_away_in_wide_pupils():
    rest = estimate_eye(parse_profile(WILD)).rest(555.0)
    share = rest.left_share([0.0, FADE_DEG, 0.0, 45.0], [0.0, 0.0, -FADE_DEG, 25.0])
    assert share == pytest.approx([1.0, np.exp(-1), np.exp(-1), 0.0], abs=1e-4)
    most_um = rest_rms_um(rest, 2.5 * (1.0 + 2.0 * OVERSHOOT))
    assert rest_rms_um(rest, 2.5) == pytest.approx(rest.rms_um, rel=1e-9)
    assert most_um < 1.3 * rest.rms_um
    for radius_mm in (3.0, 4.5):
        assert rest_rms_um(rest, radius_mm) == pytest.approx(most_um, rel=1e-9)


def rest_rms_um(rest, radius_mm):
    """RMS, um, of the residual in a pupil."""
    polynomial_um = rest.residues_um(np.array([radius_mm]), np.ones(1))[0]
    zernike_um = zernike_from_polynomial(polynomial_um, radius_mm)
    return float(np.sqrt(np.sum(zernike_um[3:] ** 2)))


@pytest.mark.parametrize("name", [*preset_names(), "wild"])
def test_refraction_changes_smoothly_with_the_pupil(name):
    """The slope over the pupil jumps by less than 0.03 dpt/mm, from 2 to 8 mm."""
    profile = parse_profile(
        WILD if name == "wild" else {"kind": "preset", "name": name}
    )
    eye = TracedEye.trace(
        estimate_eye(profile),
        pupil_diameters_mm=pupil_nodes_mm((2.0, 8.0)),
        focus_range_dpt=(0.0, 4.0),
        wavelengths_nm=[555.0],
    )
    step_mm = 0.01
    pupils_mm = np.arange(2.0, eye.max_pupil_diameter_mm, step_mm)
    for focus_dpt in (0.0, 4.0):
        refractions_dpt = eye.total_defocus_dpt(
            pupil_diameter_mm=pupils_mm,
            accommodation_dpt=eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=4.0),
            wavelength_nm=555.0,
        )
        slopes_dpt_mm = np.diff(refractions_dpt) / step_mm
        assert np.abs(np.diff(slopes_dpt_mm)).max() < 0.03


def test_color_is_that_of_measured_eyes():
    profile = parse_profile({"kind": "preset", "name": "post_lasik"})
    wavelengths_nm = np.array([464.0, 549.0, 612.0])
    traced = TracedEye.trace(
        estimate_eye(profile),
        pupil_diameters_mm=[3.0],
        focus_range_dpt=(0.0, 2.0),
        wavelengths_nm=wavelengths_nm,
    )
    for eye in (traced, MeasuredWavefront(profile)):
        found_dpt = eye.total_defocus_dpt(
            pupil_diameter_mm=3.0,
            accommodation_dpt=0.0,
            wavelength_nm=wavelengths_nm,
        )
        published_dpt = chromatic_refraction_dpt(wavelengths_nm)
        assert np.diff(found_dpt) == pytest.approx(np.diff(published_dpt), abs=5e-3)


def test_a_given_eye_is_traced_as_it_is():
    estimated = estimate_eye(parse_profile({"kind": "preset", "name": "cataract"}))
    body = {"kind": "eye", "parameters": estimated.parameters.to_mapping()}
    given = estimate_eye(parse_profile(body))
    none = given.rest([464.0, 612.0])
    assert not none.residue_um.any()
    assert not none.color_dpt.any()


@pytest.mark.parametrize(
    ("sphere_dpt", "named"),
    [(0.0, ()), (-4.0, ()), (18.0, ("corneal power",)), (-20.0, ("eye length",))],
)
def test_what_is_unusual_in_a_person_is_named(sphere_dpt, named):
    body = {"kind": "prescription", "sphere_dpt": sphere_dpt}
    notes = " ".join(estimate_eye(parse_profile(body)).notes)
    assert ("unusual for a person" in notes) == bool(named)
    for word in named:
        assert word in notes


@pytest.mark.parametrize("depth_mm", [1.0, 3.0])
def test_a_wavefront_is_carried_to_another_plane_as_rays_go(depth_mm):
    """Against the same eye traced in both planes, where six orders hold all of it."""
    estimated = estimate_eye(
        parse_profile({"kind": "prescription", "sphere_dpt": -12.0})
    )
    (state,) = estimated.accommodating.states_at([0.0])
    at = {
        "fields_deg": [[0.0, 0.0]],
        "wavelengths_nm": [555.0],
        "pupil_diameters_mm": [4.0],
    }
    outer, inner = (
        wavefront_grid(state.surfaces, **at, plane=plane)
        for plane in ("cornea", "pupil")
    )
    whole_mm = float(
        np.linalg.norm(outer.pupil_point_mm - inner.pupil_point_mm, axis=-1).squeeze()
    )
    polynomial_um = polynomial_in_mm(outer.zernike_um, outer.zernike_radius_mm)
    for step_mm in (depth_mm, whole_mm - depth_mm):
        polynomial_um = moved_polynomial(
            polynomial_um, depth_mm=step_mm, radius_mm=inner.zernike_radius_mm
        )
    ours_um = zernike_from_polynomial(polynomial_um, inner.zernike_radius_mm)
    assert np.abs(ours_um - inner.zernike_um)[..., 1:].max() < 1e-4


def test_the_rest_of_a_narrow_pupil_is_the_measurement_there():
    profile = parse_profile(WILD)
    rest = MeasuredResidual.of(
        estimate_eye(profile).parameters, profile, wavelengths_nm=[555.0]
    )
    narrow_um = rest.residues_um(np.array([1.5]), np.ones(1))[0]
    assert narrow_um == pytest.approx(rest.residue_um)
