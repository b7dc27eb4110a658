"""The renderer against closed forms, true convolution and layered truths."""

import math

import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.special import j1

from estimator.optics.units import RGB_WAVELENGTHS_NM
from estimator.optics.zernike import zernike_gradient
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile, preset_names
from estimator.psf.compute import compute_psfs
from tests.numerical.synthetic import Bench, psnr_db, texture

SIZE = {"width_px": 160, "height_px": 120}
NARROW = {**SIZE, "vertical_fov_deg": 8.0}
EMMETROPE = {"kind": "prescription", "sphere_dpt": 0.0}
MYOPE = {"kind": "prescription", "sphere_dpt": -6.0}
TENTH_ORDER = {
    "kind": "zernike",
    "pupil_diameter_mm": 5.0,
    "wavelength_nm": 555.0,
    "zernike_um": {"4,0": 0.1, "7,3": 0.2, "8,-4": 0.1, "9,-9": -0.1, "10,2": 0.15},
}
PURE = {"diffraction": False, "chromatic": False}


def exact_kernels(eye, bench, *, d, f=0.0, pupil=5.0, radius_px=24):
    """Kernels (size, size, 3) of the exact state, wide enough for all their light."""
    wavelengths_nm = (
        RGB_WAVELENGTHS_NM if bench.spec.settings.chromatic else (555.0,) * 3
    )
    states = [
        eye.state(pupil_diameter_mm=pupil, object_dpt=d, focus_dpt=f, wavelength_nm=w)
        for w in wavelengths_nm
    ]
    psfs = compute_psfs(
        np.array([s.zernike_um for s in states]),
        pupil_diameter_mm=pupil,
        wavelength_nm=np.array(wavelengths_nm),
        pixel_pitch_mrad=bench.spec.pixel_pitch_mrad,
        radius_px=radius_px,
    )
    return np.stack([p.kernel for p in psfs], axis=-1).astype(np.float64)


def convolve(image, kernels):
    channels = [
        fftconvolve(image[..., c].astype(float), kernels[..., c], mode="same")
        for c in range(3)
    ]
    return np.stack(channels, axis=-1)


@pytest.mark.parametrize(
    ("depth_m", "depth_kind", "focus_dpt"),
    [(np.inf, "planar", 0.0), (0.8, "radial", 1.25)],
)
def test_perfect_eye_gives_the_input_back_over_a_90_degree_field(
    engine, rng, depth_m, depth_kind, focus_dpt
):
    bench = Bench(engine, EMMETROPE, **SIZE, vertical_fov_deg=90.0, **PURE)
    image = texture(rng, 120, 160, cell_px=1)
    result = bench.render(bench.view(image, depth_m, depth_kind), focus_dpt=focus_dpt)
    assert psnr_db(result.color, image) >= 60.0
    corner = (slice(0, 16), slice(0, 16))
    assert psnr_db(result.color[corner], image[corner]) >= 60.0


def airy_kernel(*, pupil_mm, wavelength_nm, pitch_mrad, radius_px):
    """Airy pattern (2 J1(x)/x)² integrated over pixels by Gauss-Legendre."""
    order = 40  # several rings cross a pixel
    nodes, weights = np.polynomial.legendre.leggauss(order)
    centers = np.arange(-radius_px, radius_px + 1)
    points = (centers[:, None] + nodes / 2).ravel() * pitch_mrad
    weight = np.tile(weights / 2, len(centers)) * pitch_mrad
    theta_rad = np.hypot(points[:, None], points[None]) * 1e-3
    scale = math.pi * pupil_mm * 1e6 / wavelength_nm
    x = np.maximum(scale * theta_rad, 1e-12)
    # normalized to unit volume: pi (D / 2 lambda)² at the center, per rad²
    peak = math.pi * (pupil_mm * 1e6 / (2 * wavelength_nm)) ** 2 * 1e-6
    density = peak * (2 * j1(x) / x) ** 2
    cells = (density * weight[:, None] * weight[None]).reshape(
        len(centers), order, len(centers), order
    )
    return cells.sum(axis=(1, 3))


@pytest.mark.parametrize("pupil_mm", [2.0, 4.0])
def test_diffraction_alone_is_the_pixel_integrated_airy_disc(engine, rng, pupil_mm):
    bench = Bench(engine, EMMETROPE, **NARROW, chromatic=False)
    image = texture(rng, 120, 160, cell_px=2)
    result = bench.render(bench.view(image, np.inf), pupil_diameter_mm=pupil_mm)
    kernel = airy_kernel(
        pupil_mm=pupil_mm,
        wavelength_nm=555.0,
        pitch_mrad=bench.spec.pixel_pitch_mrad[0],
        radius_px=20,
    )
    kernel /= kernel.sum()
    truth = convolve(image, np.repeat(kernel[..., None], 3, axis=2))
    inside = slice(20, -20)
    assert psnr_db(result.color[inside, inside], truth[inside, inside]) >= 50.0


