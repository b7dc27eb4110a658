"""Reference of a point's image against closed forms and a plain FFT, and frames."""

import math

import numpy as np
import pytest
import scipy.fft
from scipy.special import j0, j1

from estimator.optics.zernike import zernike_values
from tests.reference.point_image import LEFT_OUT_RATIO, PointWavefront
from tests.reference.psf_integral import reference_kernel

CIRCLE = np.array([0.0, 0.0, 1.0, 1.0, 0.0])


def wavefront(zernike_um, diameter_mm, *, ellipse=CIRCLE, scale=None, nm=550.0):
    radius_mm = diameter_mm / 2.0
    return PointWavefront(
        np.asarray(zernike_um, float),
        diameter_mm,
        ellipse * [radius_mm, radius_mm, radius_mm, radius_mm, 1.0],
        nm,
        np.eye(2) if scale is None else scale,
    )


def test_light_of_a_perfect_eye_is_that_of_the_airy_pattern():
    """Rings of pixels against 1 - J0² - J1², also where the closed form begins."""
    diameter_mm, nm = 3.0, 550.0
    image = wavefront(np.zeros(28), diameter_mm).image(max_radius_px=40)
    y, x = np.mgrid[-40:41, -40:41]
    distance_px = np.hypot(x, y)

    def encircled(radius_px):
        v = math.pi * diameter_mm / (nm / 1e3) * radius_px
        return 1.0 - j0(v) ** 2 - j1(v) ** 2

    for inner, outer in ((10.5, 18.5), (20.5, 30.5), (30.5, 38.5)):
        # Pixels cut by the circles count by the share of their area inside.
        fine = (np.arange(5) - 2.0) / 5.0
        sub = np.hypot(x[..., None, None] + fine[:, None], y[..., None, None] + fine)
        share = ((sub >= inner) & (sub < outer)).mean(axis=(2, 3))
        expected = encircled(outer) - encircled(inner)
        assert (image * share).sum() == pytest.approx(expected, rel=0.02)
    assert image[distance_px < 10].sum() == pytest.approx(encircled(9.9), abs=2e-3)


def test_all_but_the_stated_light_is_in_the_image():
    # The square contains the disc of its radius, beyond which LEFT_OUT_RATIO falls.
    point = wavefront(np.zeros(28), 4.0, scale=0.5 * np.eye(2))
    image = point.image()
    assert 1.0 - LEFT_OUT_RATIO < image.sum() < 1.0
    radius_px = len(image) // 2
    assert radius_px == pytest.approx(point.edge_light_px(LEFT_OUT_RATIO), abs=2.0)


def aberrated(diameter_mm):
    zernike_um = np.zeros(28)
    zernike_um[[3, 4, 6, 7, 8, 12]] = [0.1, 0.35, 0.05, -0.12, 0.08, 0.1]
    ellipse = np.array([0.04, -0.06, 0.94, 0.84, 0.4])
    scale = np.array([[1.1, 0.05], [0.1, 0.95]])
    return wavefront(zernike_um, diameter_mm, ellipse=ellipse, scale=scale)


def fft_image(point, radius_px, *, window_px=48, per_px=16, supersampled=4):
    """The same image by one FFT of the pupil, its edge averaged over the samples."""
    count = window_px * per_px
    step = point.wavelength_nm / 1e3 / window_px
    at = step * (np.arange(count) - count // 2)  # q
    half = math.ceil(0.65 * point.circle_diameter_mm / step)
    near = slice(count // 2 - half, count // 2 + half)
    grid = np.stack(np.meshgrid(at[near], at[near]), axis=-1)
    center, axes = point.pupil_ellipse[:2], point.pupil_ellipse[2:4]
    turn = point.pupil_ellipse[4]
    rotation = np.array(
        [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
    )
    into_pupil = point.pixel_from_mrad.T  # u = J^T q, mm
    fine = step * ((np.arange(supersampled) + 0.5) / supersampled - 0.5)
    inside = np.zeros(grid.shape[:2])
    for dx in fine:
        for dy in fine:
            u = (grid + np.array([dx, dy])) @ into_pupil.T - center
            inside += (((u @ rotation.T) / axes) ** 2).sum(axis=-1) <= 1.0
    u = grid @ into_pupil.T / (point.circle_diameter_mm / 2.0)
    is_inside = inside > 0.0
    path_um = np.zeros(inside.shape)
    path_um[is_inside] = zernike_values(*u[is_inside].T) @ point.zernike_um
    field = np.zeros((count, count), complex)
    phase = 2.0 * math.pi * 1e3 / point.wavelength_nm * path_um
    field[near, near] = inside * np.exp(1j * phase)
    spectrum = scipy.fft.fft2(scipy.fft.ifftshift(field))
    intensity = spectrum.real**2 + spectrum.imag**2
    # The integral over a pixel multiplies the transfer function by sinc.
    sinc = np.sinc(scipy.fft.fftfreq(count, 1.0 / per_px))
    blur = scipy.fft.rfft2(intensity) * sinc[: count // 2 + 1] * sinc[:, None]
    pixels = scipy.fft.irfft2(blur, s=(count, count))[::per_px, ::per_px]
    pixels = scipy.fft.fftshift(pixels) / pixels.sum()
    middle = window_px // 2
    part = slice(middle - radius_px, middle + radius_px + 1)
    return pixels[part, part][::-1]  # rows grow downward


def test_an_aberrated_image_equals_that_of_a_plain_fft():
    point = aberrated(2.0)
    image = point.image(max_radius_px=12)
    other = fft_image(point, 12)
    # Light beyond its window, 0.3 %, returns in the FFT.
    assert np.abs(image - other).sum() / 2.0 < 3e-3
    assert np.abs(image - other).max() < 1e-3


def test_light_far_from_the_spot_is_that_of_the_quadrature():
    point = aberrated(4.0)
    core_px = math.ceil(point.spot_px() + point.edge_light_px(4e-3)) + 1
    radius_px = core_px + 3
    exact = reference_kernel(
        point.zernike_um,
        pupil_diameter_mm=point.circle_diameter_mm,
        pupil_ellipse=point.pupil_ellipse,
        wavelength_nm=point.wavelength_nm,
        pixel_from_mrad=point.pixel_from_mrad,
        radius_px=radius_px,
    )
    edge = point.edge_light(radius_px)
    is_far = np.ones(edge.shape, bool)
    is_far[3:-3, 3:-3] = False
    assert edge[is_far].sum() == pytest.approx(exact[is_far].sum(), rel=0.03)
    difference = np.abs(edge - exact)[is_far].sum()
    assert difference < 0.2 * exact[is_far].sum()


def test_a_shift_moves_the_image_by_the_local_scale():
    point = aberrated(3.0)
    shift_mrad = np.linalg.solve(point.pixel_from_mrad, [2.0, -1.0])  # right and down
    still, moved = (
        one.image(max_radius_px=14) for one in (point, point.shifted(shift_mrad))
    )
    np.testing.assert_allclose(moved[3:-3, 5:-1], still[2:-4, 3:-3], atol=1e-12)
