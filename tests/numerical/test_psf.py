"""PSFs of both engines against closed forms, invariants and the float64 reference."""

import math

import numpy as np
import pytest

from estimator.optics.zernike import flip_horizontal, index_from_nm, nm_from_index
from estimator.psf.compute import (
    compute_psfs,
)
from estimator.psf.kernel_types import disc_mask
from tests.numerical.psf_cases import (
    DENSITIES_MRAD,
    case_zernike_um,
    compared_radius_px,
    configurations,
    filter_psnr_db,
    kernel_errors,
    make_test_image,
    physical_kernel,
    truth,
    zernike_from_terms,
)
from tests.reference.psf_integral import reference_kernel

PITCH_MRAD = 1.295
MIXED = {"2,-2": 0.4, "2,0": 1.1, "3,-1": -0.5, "3,1": 0.3, "3,3": 0.2, "4,0": 0.15}


def one_psf(zernike_um, *, pupil_mm=4.0, wavelength_nm=550.0, **options):
    options.setdefault("pixel_pitch_mrad", PITCH_MRAD)
    return compute_psfs(
        np.asarray(zernike_um)[None],
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        **options,
    )[0]


def defocus_um(vergence_dpt, pupil_mm):
    return {"2,0": vergence_dpt * (pupil_mm / 2.0) ** 2 / (4.0 * math.sqrt(3.0))}


def centroid_px(kernel):
    """Center of mass (x right, y up), px."""
    offset = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    kernel = kernel.astype(np.float64)
    return (kernel.sum(0) @ offset, -(kernel.sum(1) @ offset))


def turn_zernike(zernike_um, angle_deg):
    """Rotate the wavefront anticlockwise."""
    turned = np.array(zernike_um, dtype=float)
    for j in range(1, 28):
        n, m = nm_from_index(j)
        if m <= 0:
            continue
        cos, sin = (f(m * math.radians(angle_deg)) for f in (math.cos, math.sin))
        minus = index_from_nm(n, -m)
        turned[j] = cos * zernike_um[j] - sin * zernike_um[minus]
        turned[minus] = sin * zernike_um[j] + cos * zernike_um[minus]
    return turned


@pytest.mark.parametrize("method", ["fourier", "geometric"])
@pytest.mark.parametrize("terms", [{}, MIXED, {"2,0": 1e-9}, {"4,0": 0.3}])
def test_kernels_are_finite_with_unit_sum_inside_the_disc(method, terms):
    psf = one_psf(zernike_from_terms(terms), method=method)
    assert psf.kernel.dtype == np.float32
    assert psf.kernel.shape == (2 * psf.radius_px + 1,) * 2
    assert np.isfinite(psf.kernel).all()
    # float32 sum of about 3,000 values.
    assert abs(psf.kernel.sum(dtype=np.float64) - 1.0) < 2e-6
    assert not psf.kernel[~disc_mask(psf.radius_px)].any()
    assert 0.0 <= psf.lost_energy_ratio <= 1e-3
    assert psf.method == method


@pytest.mark.parametrize("pupil_mm", [2.0, 3.0, 5.0, 7.0])
def test_perfect_eye_gives_the_airy_disc_integrated_over_pixels(pupil_mm):
    psf = one_psf(np.zeros(28), pupil_mm=pupil_mm)
    reference = reference_kernel(
        np.zeros(28),
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=550.0,
        pixel_pitch_mrad=PITCH_MRAD,
        radius_px=5,
    )
    l2, energy = kernel_errors(physical_kernel(psf, 5), reference)
    assert l2 < 1e-2
    assert abs(energy) < 2e-3


