"""The ENZ series: its functions against closed forms, its domain, its kernels."""

import math

import numpy as np
import pytest
from scipy.special import eval_legendre, jv, roots_legendre, spherical_jn

from estimator.psf.compute import EnzOutsideDomain, compute_psf_batch, compute_psfs
from estimator.psf.enz_series import (
    NODE_COUNT,
    hankel_table,
    radial_nodes,
    radial_polynomial,
    zernike_betas,
)
from estimator.psf.tail import add_tail
from tests.numerical.psf_cases import (
    CASE_NAMES,
    case_zernike_um,
    compared_radius_px,
    disc_mask,
    field_case,
    filter_psnr_db,
    kernel_errors,
    make_test_image,
    physical_kernel,
    reference_kernel,
    truth,
    zernike_from_terms,
)

TERMS = [(0, 0), (2, 0), (1, 1), (3, -3), (4, 2), (9, 5), (30, 0), (30, 30), (29, 7)]
PITCH_MRAD = 1.295


def enz(zernike_um, *, pupil_mm=3.0, method="enz", **options):
    options = {"pixel_pitch_mrad": PITCH_MRAD, "wavelength_nm": 550.0} | options
    return compute_psfs(
        np.asarray(zernike_um)[None],
        pupil_diameter_mm=pupil_mm,
        method=method,
        **options,
    )[0]


def enz_function(n, m, r, defocus_rad):
    """V_n^|m|(r, f) (k,) by the quadrature of the series, r in lambda / radius."""
    r = np.atleast_1d(np.asarray(r, np.float64))
    rho, weight = radial_nodes(n, abs(defocus_rad), float(r.max(initial=0.0)))
    field = (
        weight * rho * np.exp(1j * defocus_rad * rho**2) * radial_polynomial(n, m, rho)
    )
    weighted = np.zeros((2, abs(m) + 1, rho.size))
    weighted[:, -1] = field.real, field.imag
    found = hankel_table(r, rho, weighted)
    return found[:, 0, -1] + 1j * found[:, 1, -1]


@pytest.mark.parametrize("n_orders", [1, 31, 124])
@pytest.mark.parametrize("largest", [0.0, 1e-10, 1e-3, 1.0, 60.0, 124.0, 130.0, 2e3])
def test_bessel_functions_are_those_of_scipy(rng, largest, n_orders):
    """Below, at and above the argument from which the recurrence goes upward."""
    r = np.append(rng.uniform(0.0, 1.0, 3), 1.0) * largest / (2.0 * math.pi)
    rho = np.append(np.sort(rng.uniform(1e-4, 1.0, NODE_COUNT - 1)), 1.0)
    each = np.broadcast_to(
        np.eye(NODE_COUNT)[:, None], (NODE_COUNT, n_orders, NODE_COUNT)
    )
    x = 2.0 * math.pi * r[:, None] * rho
    np.testing.assert_allclose(
        hankel_table(r, rho, each),
        jv(np.arange(n_orders), x[..., None]),
        atol=3e-13,
    )


