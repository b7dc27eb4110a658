"""Wavefronts in another plane, against rays that are traced back from its points."""

import numpy as np
import pytest

from estimator import load_profile, prepare_eye
from estimator.optics.zernike import (
    MAX_TERMS,
    N_TERMS,
    exponents,
    nm_from_index,
    remove_central_tilt,
)
from estimator.wavefront.field_wavefronts import polynomial_in_mm
from estimator.wavefront.moved_plane import moved_polynomial
from tests.numerical.eye_cases import population_profiles

DEPTH_MM = 3.05


def wave(polynomial_um, x, y):
    """W, um, and its slopes, mrad, at points in mm: term by term."""
    found = np.zeros((3, *x.shape))
    for value, (a, b) in zip(
        polynomial_um, exponents(polynomial_um.size).tolist(), strict=True
    ):
        found[0] += value * x**a * y**b
        found[1] += value * a * x ** max(a - 1, 0) * y**b
        found[2] += value * b * x**a * y ** max(b - 1, 0)
    return found


def exact_wave(polynomial_um, depth_mm, x, y):
    """W at points of the plane at a depth: the ray to each is searched for."""
    from_x, from_y = x, y
    for _ in range(12):
        _, slope_x, slope_y = wave(polynomial_um, from_x, from_y)
        from_x, from_y = x - depth_mm * slope_x / 1e3, y - depth_mm * slope_y / 1e3
    value, slope_x, slope_y = wave(polynomial_um, from_x, from_y)
    assert np.abs(from_x + depth_mm * slope_x / 1e3 - x).max() < 1e-6
    return value + depth_mm * (slope_x**2 + slope_y**2) / 2e3


def moved_error_um(zernike_um, measured_mm, pupil_mm, depth_mm=DEPTH_MM, n_terms=None):
    polynomial_um = polynomial_in_mm(remove_central_tilt(zernike_um), measured_mm / 2)
    across = np.linspace(-pupil_mm / 2, pupil_mm / 2, 25)
    x, y = np.meshgrid(across, across)
    inside = np.hypot(x, y) <= pupil_mm / 2
    x, y = x[inside], y[inside]
    moved_um = moved_polynomial(
        polynomial_um, depth_mm=depth_mm, radius_mm=pupil_mm / 2, n_terms=n_terms
    )
    assert moved_um.size == (n_terms or polynomial_um.size)
    untilted_um = polynomial_um.copy()
    untilted_um[1:3] = 0.0
    moved_um[1:3] -= polynomial_um[1:3]
    error_um = wave(moved_um, x, y)[0] - exact_wave(untilted_um, depth_mm, x, y)
    return error_um.std()


@pytest.mark.parametrize("depth_mm", [DEPTH_MM, -DEPTH_MM])
@pytest.mark.parametrize(
    ("stretch", "pupil_mm"), [(1.0, 4.0), (1.0, 5.0), (1.0, 6.0), (1.5, 5.0)]
)
def test_keratoconus_is_moved_as_rays_are(stretch, pupil_mm, depth_mm):
    profile = load_profile("keratoconus")
    zernike_um = stretch * profile.zernike_um
    error_um = moved_error_um(zernike_um, profile.pupil_diameter_mm, pupil_mm, depth_mm)
    assert error_um < 0.005


@pytest.mark.parametrize("depth_mm", [DEPTH_MM, -DEPTH_MM])
def test_more_terms_follow_the_rays_of_severe_keratoconus(depth_mm):
    profile = load_profile("keratoconus")
    wave = 1.5 * profile.zernike_um, profile.pupil_diameter_mm, 6.0, depth_mm
    assert moved_error_um(*wave) > 0.005
    errors_um = [moved_error_um(*wave, n_terms=n) for n in (36, 45, 55, MAX_TERMS)]
    assert errors_um == sorted(errors_um, reverse=True)
    assert errors_um[0] < 0.004
    assert errors_um[-1] < 0.0003