@pytest.mark.parametrize("name", preset_names())
def test_uniform_image_stays_uniform_for_every_preset(engine, name):
    bench = Bench(
        engine, {"kind": "preset", "name": name}, **SIZE, vertical_fov_deg=50.0
    )
    color = np.array([0.8, 0.4, 0.1], np.float32)
    image = np.broadcast_to(color, (120, 160, 3)).copy()
    depth_m = np.where(np.arange(160) < 80, 0.3, 6.0)[None, :]
    for accumulation in ("coverage", "paper"):
        result = bench.render(bench.view(image, depth_m), accumulation=accumulation)
        assert np.abs(result.color - color).max() < 1e-3


SKEWED = {
    "kind": "zernike",
    "pupil_diameter_mm": 5.0,
    "wavelength_nm": 555.0,
    "zernike_um": {"2,-2": 0.8, "2,0": 0.5, "3,-1": 0.35, "3,1": -0.5, "3,3": 0.2},
}


def bright_pixel(engine, profile, **spec):
    bench = Bench(engine, profile, **{**NARROW, **spec})
    image = np.zeros((120, 160, 3), np.float32)
    image[60, 80] = 1.0
    result = bench.render(bench.view(image, np.inf), merge=False)
    return bench, result.color.astype(np.float64)


def test_one_bright_pixel_is_the_psf_with_its_sum_and_centroid(engine):
    # Small pixels, for binning a caustic into large ones moves its centroid by 0.07 px;
    # no diffraction, for where its tails are cut moves it by 0.02 px.
    bench, answer = bright_pixel(
        engine, SKEWED, vertical_fov_deg=3.0, diffraction=False
    )
    eye = MeasuredWavefront.from_profile(parse_profile(SKEWED))
    y, x = np.mgrid[0:120, 0:160]
    for channel, wavelength_nm in enumerate(RGB_WAVELENGTHS_NM):
        spot = answer[..., channel]
        assert spot.sum() == pytest.approx(1.0, abs=1e-3)
        state = eye.state(
            pupil_diameter_mm=5.0,
            object_dpt=0.0,
            focus_dpt=0.0,
            wavelength_nm=wavelength_nm,
        )
        # The centroid of a PSF is the mean slope of its wavefront over the pupil.
        rho = np.sqrt((np.arange(200) + 0.5) / 200)
        angle = 2 * np.pi * np.arange(64) / 64
        px, py = np.outer(rho, np.cos(angle)), np.outer(rho, np.sin(angle))
        slope_mrad = (zernike_gradient(px, py) @ state.zernike_um).mean(
            axis=(0, 1)
        ) / 2.5
        expected_x = 80 + slope_mrad[0] / bench.spec.pixel_pitch_mrad[0]
        expected_y = 60 - slope_mrad[1] / bench.spec.pixel_pitch_mrad[1]
        assert (spot * x).sum() == pytest.approx(expected_x, abs=0.02)
        assert (spot * y).sum() == pytest.approx(expected_y, abs=0.02)


def test_bright_pixel_is_neither_rotated_nor_mirrored(engine):
    """Coma and oblique astigmatism tell all eight orientations apart."""
    bench, answer = bright_pixel(engine, SKEWED)
    eye = MeasuredWavefront.from_profile(parse_profile(SKEWED))
    truth = exact_kernels(eye, bench, d=0.0, radius_px=30)
    spot = answer[30:91, 50:111]
    errors = {
        (turns, flip): np.square(
            np.rot90(truth[:, ::flip], turns, axes=(0, 1)) - spot
        ).sum()
        for turns in range(4)
        for flip in (1, -1)
    }
    right = errors.pop((0, 1))
    assert right < 1e-3 * np.square(truth).sum()
    assert min(errors.values()) > 100 * right


@pytest.mark.parametrize("object_dpt", [0.25, 1.0, 2.6])
def test_plane_through_a_myope_is_true_convolution(engine, rng, object_dpt):
    bench = Bench(engine, MYOPE, **NARROW)
    eye = MeasuredWavefront.from_profile(parse_profile(MYOPE))
    image = texture(rng, 120, 160)
    view = bench.view(image, 1.0 / object_dpt, "radial")
    result = bench.render(view, merge=False)
    truth = convolve(image, exact_kernels(eye, bench, d=object_dpt))
    inside = slice(32, -32)
    assert psnr_db(result.color[inside, inside], truth[inside, inside]) >= 60.0