@pytest.mark.parametrize(("n", "m"), TERMS)
def test_without_defocus_the_function_is_zernikes_bessel_image(n, m):
    """V_n^m(r, 0) = (-1)^((n-|m|)/2) J_(n+1)(2 pi r) / (2 pi r): Noll 1976."""
    r = np.array([0.01, 0.3, 1.0, 2.7, 6.0, 15.0, 120.0])
    v = 2.0 * math.pi * r
    expected = (-1) ** ((n - abs(m)) // 2) * jv(n + 1, v) / v
    np.testing.assert_allclose(enz_function(n, m, r, 0.0), expected, atol=1e-14)


@pytest.mark.parametrize("defocus_rad", [0.0, 1e-12, -1e-12, 2.5, -40.0])
@pytest.mark.parametrize(("n", "m"), TERMS)
def test_at_the_center_and_without_defocus_there_is_no_gap(n, m, defocus_rad):
    """Limits r -> 0 and f -> 0, where the published series is 0/0 and infinity."""
    near = enz_function(n, m, np.array([0.0, 1e-9, 1e-6]), defocus_rad)
    assert np.isfinite(near).all()
    np.testing.assert_allclose(near[0], near[1:], atol=1e-5)
    if m != 0:
        assert near[0] == 0.0
    if (n, m) == (0, 0):
        half = defocus_rad / 2.0
        closed = 0.5 * np.exp(1j * half) * np.sinc(half / math.pi)
        np.testing.assert_allclose(near[0], closed, atol=1e-14)


@pytest.mark.parametrize("defocus_rad", [-33.0, 3.0, 141.0])
def test_quadrature_equals_the_bessel_bessel_series(defocus_rad):
    """Bauer: exp(i f (2 rho² - 1) / 2) = sum (2k+1) i^k j_k(f/2) P_k(2 rho² - 1)."""
    r = np.array([0.4, 3.0, 9.0])
    half = defocus_rad / 2.0
    node, weight = roots_legendre(400)
    rho = (node + 1.0) / 2.0
    for n, m in ((0, 0), (4, 2), (9, 5)):
        zernike = weight / 2.0 * rho * radial_polynomial(n, m, rho)
        waves = jv(m, 2.0 * math.pi * np.outer(r, rho))
        total = np.zeros(r.size, complex)
        for k in range(math.ceil(abs(half)) + 40):
            ring = eval_legendre(k, 2.0 * rho**2 - 1.0) * zernike
            total += (2 * k + 1) * 1j**k * spherical_jn(k, half) * (waves @ ring)
        total *= np.exp(1j * half)
        np.testing.assert_allclose(
            enz_function(n, m, r, defocus_rad), total, atol=2e-13
        )


def test_the_sign_of_defocus_is_kept():
    r = np.linspace(0.0, 4.0, 9)
    plus, minus = (enz_function(4, 2, r, f) for f in (12.0, -12.0))
    np.testing.assert_allclose(plus, minus.conj(), atol=1e-14)
    both = (
        enz(zernike_from_terms({"2,0": sign * 0.4, "3,1": 0.1, "4,0": 0.08})).kernel
        for sign in (1, -1)
    )
    cut = [k[k.shape[0] // 2 - 5 :][:11, k.shape[0] // 2 - 5 :][:, :11] for k in both]
    assert np.linalg.norm(cut[0] - cut[1]) > 0.2 * np.linalg.norm(cut[0])


def test_betas_hold_the_energy_that_their_degree_can():
    zernike_um = zernike_from_terms({"3,1": 0.12, "3,-3": 0.1, "4,0": 0.05})
    held = []
    for degree in (4, 10, 20, 30):
        betas = zernike_betas(zernike_um, wavelength_um=0.55, degree=degree)
        held.append(sum(float((np.abs(b) ** 2).sum()) for b in betas.values()))
    assert held == sorted(held)
    assert held[0] < 0.9
    assert held[-1] == pytest.approx(1.0, abs=1e-6)


WITHIN = [
    ("emmetropia", 2.0, 650.0, "35ppd"),
    ("emmetropia", 3.0, 550.0, "20ppd"),
    ("emm_1D", 3.0, 550.0, "720p50"),
    ("myopia4D", 2.0, 550.0, "720p50"),
    ("astig3D", 2.0, 550.0, "35ppd"),
    ("keratoconus", 2.0, 550.0, "720p50"),
    ("keratoconus", 3.0, 650.0, "720p50"),
]


@pytest.mark.parametrize("case", WITHIN, ids=lambda c: "-".join(map(str, c)))
def test_inside_its_domain_the_series_equals_the_reference(case):
    name, pupil_mm, wavelength_nm, density = case
    pitch = {"720p50": 1.295, "20ppd": 0.873, "35ppd": 0.499}[density]
    psf = enz(
        case_zernike_um(name, pupil_mm),
        pupil_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pitch,
    )
    radius = compared_radius_px(psf.blur_radius_px)
    reference = truth(name, pupil_mm, wavelength_nm, pitch, radius)
    l2, energy = kernel_errors(physical_kernel(psf, radius), reference)
    assert psf.method == "enz"
    assert l2 <= 1e-2
    assert abs(energy) <= 2e-3


@pytest.mark.parametrize(
    "case", [("emmetropia", 20, 4.0), ("post_lasik", 40, 2.0), ("cataract", 0, 2.0)]
)
def test_off_axis_pupils_are_series_of_their_own_ellipse(case):
    case = field_case(*case, "720p50")
    psf = compute_psfs(case.zernike_um[None], method="enz", **case.options)[0]
    radius = compared_radius_px(psf.blur_radius_px)
    reference = reference_kernel(case.zernike_um, radius_px=radius, **case.options)
    assert kernel_errors(physical_kernel(psf, radius), reference)[0] <= 1e-2


@pytest.mark.parametrize("name", CASE_NAMES)
@pytest.mark.parametrize("pupil_mm", [2.0, 4.0])
def test_outside_its_domain_the_series_refuses_or_is_right(name, pupil_mm):
    """Never a wrong kernel: what is not refused filters like the wave method."""
    zernike_um = case_zernike_um(name, pupil_mm)
    try:
        psf = enz(zernike_um, pupil_mm=pupil_mm, radius_px=24)
    except EnzOutsideDomain as refusal:
        assert refusal.needed_degree_count > 20
        assert refusal.degree_count == 30
        assert "fourier or auto" in str(refusal)
        return
    wave = enz(
        zernike_um, pupil_mm=pupil_mm, method="fourier", accuracy="fine", radius_px=24
    )
    assert kernel_errors(psf.kernel, wave.kernel.astype(np.float64))[0] <= 3e-2


@pytest.mark.parametrize("name", ["keratoconus", "periph40", "astig3D"])
def test_strong_aberrations_are_refused_at_the_papers_degree(name):
    with pytest.raises(EnzOutsideDomain, match="PSF 1 is outside the domain"):
        compute_psf_batch(
            np.stack([np.zeros(28), case_zernike_um(name, 5.0)]),
            pupil_diameter_mm=5.0,
            wavelength_nm=550.0,
            pixel_pitch_mrad=PITCH_MRAD,
            method="enz",
        )


@pytest.mark.slow
def test_unchecked_kernels_show_what_the_check_prevents():
    zernike_um = case_zernike_um("keratoconus", 4.5)
    psf = enz(zernike_um, pupil_mm=4.5, method="enz_unchecked")
    assert psf.method == "enz_unchecked"
    radius = compared_radius_px(psf.blur_radius_px)
    reference = truth("keratoconus", 4.5, 550.0, PITCH_MRAD, radius)
    kernel, disc = physical_kernel(psf, radius), disc_mask(radius)
    psnr_db = filter_psnr_db(make_test_image(), kernel * disc, reference * disc)
    assert psnr_db < 35.0
    assert psf.lost_energy_ratio > 0.3 or kernel_errors(kernel, reference)[0] > 0.3


@pytest.mark.slow
def test_a_higher_degree_widens_the_domain():
    """Keratoconus at 4 mm needs more than degree 30; 60 holds it."""
    zernike_um = case_zernike_um("keratoconus", 4.0)
    with pytest.raises(EnzOutsideDomain):
        enz(zernike_um, pupil_mm=4.0)
    psf = enz(zernike_um, pupil_mm=4.0, enz_degree=60)
    radius = compared_radius_px(psf.blur_radius_px)
    reference = truth("keratoconus", 4.0, 550.0, PITCH_MRAD, radius)
    assert kernel_errors(physical_kernel(psf, radius), reference)[0] <= 2e-2


@pytest.mark.parametrize("window", [(-9, 8, -5, 7), (5, -40, -3, 3)])
def test_beyond_a_window_the_light_is_that_of_the_edge(window):
    """On a circle's axes, where samples of the edge are nearest and farthest."""
    radius, g_px, half_um, wavelength_um = 30, 6.0, 1.9, 0.55
    angle = 2.0 * math.pi * np.arange(48) / 48
    edge_px = g_px * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    kernel = np.full((2 * radius + 1,) * 2, -1.0, np.float32)
    add_tail(
        *(kernel, np.array(window), edge_px),
        *(np.full(2, half_um), 0.0, wavelength_um),
    )
    rho = np.arange(12, radius + 1)
    density = 1.0 / (rho - g_px) ** 2 + 1.0 / (rho + g_px) ** 2
    density *= wavelength_um / (4.0 * math.pi**3 * half_um * rho)
    for found in (
        kernel[radius, radius + 12 :],
        kernel[radius, radius - 12 :: -1],
        kernel[radius - 12 :: -1, radius],
        kernel[radius + 12 :, radius],
    ):
        np.testing.assert_allclose(found, density, rtol=1e-5)
    left, right, down, up = window
    y, x = np.mgrid[radius : -radius - 1 : -1, -radius : radius + 1]
    is_known = (x >= left) & (x <= right) & (y >= down) & (y <= up)
    np.testing.assert_array_equal(kernel >= 0.0, disc_mask(radius) & ~is_known)
