"""The float64 reference against closed forms and a second, unrelated quadrature."""

import math

import numpy as np
import pytest
from scipy.special import j0, j1

from estimator.optics.zernike import zernike_values
from tests.numerical.psf_cases import case_zernike_um
from tests.reference.psf_integral import reference_field, reference_kernel

DIRECTIONS_MRAD = np.linspace(-6.0, 6.0, 25)


@pytest.mark.parametrize("pupil_mm", [2.0, 7.0])
def test_field_of_a_perfect_eye_is_the_airy_pattern(pupil_mm):
    theta_y = np.array([-0.7, 0.0, 1.3])
    field = reference_field(
        np.zeros(28),
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=550.0,
        theta_x_mrad=DIRECTIONS_MRAD,
        theta_y_mrad=theta_y,
    )
    v = math.pi * pupil_mm / 0.55 * np.hypot(DIRECTIONS_MRAD, theta_y[:, None])
    airy = np.where(v > 0, 2.0 * j1(v) / np.where(v > 0, v, 1.0), 1.0)
    # Rounding of about 1e5 terms.
    np.testing.assert_allclose(field, airy, atol=1e-13)


def _polar_field(zernike_um, pupil_mm, wavelength_nm, theta_x, theta_y):
    """Same integral in polar coordinates: Gauss-Legendre in r, trapezoid in angle."""
    node, weight = np.polynomial.legendre.leggauss(140)
    rho, weight = (node + 1.0) / 2.0, weight / 2.0
    angle = 2.0 * math.pi * np.arange(420) / 420
    x, y = rho[:, None] * np.cos(angle), rho[:, None] * np.sin(angle)
    wavefront = zernike_values(x, y) @ zernike_um
    field = np.empty((theta_y.size, theta_x.size), complex)
    for row, ty in enumerate(theta_y):
        for column, tx in enumerate(theta_x):
            path = wavefront - pupil_mm / 2.0 * (tx * x + ty * y)
            ring = np.exp(2j * math.pi * 1000.0 / wavelength_nm * path).mean(axis=1)
            field[row, column] = np.sum(weight * rho * ring) * 2.0
    return field


@pytest.mark.parametrize("case", ["keratoconus", "periph40", "astig3D"])
def test_field_equals_an_independent_polar_quadrature(case):
    zernike_um = case_zernike_um(case, 3.0)
    theta_x, theta_y = np.linspace(-4.0, 4.6, 3), np.array([-3.1, 2.2])
    field = reference_field(
        zernike_um,
        pupil_diameter_mm=3.0,
        wavelength_nm=550.0,
        theta_x_mrad=theta_x,
        theta_y_mrad=theta_y,
    )
    polar = _polar_field(zernike_um, 3.0, 550.0, theta_x, theta_y)
    # The stated 1e-11 of the node rule, in units of a perfect eye's peak.
    np.testing.assert_allclose(field, polar, rtol=0, atol=1e-11)


def test_pixel_sums_of_a_perfect_eye_are_the_integrated_airy_disc():
    """Square of pixels against the encircled energy 1 - J0² - J1² of disc and ring.

    The light of the whole square lies between that of the discs inscribed in and
    circumscribed about it; the central pixel is integrated here on its own.
    """
    pupil_mm, pitch, radius = 3.0, 1.295, 6
    kernel = reference_kernel(
        np.zeros(28),
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=550.0,
        pixel_pitch_mrad=pitch,
        radius_px=radius,
    )
    per_mrad = math.pi * pupil_mm / 0.55

    def encircled(radius_mrad):
        v = per_mrad * radius_mrad
        return 1.0 - j0(v) ** 2 - j1(v) ** 2

    half = (radius + 0.5) * pitch
    assert encircled(half) < kernel.sum() < encircled(half * math.sqrt(2.0))
    # Central pixel: the mean over all angles t of the light within its outline
    # a / cos t, which repeats every eighth of a turn.
    node, weight = np.polynomial.legendre.leggauss(200)
    outline = pitch / 2.0 / np.cos((node + 1.0) * math.pi / 8.0)
    central = np.sum(weight / 2.0 * encircled(outline))
    np.testing.assert_allclose(kernel[radius, radius], central, rtol=1e-9)


def test_reference_does_not_change_with_more_nodes():
    arguments = {
        "pupil_diameter_mm": 3.0,
        "wavelength_nm": 550.0,
        "pixel_pitch_mrad": (1.295, 0.9),
        "radius_px": 9,
    }
    zernike_um = case_zernike_um("keratoconus", 3.0)
    kernel = reference_kernel(zernike_um, **arguments)
    finer = reference_kernel(zernike_um, refine=1.3, **arguments)
    np.testing.assert_allclose(kernel, finer, rtol=0, atol=1e-9 * finer.max())


def test_whole_pixels_of_tilt_shift_the_reference_exactly():
    pupil_mm, pitch = 3.0, 1.295
    arguments = {
        "pupil_diameter_mm": pupil_mm,
        "wavelength_nm": 550.0,
        "pixel_pitch_mrad": pitch,
        "radius_px": 5,
    }
    tilt = np.zeros(28)
    # Z(1,±1) = 2 x, 2 y on the unit circle: slope 2 C / R mrad.
    tilt[2] = 2 * pitch * (pupil_mm / 2.0) / 2.0
    tilt[1] = 1 * pitch * (pupil_mm / 2.0) / 2.0
    still = reference_kernel(np.zeros(28), **arguments)
    moved = reference_kernel(tilt, **arguments)
    # +2 px to the right, +1 px up: one row less.
    np.testing.assert_allclose(moved[:-1, 2:], still[1:, :-2], atol=1e-12)