@pytest.mark.parametrize("pupil_mm", [4.0, 6.0])
def test_a_wavefront_of_tenth_order_keeps_its_terms(rng, pupil_mm):
    orders = np.array([nm_from_index(j)[0] for j in range(MAX_TERMS)])
    typical_um = np.array([0, 0, 1.5, 0.3, 0.2, 0.08, 0.05, 0.03, 0.02, 0.015, 0.01])
    zernike_um = rng.normal(size=MAX_TERMS) * typical_um[orders]
    assert moved_error_um(zernike_um, 6.0, pupil_mm) < 0.005
    # the first 28 terms alone are another wavefront
    assert np.linalg.norm(zernike_um[N_TERMS:]) > 0.05


def test_usual_eyes_are_moved_as_rays_are(rng):
    for profile in population_profiles(4, rng):
        diameter_mm = profile.pupil_diameter_mm
        assert moved_error_um(profile.zernike_um, diameter_mm, diameter_mm) < 0.001


def test_power_is_moved_in_closed_form():
    """A sphere of P dpt, moved by d, has P / (1 + d P)."""
    for power_dpt in (-30.0, -5.0, 10.0, 30.0):
        sphere_um = np.zeros(28)
        sphere_um[[3, 5]] = power_dpt / 2.0
        moved_um = moved_polynomial(sphere_um, depth_mm=DEPTH_MM, radius_mm=3.0)
        expected_dpt = power_dpt / (1.0 + 1e-3 * DEPTH_MM * power_dpt)
        assert 2.0 * moved_um[[3, 5]] == pytest.approx(expected_dpt, abs=1e-9)
        assert np.delete(moved_um, [3, 5]) == pytest.approx(0.0, abs=1e-9)


def test_many_planes_and_circles_at_once_equal_one_by_one(rng):
    polynomials_um = rng.normal(size=(2, 3, 28)) * 0.1
    depths_mm, radii_mm = np.array([[1.0], [-3.0]]), np.array([1.0, 2.0, 3.0])
    together = moved_polynomial(polynomials_um, depth_mm=depths_mm, radius_mm=radii_mm)
    for i, j in np.ndindex(2, 3):
        alone = moved_polynomial(
            polynomials_um[i, j], depth_mm=depths_mm[i, 0], radius_mm=radii_mm[j]
        )
        np.testing.assert_array_equal(together[i, j], alone)


@pytest.mark.parametrize(
    "h_range_deg", [(27.0, 33.0), (20.0, 40.0), (30.0, 30.0), (0.0, 33.0)]
)
def test_a_field_without_the_axis_has_the_same_wavefronts(h_range_deg):
    at = {"h_deg": 30.0, "v_deg": 0.0, "pupil_diameter_mm": 4.0}
    at |= {"accommodation_dpt": 0.0, "wavelength_nm": 536.0}

    def seen(h_range_deg, v_range_deg):
        eye, _ = prepare_eye(
            load_profile("emmetropia"),
            pupil_diameters_mm=[4.0],
            wavelengths_nm=[536.0],
            field_range_deg=(h_range_deg, v_range_deg),
        )
        total_dpt = eye.total_defocus_dpt(**at)
        return total_dpt, eye.wavefronts(**at, total_defocus_dpt=total_dpt)

    whole_dpt, whole = seen((-35.0, 35.0), (-10.0, 10.0))
    assert whole_dpt == pytest.approx(-1.277, abs=0.002)  # 1.28 dpt in people
    part_dpt, part = seen(h_range_deg, (-3.0, 3.0) if h_range_deg[0] else (-3.0, 0.0))
    assert part_dpt == pytest.approx(whole_dpt, abs=1e-5)
    assert part.zernike_um == pytest.approx(whole.zernike_um, abs=2e-5)


@pytest.mark.parametrize("power_dpt", [-20.0, 10.0, 250.0, 298.0])
def test_a_sphere_ends_in_its_focus(power_dpt):
    """Near the focus, 3.05 mm deep at 328 dpt, its rays fill a tenth of the circle."""
    sphere_um = np.zeros(28)
    sphere_um[[3, 5]] = -power_dpt / 2.0
    (moved_um,) = moved_polynomial(sphere_um[None], depth_mm=3.05, radius_mm=1.0)
    expected_dpt = power_dpt / (1.0 - 3.05e-3 * power_dpt)
    np.testing.assert_allclose(-2.0 * moved_um[[3, 5]], expected_dpt, rtol=1e-9)
    assert np.abs(np.delete(moved_um, [3, 5])).max() < 1e-6