def test_chosen_radius_holds_the_promised_energy_of_the_airy_disc():
    """Encircled energy 1 - J0² - J1² at the chosen radius, and one radius less."""
    for pupil_mm, kept in ((2.0, 0.999), (5.0, 0.999), (5.0, 0.99)):
        psf = one_psf(np.zeros(28), pupil_mm=pupil_mm, min_energy_ratio=kept)
        # Mean over the rings that the square pixels blur: 2 / (pi v) outside v.
        v = math.pi * pupil_mm / 0.55 * (psf.radius_px + 0.5) * PITCH_MRAD
        assert psf.lost_energy_ratio == pytest.approx(2.0 / (math.pi * v), rel=1e-3)
        assert psf.lost_energy_ratio <= 1.0 - kept
        v_less = math.pi * pupil_mm / 0.55 * (psf.radius_px - 0.5) * PITCH_MRAD
        assert 2.0 / (math.pi * v_less) > 1.0 - kept


def test_lost_energy_agrees_with_the_reference_summed_over_the_disc():
    zernike_um = case_zernike_um("keratoconus", 3.0)
    psf = one_psf(zernike_um, pupil_mm=3.0, min_energy_ratio=0.998)
    reference = reference_kernel(
        zernike_um,
        pupil_diameter_mm=3.0,
        wavelength_nm=550.0,
        pixel_pitch_mrad=PITCH_MRAD,
        radius_px=psf.radius_px,
    )
    outside = 1.0 - reference[disc_mask(psf.radius_px)].sum()
    # The formula leaves the rings' ripple out: a few per cent of the little it is.
    assert psf.lost_energy_ratio == pytest.approx(outside, rel=0.1)


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_tilt_moves_the_kernel_to_its_slope_right_and_up(method):
    tilt = zernike_from_terms({"1,1": 2.59, "1,-1": 1.295})  # 2 C / R mrad, R = 2
    psf = one_psf(tilt, method=method)
    x, y = centroid_px(psf.kernel)
    # The disc around the chief ray cuts the tail unevenly: 1e-3 of it, at 20 px.
    assert (x, y) == pytest.approx((2.0, 1.0), abs=0.02)
    row, column = np.unravel_index(psf.kernel.argmax(), psf.kernel.shape)
    assert (row, column) == (psf.radius_px - 1, psf.radius_px + 2)


def test_pure_defocus_without_diffraction_is_a_uniform_disc():
    """Blur radius pupil radius x vergence (mrad for mm and dpt), uniform inside."""
    pupil_mm, vergence_dpt = 4.0, 5.0
    psf = one_psf(
        zernike_from_terms(defocus_um(vergence_dpt, pupil_mm)),
        pupil_mm=pupil_mm,
        diffraction=False,
    )
    radius_px = pupil_mm / 2.0 * vergence_dpt / PITCH_MRAD
    assert psf.blur_radius_px == pytest.approx(radius_px, rel=1e-6)
    offset = np.arange(-psf.radius_px, psf.radius_px + 1)
    distance = np.hypot(offset, offset[:, None])
    inside = psf.kernel[distance < radius_px - 1.5]
    np.testing.assert_allclose(inside, 1.0 / (math.pi * radius_px**2), rtol=0.02)
    assert not psf.kernel[distance > radius_px + 1.5].any()
    # Second moment of a disc (r²/4 per axis) plus the pixel's 1/12.
    variance = (psf.kernel.sum(0, dtype=np.float64) * offset**2).sum()
    assert variance == pytest.approx(radius_px**2 / 4.0 + 1.0 / 12.0, rel=5e-3)


@pytest.mark.parametrize("vergence_dpt", [-0.5, -0.05, -1e-6, 0.0, 1e-6, 0.05, 0.5])
def test_ray_optics_stays_right_through_zero_defocus(vergence_dpt):
    psf = one_psf(
        zernike_from_terms(defocus_um(vergence_dpt, 4.0)),
        diffraction=False,
        radius_px=3,
    )
    radius_px = 2.0 * abs(vergence_dpt) / PITCH_MRAD
    offset = np.arange(-3, 4)
    # Light that lies within half a pixel of the axis stays in the central row.
    if radius_px <= 0.5:
        assert psf.kernel[3, 3] == 1.0
    variance = (psf.kernel.sum(0, dtype=np.float64) * offset**2).sum()
    assert variance <= radius_px**2 / 4.0 + 0.25
    np.testing.assert_allclose(psf.kernel, psf.kernel.T, atol=1e-6)
    assert centroid_px(psf.kernel) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_perfect_eye_without_diffraction_is_exactly_one_pixel():
    psf = one_psf(np.zeros(28), diffraction=False)
    assert psf.kernel[psf.radius_px, psf.radius_px] == 1.0
    assert psf.kernel.sum() == 1.0


