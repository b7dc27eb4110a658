"""PSFs by quadrature in the package against another quadrature and a closed form."""

import numpy as np
import pytest
from scipy.special import j0, j1

from estimator.psf.quadrature import MARGIN, quadrature_kernels
from estimator.psf.stiles_crawford import StilesCrawford
from tests.reference.psf_integral import reference_kernel

PUPIL_MM, NM, PITCH_MRAD = 3.0, 555.0, 0.8


def arguments(**given):
    return {
        "pupil_diameter_mm": np.array([PUPIL_MM]),
        "wavelength_nm": np.array([NM]),
        "pixel_from_mrad": np.eye(2)[None] / PITCH_MRAD,
        **given,
    }


def zernike_um(**terms):
    found = np.zeros((1, 28))
    for name, value in terms.items():
        found[0, int(name[1:])] = value
    return found


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"pupil_ellipse": np.array([[0.1, -0.05, 1.4, 1.1, 0.4]])},
        {"pixel_from_mrad": np.array([[[1.3, 0.2], [-0.1, 1.1]]])},
        {"stiles_crawford": StilesCrawford.of_eye("OD")},
    ],
    ids=["circle", "ellipse", "sheared pixels", "apodized"],
)
def test_kernels_equal_those_of_another_quadrature(given):
    um, radius = zernike_um(j4=0.4, j3=0.1, j7=-0.08, j12=0.05), 12
    own = arguments(**given)
    (found,) = quadrature_kernels(um, radius_px=np.array([radius]), **own)
    ellipse = own.get("pupil_ellipse")
    expected = reference_kernel(
        um[0],
        pupil_diameter_mm=PUPIL_MM,
        wavelength_nm=NM,
        radius_px=radius,
        pixel_from_mrad=own["pixel_from_mrad"][0],
        pupil_ellipse=None if ellipse is None else ellipse[0],
        stiles_crawford=own.get("stiles_crawford"),
    )
    np.testing.assert_allclose(found, expected, atol=1e-6 * expected.max())


def test_beyond_the_margin_kernels_have_the_light_of_an_airy_disc():
    margin_px = round(MARGIN * NM / 1e3 / PUPIL_MM / PITCH_MRAD)
    radius = 4 * margin_px
    (kernel,) = quadrature_kernels(
        zernike_um(), radius_px=np.array([radius]), **arguments()
    )
    at = np.arange(-radius, radius + 1)
    distance = np.hypot(*np.meshgrid(at, at))
    for ring in (margin_px // 2, margin_px, 2 * margin_px):
        x = np.pi * PUPIL_MM * (ring + 0.5) * PITCH_MRAD / (NM / 1e3)
        outside = j0(x) ** 2 + j1(x) ** 2  # Born & Wolf, 8.5.2
        found = 1.0 - kernel[distance <= ring + 0.5].sum()
        assert found == pytest.approx(outside, rel=0.06)