def test_plane_through_a_wavefront_of_tenth_order_is_true_convolution(engine, rng):
    bench = Bench(engine, TENTH_ORDER, **NARROW)
    profile = parse_profile(TENTH_ORDER)
    image = texture(rng, 120, 160, cell_px=2)
    seen = bench.render(bench.view(image, np.inf), merge=False).color
    inside = slice(32, -32)

    def agreement_db(profile):
        eye = MeasuredWavefront.from_profile(profile)
        truth = convolve(image, exact_kernels(eye, bench, d=0.0))
        return psnr_db(seen[inside, inside], truth[inside, inside])

    assert agreement_db(profile) >= 60.0
    sixth_order = {k: v for k, v in TENTH_ORDER["zernike_um"].items() if k[0] == "4"}
    other = parse_profile(TENTH_ORDER | {"zernike_um": sixth_order})
    assert agreement_db(other) < 45.0


@pytest.mark.long("the exact PSFs of 160 distances")
def test_slanted_plane_is_the_normalized_gather(engine, rng):
    bench = Bench(engine, MYOPE, **NARROW)
    eye = MeasuredWavefront.from_profile(parse_profile(MYOPE))
    # blur 0.1 px per px across the image: d from 0.5 dpt on
    px_per_dpt = bench.spec.blur_px_per_dpt(5.0)
    slope_dpt = 0.1 / px_per_dpt
    distance_dpt = 0.5 + slope_dpt * np.arange(160)
    image = texture(rng, 120, 160)
    view = bench.view(image, 1.0 / distance_dpt[None, :], "radial")
    result = bench.render(view, merge=False)
    light, weight = np.zeros((120, 160, 3)), np.zeros((120, 160, 3))
    for column in range(160):
        kernels = exact_kernels(eye, bench, d=distance_dpt[column])
        radius = kernels.shape[0] // 2
        for c in range(3):
            spread = [
                fftconvolve(values, kernels[..., c], mode="full")[radius : radius + 120]
                for values in (image[:, [column], c].astype(float), np.ones((120, 1)))
            ]
            first, last = max(column - radius, 0), min(column + radius + 1, 160)
            part = slice(first - column + radius, last - column + radius)
            light[:, first:last, c] += spread[0][:, part]
            weight[:, first:last, c] += spread[1][:, part]
    truth = light / weight
    inside = (slice(24, -24), slice(32, -32))
    assert bench.blur_px().max(axis=1).min() >= 1.0
    assert psnr_db(result.color[inside], truth[inside]) >= 50.0


def test_two_planes_of_equal_color_stay_flat_across_their_edge(engine):
    bench = Bench(engine, MYOPE, **NARROW)
    image = np.full((120, 160, 3), 0.5, np.float32)
    depth_m = np.where(np.arange(160) < 80, 0.4, 4.0)[None, :]
    result = bench.render(bench.view(image, depth_m))
    assert np.abs(result.color - 0.5).max() < 1e-3


def two_layer_truth(near, far, alpha, near_kernels, far_kernels):
    """Both layers whole, blurred apart, near over far by blurred coverage."""
    coverage = convolve(alpha, near_kernels)
    return convolve(near * alpha, near_kernels) + (1 - coverage) * convolve(
        far, far_kernels
    )


def edge_scene(engine, rng, *, focus_dpt, near_dpt, far_dpt):
    bench = Bench(engine, EMMETROPE, **NARROW, chromatic=False)
    eye = MeasuredWavefront.from_profile(parse_profile(EMMETROPE))
    near = texture(rng, 120, 160, cell_px=8) * 0.5 + 0.5
    far = texture(rng, 120, 160, cell_px=8) * 0.5
    alpha = np.broadcast_to((np.arange(160) < 80)[None, :, None], (120, 160, 3))
    alpha = alpha.astype(np.float64)
    image = np.where(alpha > 0, near, far).astype(np.float32)
    depth_m = np.where(alpha[..., 0] > 0, 1.0 / near_dpt, 1.0 / far_dpt)
    view = bench.view(image, depth_m, "radial")
    result = bench.render(view, focus_dpt=focus_dpt)
    kernels = [exact_kernels(eye, bench, d=d, f=focus_dpt) for d in (near_dpt, far_dpt)]
    truth = two_layer_truth(near, far, alpha, *kernels)
    inside = slice(24, -24)
    return (result.color - truth)[inside, inside]


def test_sharp_near_plane_over_a_blurred_far_one(engine, rng):
    error = edge_scene(engine, rng, focus_dpt=2.5, near_dpt=2.5, far_dpt=0.5)
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.abs(error).max() < 0.06


def test_blurred_near_plane_over_a_sharp_far_one_is_bounded(engine, rng):
    """One layer lacks what the near edge hides: the bound is the measured limit."""
    error = edge_scene(engine, rng, focus_dpt=0.5, near_dpt=2.5, far_dpt=0.5)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert np.abs(error).max() < 0.5