def test_line_focus_of_an_astigmatic_eye_is_one_column_of_pixels():
    """One meridian in focus: all light on a line, with a half circle's density."""
    cylinder = 3.0
    zernike_um = np.zeros(28)
    zernike_um[index_from_nm(2, 0)] = 1.5 * 4.0 / (4.0 * math.sqrt(3.0))
    zernike_um[index_from_nm(2, 2)] = -1.5 * 4.0 / (2.0 * math.sqrt(6.0))
    psf = one_psf(zernike_um, diffraction=False)
    profile = psf.kernel.sum(axis=1, dtype=np.float64)
    np.testing.assert_allclose(profile, psf.kernel[:, psf.radius_px], atol=1e-9)
    offset = np.arange(-psf.radius_px, psf.radius_px + 1)
    length = cylinder * 2.0 / PITCH_MRAD
    edges = np.clip(np.stack([offset - 0.5, offset + 0.5]) / length, -1.0, 1.0)
    low, high = 0.5 + (edges * np.sqrt(1 - edges**2) + np.arcsin(edges)) / math.pi
    np.testing.assert_allclose(profile, high - low, atol=4e-3)


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_turning_the_wavefront_turns_the_kernel(method):
    zernike_um = zernike_from_terms(MIXED)
    kernel = one_psf(zernike_um, method=method, radius_px=16).kernel
    turned = one_psf(turn_zernike(zernike_um, 90.0), method=method, radius_px=16).kernel
    # float32 FFT and splat sums.
    np.testing.assert_allclose(
        turned, np.rot90(kernel), atol=2e-5 * kernel.max() + 1e-7
    )


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_mirroring_the_wavefront_mirrors_the_kernel(method):
    zernike_um = zernike_from_terms(MIXED)
    kernel = one_psf(zernike_um, method=method, radius_px=16).kernel
    mirrored = one_psf(flip_horizontal(zernike_um), method=method, radius_px=16).kernel
    np.testing.assert_allclose(
        mirrored, kernel[:, ::-1], atol=2e-5 * kernel.max() + 1e-7
    )


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_sign_of_defocus_matters_beside_spherical_aberration(method):
    plus, minus = (
        one_psf(
            zernike_from_terms({**defocus_um(sign, 5.0), "4,0": 0.15}),
            pupil_mm=5.0,
            method=method,
            radius_px=12,
        ).kernel
        for sign in (1.0, -1.0)
    )
    assert np.linalg.norm(plus - minus) > 0.5 * np.linalg.norm(plus)


def test_oblong_pixels_equal_the_reference():
    zernike_um = case_zernike_um("keratoconus", 3.0)
    pitch = (1.5, 1.0)
    psf = one_psf(zernike_um, pupil_mm=3.0, pixel_pitch_mrad=pitch, accuracy="fine")
    reference = reference_kernel(
        zernike_um,
        pupil_diameter_mm=3.0,
        wavelength_nm=550.0,
        pixel_pitch_mrad=pitch,
        radius_px=8,
    )
    l2, energy = kernel_errors(physical_kernel(psf, 8), reference)
    assert l2 < 1e-2
    assert abs(energy) < 2e-3


def _errors(name, pupil_mm, wavelength_nm, pitch_mrad, image, **options):
    zernike_um = case_zernike_um(name, pupil_mm)
    psf = one_psf(
        zernike_um,
        pupil_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pitch_mrad,
        **options,
    )
    radius = compared_radius_px(psf.blur_radius_px)
    reference = truth(name, pupil_mm, wavelength_nm, pitch_mrad, radius)
    kernel = physical_kernel(psf, radius)
    disc = disc_mask(radius)
    psnr_db = filter_psnr_db(image, kernel * disc, reference * disc)
    return *kernel_errors(kernel, reference), psnr_db


