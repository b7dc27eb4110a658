"""PSFs away from the axis: elliptical pupil, local image scale, apodization."""

import math

import numpy as np
import pytest

from estimator.optics.pinhole import pixel_from_mrad
from estimator.psf.compute import compute_psfs
from estimator.psf.stiles_crawford import StilesCrawford
from tests.numerical.psf_cases import (
    Window,
    case_zernike_um,
    disc_mask,
    field_case,
    field_cases,
    filter_psnr_db,
    kernel_errors,
    make_test_image,
    physical_kernel,
    zernike_from_terms,
)
from tests.reference.psf_integral import reference_kernel

PITCH_MRAD = 1.295
SHEARED = np.array([[1.4, 0.3], [0.2, 1.1]]) / PITCH_MRAD
ELLIPSE = np.array([0.06, -0.04, 1.35, 1.0, 0.7])
MIXED = {"2,-2": 0.4, "2,0": 1.1, "3,-1": -0.5, "3,1": 0.3, "3,3": 0.2, "4,0": 0.15}


@pytest.fixture(scope="module")
def image():
    return make_test_image()


def one_psf(zernike_um, **options):
    options = {"pupil_diameter_mm": 3.0, "wavelength_nm": 550.0} | options
    return compute_psfs(np.asarray(zernike_um)[None], **options)[0]


def errors(zernike_um, options, image, *, is_kept=False, **engine):
    """L2, energy and filtered PSNR of a kernel against the float64 quadrature."""
    psf = compute_psfs(zernike_um[None], max_radius_px=1000, **options, **engine)[0]
    window = Window.of_spot(zernike_um, options)
    reference = (window.kept_reference if is_kept else window.reference)(
        zernike_um, options
    )
    kernel, disc = window.cut(psf), disc_mask(window.radius_px)
    return (
        *kernel_errors(kernel, reference),
        filter_psnr_db(image, kernel * disc, reference * disc),
    )


GEOMETRIES = {
    "sheared scale": {"pixel_from_mrad": SHEARED},
    "ellipse": {"pixel_pitch_mrad": PITCH_MRAD, "pupil_ellipse": ELLIPSE},
    "both, apodized": {
        "pixel_from_mrad": SHEARED,
        "pupil_ellipse": ELLIPSE,
        "stiles_crawford": StilesCrawford.of_eye("OD"),
    },
}


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("case", ["emmetropia", "astig3D", "keratoconus", "periph40"])
def test_wave_method_meets_its_accuracy_off_axis(geometry, case, image):
    options = GEOMETRIES[geometry] | {"pupil_diameter_mm": 3.0, "wavelength_nm": 550.0}
    zernike_um = case_zernike_um(case, 3.0)
    for accuracy, l2_limit in (("normal", 3e-2), ("fine", 1e-2)):
        l2, energy, psnr_db = errors(
            zernike_um, options, image, method="fourier", accuracy=accuracy
        )
        assert l2 <= l2_limit
        assert abs(energy) <= 1e-2
        assert psnr_db >= 54.0


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("case", ["astig3D", "myopia4D", "periph40"])
def test_geometric_method_holds_off_axis(geometry, case, image):
    options = GEOMETRIES[geometry] | {"pupil_diameter_mm": 3.0, "wavelength_nm": 550.0}
    _, energy, psnr_db = errors(
        case_zernike_um(case, 3.0), options, image, method="geometric"
    )
    assert abs(energy) <= 1e-2
    assert psnr_db >= 50.0


@pytest.mark.parametrize("method", ["fourier", "geometric", "enz"])
def test_the_whole_circle_as_an_ellipse_changes_nothing(method):
    zernike_um = zernike_from_terms({"2,0": 0.4, "3,1": 0.1})
    options = {"method": method, "radius_px": 12, "pixel_pitch_mrad": PITCH_MRAD}
    plain = one_psf(zernike_um, **options)
    ellipse = one_psf(zernike_um, pupil_ellipse=[0, 0, 1.5, 1.5, 0.4], **options)
    # The wavefront goes through other coordinates: float32 of the engines.
    limit = 3e-5 * plain.kernel.max()
    np.testing.assert_allclose(ellipse.kernel, plain.kernel, atol=limit)


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_a_diagonal_jacobian_is_the_pixel_pitch(method):
    zernike_um = zernike_from_terms(MIXED)
    by_pitch = one_psf(zernike_um, method=method, pixel_pitch_mrad=(1.5, 1.0))
    by_scale = one_psf(
        zernike_um, method=method, pixel_from_mrad=np.diag([1.0 / 1.5, 1.0])
    )
    assert by_pitch.radius_px == by_scale.radius_px
    np.testing.assert_array_equal(by_pitch.kernel, by_scale.kernel)


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_turning_pupil_wavefront_and_image_turns_the_kernel(method, image):
    """By 90 degrees, where pixels map to pixels: C(2,2) and C(3,1), C(3,-1) turn."""
    terms = {"2,0": 1.0, "2,2": 0.4, "3,1": 0.3, "3,-1": -0.2}
    turned = {"2,0": 1.0, "2,2": -0.4, "3,1": 0.2, "3,-1": 0.3}
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    options = {"method": method, "radius_px": 14, "accuracy": "fine"}
    kernel = one_psf(
        zernike_from_terms(terms),
        pixel_from_mrad=SHEARED,
        pupil_ellipse=ELLIPSE,
        **options,
    ).kernel
    x, y, *axes, angle = ELLIPSE
    other = one_psf(
        zernike_from_terms(turned),
        pixel_from_mrad=quarter @ SHEARED @ quarter.T,
        pupil_ellipse=[-y, x, *axes, angle + math.pi / 2.0],
        **options,
    ).kernel
    kernel = np.rot90(kernel).astype(np.float64)
    l2, _ = kernel_errors(other, kernel)
    # Grids lie along the image's axes: both engines' own errors, no more.
    assert l2 <= (1e-2 if method == "fourier" else 5e-2)
    assert filter_psnr_db(image, other, kernel) >= 60.0
    assert kernel_errors(np.rot90(other), kernel)[0] > 0.3


