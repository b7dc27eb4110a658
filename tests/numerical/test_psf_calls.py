"""What `compute_psfs` promises about batches, refusals and wrong arguments."""

import pickle

import numpy as np
import pytest

from estimator.optics.zernike import padded_terms
from estimator.psf.compute import PsfTooLarge, compute_psfs
from tests.numerical.psf_cases import case_zernike_um

PITCH_MRAD = 1.295


def test_batches_equal_single_calls_in_order():
    cases = ("emmetropia", 2.0), ("periph40", 6.0), ("keratoconus", 4.0)
    zernike_um = np.stack([case_zernike_um(*case) for case in cases])
    pupil_mm, wavelength_nm = np.array([2.0, 6.0, 4.0]), np.array([464.0, 549.0, 612.0])
    batch = compute_psfs(
        zernike_um,
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=PITCH_MRAD,
        workers=2,
    )
    assert {psf.method for psf in batch} >= {"fourier", "geometric"}
    for i, psf in enumerate(batch):
        single = compute_psfs(
            zernike_um[i : i + 1],
            pupil_diameter_mm=pupil_mm[i],
            wavelength_nm=wavelength_nm[i],
            pixel_pitch_mrad=PITCH_MRAD,
        )[0]
        assert psf.method == single.method
        np.testing.assert_array_equal(psf.kernel, single.kernel)


@pytest.mark.parametrize(
    "method", ["fourier", "geometric", pytest.param("enz", marks=pytest.mark.slow)]
)
def test_terms_of_zero_change_nothing(method):
    zernike_um = case_zernike_um("emmetropia", 2.0)[None]
    options = {"pupil_diameter_mm": 2.0, "wavelength_nm": 549.0, "radius_px": 6}
    options |= {"pixel_pitch_mrad": PITCH_MRAD, "method": method}
    (given,) = compute_psfs(zernike_um, **options)
    (longer,) = compute_psfs(padded_terms(zernike_um, 66), **options)
    assert longer.kernel == pytest.approx(given.kernel, abs=1e-6)
    other_um = padded_terms(zernike_um, 66).copy()
    other_um[0, 60] = 0.03
    (other,) = compute_psfs(other_um, **options)
    assert np.abs(other.kernel - given.kernel).sum() > 0.01


def test_a_psf_beyond_the_allowed_radius_is_refused_with_the_numbers():
    zernike_um = np.stack([np.zeros(28), case_zernike_um("periph40", 7.0)])
    with pytest.raises(
        PsfTooLarge, match=r"PSF 1 needs a radius of \d+ px.*24 px"
    ) as e:
        compute_psfs(
            zernike_um,
            pupil_diameter_mm=7.0,
            wavelength_nm=550.0,
            pixel_pitch_mrad=PITCH_MRAD,
            max_radius_px=24,
        )
    assert e.value.index == 1
    assert e.value.radius_px > 24
    assert pickle.loads(pickle.dumps(e.value)).radius_px == e.value.radius_px


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"zernike_um": np.zeros((2, 27))},
            r"zernike_um has shape \(2, 27\): must be \(P, n\), n one of 28, 36, 4",
        ),
        ({"zernike_um": np.zeros((2, 78))}, r"zernike_um has shape \(2, 78\)"),
        ({"zernike_um": np.full((1, 28), np.nan)}, "NaN"),
        ({"pupil_diameter_mm": 0.0}, "pupil_diameter_mm 0.0"),
        ({"wavelength_nm": [550.0, 450.0, 650.0]}, "wavelength_nm has shape"),
        ({"pixel_pitch_mrad": -1.0}, "pixel_pitch_mrad -1.0"),
        ({"method": "exact"}, "method 'exact'"),
        ({"method": "enz", "diffraction": False}, "includes diffraction"),
        ({"method": "enz", "enz_degree": 500}, "enz_degree 500: must be 0 to 120"),
        ({"pixel_pitch_mrad": None}, "either pixel_pitch_mrad or pixel_from_mrad"),
        ({"pixel_from_mrad": np.eye(2)}, "either pixel_pitch_mrad or pixel_from_mrad"),
        (
            {"pixel_pitch_mrad": None, "pixel_from_mrad": -np.diag([1.0, -1.0])},
            "positive determinant",
        ),
        (
            {"pixel_pitch_mrad": None, "pixel_from_mrad": np.eye(3)},
            "pixel_from_mrad has shape",
        ),
        ({"pupil_ellipse": np.ones(4)}, "pupil_ellipse has shape"),
        ({"pupil_ellipse": [0.0, 0.0, 1.5, 0.0, 0.0]}, "semi-axes must be positive"),
        ({"pupil_ellipse": [0.3, 0.0, 1.9, 1.5, 0.0]}, "reaches 1.100 radii"),
        ({"accuracy": "best"}, "accuracy 'best'"),
        ({"radius_px": -1}, "radius_px -1"),
        ({"method": "fourier", "diffraction": False}, "includes diffraction"),
        ({"min_energy_ratio": 1.0}, "min_energy_ratio 1.0"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    arguments = {
        "zernike_um": np.zeros((1, 28)),
        "pupil_diameter_mm": 4.0,
        "wavelength_nm": 550.0,
        "pixel_pitch_mrad": PITCH_MRAD,
    } | change
    with pytest.raises(ValueError, match=message):
        compute_psfs(arguments.pop("zernike_um"), **arguments)