QUICK_CASES = [
    ("emmetropia", 3.0, 550.0, "20ppd"),
    ("emmetropia", 5.0, 650.0, "720p50"),
    ("emm_1D", 5.0, 450.0, "35ppd"),
    ("myopia4D", 3.0, 550.0, "720p50"),
    ("astig3D", 2.0, 650.0, "720p50"),
    ("astig3D", 3.0, 550.0, "35ppd"),
    ("keratoconus", 2.0, 550.0, "720p50"),
    ("keratoconus", 3.0, 550.0, "35ppd"),
    ("periph40", 2.0, 550.0, "20ppd"),
    ("periph40", 3.0, 550.0, "720p50"),
]


@pytest.fixture(scope="module")
def image():
    return make_test_image()


@pytest.mark.parametrize(("accuracy", "l2_limit"), [("normal", 3e-2), ("fine", 1e-2)])
@pytest.mark.parametrize("case", QUICK_CASES, ids=lambda c: "-".join(map(str, c)))
def test_wave_method_meets_its_accuracy(case, accuracy, l2_limit, image):
    name, pupil_mm, wavelength_nm, density = case
    l2, energy, psnr_db = _errors(
        name,
        pupil_mm,
        wavelength_nm,
        DENSITIES_MRAD[density],
        image,
        method="fourier",
        accuracy=accuracy,
    )
    assert l2 <= l2_limit
    assert abs(energy) <= 1e-2
    assert psnr_db >= 54.0


@pytest.mark.slow
@pytest.mark.parametrize(("accuracy", "l2_limit"), [("normal", 3e-2), ("fine", 1e-2)])
@pytest.mark.parametrize("density", DENSITIES_MRAD)
@pytest.mark.parametrize("case", configurations(), ids=lambda c: "-".join(map(str, c)))
def test_wave_method_meets_its_accuracy_everywhere(
    case, density, accuracy, l2_limit, image
):
    test_wave_method_meets_its_accuracy((*case, density), accuracy, l2_limit, image)


BY_RAYS = ("astig3D", "myopia4D")


@pytest.fixture(scope="module")
def errors_by_rays(image):
    return {
        name: _errors(name, 4.0, 450.0, PITCH_MRAD, image, method="auto")
        for name in BY_RAYS
    }


@pytest.mark.parametrize("name", BY_RAYS)
def test_geometric_method_holds_where_auto_uses_it(name, errors_by_rays):
    """Images to 50 dB; its kernels never converge in L2 (fringes at the rim)."""
    pupil_mm = 4.0
    _, energy, psnr_db = errors_by_rays[name]
    zernike_um = case_zernike_um(name, pupil_mm)
    assert one_psf(zernike_um, pupil_mm=pupil_mm, wavelength_nm=450.0).method == (
        "geometric"
    )
    assert abs(energy) <= 1e-2
    assert psnr_db >= 50.0


def test_methods_agree_across_the_switch(image):
    """n just at the threshold: both engines filter the image alike."""
    zernike_um = zernike_from_terms({**defocus_um(4.2, 5.0), "3,-1": 0.2})
    wave, rays = (
        one_psf(zernike_um, pupil_mm=5.0, method=method, radius_px=20).kernel.astype(
            np.float64
        )
        for method in ("fourier", "geometric")
    )
    assert filter_psnr_db(image, rays, wave) >= 50.0


def test_finer_grid_of_the_wave_method_has_smaller_error():
    errors = []
    reference = truth("keratoconus", 3.0, 550.0, PITCH_MRAD, 8)
    for accuracy in ("normal", "fine"):
        psf = one_psf(
            case_zernike_um("keratoconus", 3.0), pupil_mm=3.0, accuracy=accuracy
        )
        errors.append(kernel_errors(physical_kernel(psf, 8), reference)[0])
    assert errors[1] < 0.7 * errors[0]