def test_light_of_an_ellipse_reaches_only_slopes_inside_it():
    """Defocus of 4 dpt on a pupil half as high as wide: the spot is that ellipse."""
    zernike_um = zernike_from_terms({"2,0": 4.0 * 1.5**2 / (4.0 * math.sqrt(3.0))})
    psf = one_psf(
        zernike_um,
        pixel_pitch_mrad=0.5,
        pupil_ellipse=[0.0, 0.0, 1.5, 0.75, 0.0],
        diffraction=False,
    )
    offset = np.arange(-psf.radius_px, psf.radius_px + 1) * 0.5 / 4.0
    reach = np.hypot(offset / 1.5, offset[:, None] / 0.75)
    inside = psf.kernel[reach < 0.88]
    np.testing.assert_allclose(inside, inside.mean(), rtol=0.05)
    assert not psf.kernel[reach > 1.3].any()


def test_a_perfect_eye_stays_sharp_in_the_corners():
    """A stretched kernel would blur there; the mapped one is sharper than at the axis.

    The pixel covers less angle in a corner, in units of the same Airy disc.
    """
    camera = {"tangents": (-0.83, 0.83, 0.4663, -0.4663), "size_px": (1280, 720)}
    corner = pixel_from_mrad(39.0, 20.0, **camera)
    for pupil_mm in (3.0, 6.0):
        options = {"pupil_diameter_mm": pupil_mm, "wavelength_nm": 550.0}
        psf = one_psf(np.zeros(28), pixel_from_mrad=corner, **options)
        reference = reference_kernel(
            np.zeros(28), radius_px=5, pixel_from_mrad=corner, **options
        )
        l2, _ = kernel_errors(physical_kernel(psf, 5), reference)
        assert l2 < 1e-2
        assert physical_kernel(psf, 1)[1, 1] == pytest.approx(reference[5, 5], rel=1e-2)
    exact = one_psf(np.zeros(28), pixel_from_mrad=corner, diffraction=False)
    assert exact.kernel[exact.radius_px, exact.radius_px] == 1.0


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_tilt_moves_the_kernel_by_the_jacobian(method):
    jacobian = np.array([[1.0, 0.5], [-0.5, 1.0]])
    # Slope 2 C / R: 4 mrad right and 2 up, so (5, 0) px.
    tilt = zernike_from_terms({"1,1": 3.0, "1,-1": 1.5})
    psf = one_psf(tilt, pixel_from_mrad=jacobian, method=method)
    offset = np.arange(-psf.radius_px, psf.radius_px + 1)
    kernel = psf.kernel.astype(np.float64)
    centroid = (kernel.sum(0) @ offset, -(kernel.sum(1) @ offset))
    assert centroid == pytest.approx((5.0, 0.0), abs=0.05)


REDUCED = [
    ("emmetropia", 0, 5.0, "720p50"),
    ("emmetropia", 20, 3.0, "35ppd"),
    ("emmetropia", 40, 2.0, "20ppd"),
    ("myopia", 20, 3.0, "720p50"),
    ("astigmatism", 0, 2.0, "20ppd"),
    ("keratoconus", 0, 3.0, "35ppd"),
    ("keratoconus", 20, 5.0, "720p50"),
    ("keratoconus", 40, 3.0, "720p50"),
    ("cataract", 0, 3.0, "720p50"),
    ("cataract", 20, 2.0, "20ppd"),
    ("post_lasik", 0, 3.0, "20ppd"),
    ("post_lasik", 40, 3.0, "720p50"),
]


@pytest.mark.parametrize("case", REDUCED, ids=lambda c: "-".join(map(str, c)))
def test_auto_filters_the_image_to_50_db(case, image):
    case = field_case(*case)
    _, energy, psnr_db = errors(case.zernike_um, case.options, image, method="auto")
    assert abs(energy) <= 1e-2
    assert psnr_db >= 50.0


@pytest.mark.parametrize("case", REDUCED, ids=lambda c: "-".join(map(str, c)))
def test_wave_method_alone_filters_the_image_to_54_db(case, image):
    density = case[-1]
    case = field_case(*case)
    l2, energy, psnr_db = errors(case.zernike_um, case.options, image, method="fourier")
    assert l2 <= (1.5e-2 if density == "720p50" else 3e-2)
    assert abs(energy) <= 1e-2
    assert psnr_db >= 54.0


@pytest.mark.slow
@pytest.mark.parametrize("case", field_cases(), ids=str)
def test_the_whole_field_at_all_pupils_meets_what_the_methods_promise(case, image):
    _, energy, psnr_db = errors(
        case.zernike_um, case.options, image, method="auto", is_kept=True
    )
    assert abs(energy) <= 1e-2
    assert psnr_db >= 50.0
    l2, energy, psnr_db = errors(
        case.zernike_um, case.options, image, method="fourier", is_kept=True
    )
    assert l2 <= (1.5e-2 if case.density == "720p50" else 3e-2)
    assert abs(energy) <= 1e-2
    assert psnr_db >= 54.0
