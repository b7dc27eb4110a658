"""A colour channel's band of wavelengths against a dense spectral average."""

import math

import numpy as np
import pytest

from estimator.chromatic import chromatic_refraction_dpt
from estimator.psf import compute_psf_batch
from estimator.psf_channel import (
    band_wavelengths,
    channel_psf_batch,
    with_longitudinal_colour,
)
from tests.numerical.psf_cases import (
    case_zernike_um,
    filter_psnr_db,
    make_test_image,
)

CENTRE_NM = 549.0
PITCH_MRAD = 1.295
RADIUS_PX = 16


@pytest.mark.parametrize("count", [1, 2, 3, 5, 15])
def test_wavelengths_integrate_polynomials_over_the_triangle(count):
    """Moments of 1 - |t|: 2 / ((k + 1) (k + 2)) for even k, 0 for odd."""
    wavelengths_nm, weights = band_wavelengths(CENTRE_NM, count, width_nm=80.0)
    t = (wavelengths_nm - CENTRE_NM) / 80.0
    assert np.all(np.diff(t) > 0.0)
    assert np.all(np.abs(t) < 1.0)
    for k in range(2 * count):
        expected = 0.0 if k % 2 else 2.0 / ((k + 1) * (k + 2))
        assert weights @ t**k == pytest.approx(expected, abs=1e-14)


def test_defocus_follows_the_eyes_chromatic_refraction():
    found = with_longitudinal_colour(
        np.zeros((1, 28)),
        pupil_diameter_mm=5.0,
        wavelength_nm=CENTRE_NM,
        wavelengths_nm=[CENTRE_NM, 450.0],
    )
    assert not found[0, 0].any()
    # Blue light is focused in front: myopic, M = -4 sqrt(3) C20 / r².
    m_dpt = -4.0 * math.sqrt(3.0) * found[0, 1, 4] / 2.5**2
    expected = chromatic_refraction_dpt(450.0) - chromatic_refraction_dpt(CENTRE_NM)
    assert m_dpt == pytest.approx(expected)
    assert m_dpt < -0.5


def _channel(zernike_um, pupil_mm, wavelengths_nm, weights, **options):
    options = {"pixel_pitch_mrad": PITCH_MRAD, "radius_px": RADIUS_PX} | options
    return channel_psf_batch(
        with_longitudinal_colour(
            zernike_um[None],
            pupil_diameter_mm=pupil_mm,
            wavelength_nm=CENTRE_NM,
            wavelengths_nm=wavelengths_nm,
        ),
        pupil_diameter_mm=pupil_mm,
        wavelengths_nm=wavelengths_nm,
        weights=weights,
        **options,
    )[0]


@pytest.mark.parametrize(
    ("case", "pupil_mm", "one_db"),
    [("emmetropia", 7.0, 50.0), ("astig3D", 4.0, 56.0)],
)
def test_a_few_wavelengths_are_as_good_as_a_dense_spectrum(case, pupil_mm, one_db):
    zernike_um, image = case_zernike_um(case, pupil_mm), make_test_image()
    wavelengths_nm = CENTRE_NM + np.arange(-79.0, 80.0, 2.0)
    triangle = 1.0 - np.abs(wavelengths_nm - CENTRE_NM) / 80.0
    options = {"method": "fourier", "accuracy": "fine"}
    dense = _channel(zernike_um, pupil_mm, wavelengths_nm, triangle, **options)
    psnr_db = [
        filter_psnr_db(
            image,
            _channel(
                zernike_um, pupil_mm, *band_wavelengths(CENTRE_NM, count), **options
            ).kernel.astype(np.float64),
            dense.kernel.astype(np.float64),
        )
        for count in (1, 3, 5)
    ]
    # One wavelength misses 50 dB for a large pupil in focus; three do not.
    assert psnr_db[0] < one_db
    assert psnr_db[1] > psnr_db[0] + 8.0
    assert psnr_db[1] >= 54.0
    assert psnr_db[2] >= 60.0


def test_the_mean_is_that_of_the_kernels_by_their_light():
    zernike_um = case_zernike_um("keratoconus", 4.0)
    wavelengths_nm, weights = band_wavelengths(CENTRE_NM, 3)
    wavefronts = with_longitudinal_colour(
        zernike_um[None],
        pupil_diameter_mm=4.0,
        wavelength_nm=CENTRE_NM,
        wavelengths_nm=wavelengths_nm,
    )
    ellipse = np.array([0.05, 0.0, 1.9, 1.6, 0.3])
    options = {
        "pupil_diameter_mm": 4.0,
        "pupil_ellipse": ellipse,
        "pixel_from_mrad": np.diag([0.7, 0.9]),
    }
    each = compute_psf_batch(wavefronts[0], wavelength_nm=wavelengths_nm, **options)
    mean = channel_psf_batch(
        np.repeat(wavefronts, 2, axis=0),
        wavelengths_nm=wavelengths_nm,
        weights=weights,
        **options,
    )
    assert len(mean) == 2
    radius = int(each.radius_px.max())
    expected = np.zeros((2 * radius + 1,) * 2)
    for psf, weight in zip(each, weights, strict=True):
        kept = weight * (1.0 - psf.lost_energy_ratio)
        expected += kept * np.pad(psf.kernel.astype(np.float64), radius - psf.radius_px)
    assert mean[1].lost_energy_ratio == pytest.approx(1.0 - expected.sum(), abs=1e-6)
    expected /= expected.sum()
    for psf in mean:
        np.testing.assert_allclose(psf.kernel, expected, atol=1e-7)


def test_wrong_bands_are_named():
    with pytest.raises(ValueError, match="count 0"):
        band_wavelengths(CENTRE_NM, 0)
    with pytest.raises(ValueError, match=r"width_nm 400\.0"):
        band_wavelengths(CENTRE_NM, 3, width_nm=400.0)
    common = {"pupil_diameter_mm": 3.0, "pixel_pitch_mrad": 1.0}
    with pytest.raises(ValueError, match=r"must be \(P, 2, 28\)"):
        channel_psf_batch(
            np.zeros((1, 3, 28)), wavelengths_nm=[500, 550], weights=[1, 1], **common
        )
    with pytest.raises(ValueError, match="one positive number per wavelength"):
        channel_psf_batch(
            np.zeros((1, 2, 28)), wavelengths_nm=[500, 550], weights=[1, 0], **common
        )
