"""Transfer functions and acuity against closed forms and published laws."""

import numpy as np
import pytest

from estimator.acuity import mean_eye_transfer, optical_transfer, predict_acuity
from estimator.acuity.sensitivity import contrast_sensitivity, perfect_transfer
from estimator.optics.zernike import rescale_pupil
from estimator.profiles.typical_aberrations import (
    TYPICAL_PUPIL_MM,
    typical_zernike_um,
)

CPD = np.array([1.0, 3.0, 10.0, 20.0, 40.0])
NONE_UM = np.zeros(28)


def typical(pupil_mm, defocus_dpt=0.0):
    ratio = pupil_mm / TYPICAL_PUPIL_MM
    zernike_um = rescale_pupil(
        typical_zernike_um(None, eye_side="OD"), radius_ratio=ratio
    )
    zernike_um[4] += defocus_dpt * (pupil_mm / 2) ** 2 / (4.0 * np.sqrt(3.0))
    return zernike_um


@pytest.mark.parametrize("pupil_mm", [2.0, 4.0, 7.0])
@pytest.mark.parametrize("wavelength_nm", [450.0, 555.0, 640.0])
def test_a_perfect_pupil_has_its_transfer_in_closed_form(pupil_mm, wavelength_nm):
    found = optical_transfer(
        NONE_UM, zernike_radius_mm=pupil_mm / 2, wavelength_nm=wavelength_nm
    )
    expected = perfect_transfer(
        CPD, pupil_diameter_mm=pupil_mm, wavelength_nm=wavelength_nm
    )
    assert found.modulation(CPD) == pytest.approx(expected, abs=0.006)
    assert np.abs(found.transfer_ratio.imag).max() < 1e-12


def test_large_defocus_has_the_transfer_of_a_disc():
    """Geometric: 2 J1(pi d f) / (pi d f), disc of diameter d = pupil x defocus."""
    from scipy.special import j1

    pupil_mm, defocus_dpt = 4.0, 3.0
    zernike_um = np.zeros(28)
    zernike_um[4] = defocus_dpt * (pupil_mm / 2) ** 2 / (4.0 * np.sqrt(3.0))
    found = optical_transfer(
        zernike_um, zernike_radius_mm=pupil_mm / 2, wavelength_nm=555.0
    )
    at_cpd = np.array([0.5, 1.0, 1.5, 2.0])
    disc_deg = np.degrees(pupil_mm * defocus_dpt / 1e3)
    x = np.pi * disc_deg * at_cpd
    assert found.in_phase(at_cpd) == pytest.approx(2.0 * j1(x) / x, abs=0.03)


def test_an_ellipse_is_a_narrower_pupil_across():
    ellipse = np.array([0.0, 0.0, 2.0, 1.0, np.pi / 2])  # upright
    found = optical_transfer(
        NONE_UM, zernike_radius_mm=2.0, wavelength_nm=555.0, pupil_ellipse=ellipse
    )
    middle = found.frequency_cpd.size // 2
    across = np.interp(CPD, found.frequency_cpd, found.transfer_ratio[middle].real)
    expected = perfect_transfer(CPD, pupil_diameter_mm=2.0, wavelength_nm=555.0)
    assert across == pytest.approx(expected, abs=0.01)


def test_sensitivity_is_that_of_the_standard_observer():
    """Peak 2 to 5 cpd at some 200, lost at 45 to 55 cpd (ModelFest, 30 cd/m2)."""
    cpd = np.linspace(0.5, 60.0, 1191)
    found = contrast_sensitivity(cpd)
    assert 2.0 < cpd[np.argmax(found)] < 5.0
    assert 150.0 < found.max() < 250.0
    assert 45.0 < cpd[np.flatnonzero(found < 1.0)[0]] < 55.0


def test_the_mean_eye_falls_with_the_pupil_below_the_perfect_one():
    for pupil_mm in (4.0, 6.0):
        mean = mean_eye_transfer(CPD, pupil_diameter_mm=pupil_mm)
        perfect = perfect_transfer(CPD, pupil_diameter_mm=pupil_mm, wavelength_nm=555.0)
        assert np.all(mean < perfect + 1e-12)
    wide, narrow = (mean_eye_transfer(10.0, pupil_diameter_mm=d) for d in (6.0, 3.0))
    assert wide < 0.5 * narrow


@pytest.mark.parametrize("pupil_mm", [2.0, 4.0, 6.0])
def test_people_in_focus_read_what_young_adults_do(pupil_mm):
    """Best corrected -0.13 to -0.16 logMAR, +-0.06 (Elliott et al. 1995)."""
    found = predict_acuity(typical(pupil_mm, 0.1), zernike_radius_mm=pupil_mm / 2)
    assert found.log_mar == pytest.approx(-0.15, abs=0.12)


@pytest.mark.parametrize("pupil_mm", [2.0, 3.0, 4.0, 6.0])
@pytest.mark.parametrize("defocus_dpt", [1.0, 2.0, 3.0, 4.0])
def test_out_of_focus_acuity_follows_pupil_times_defocus(pupil_mm, defocus_dpt):
    """Smith 1991: the smallest angle is linear in pupil x defocus.

    The constant, 0.65 minutes of arc per mm and dpt, is as later papers cite it.
    """
    found = predict_acuity(
        typical(pupil_mm, defocus_dpt), zernike_radius_mm=pupil_mm / 2
    )
    law = np.log10(0.65 * pupil_mm * defocus_dpt)
    assert found.log_mar == pytest.approx(law, abs=0.22)


def test_acuity_and_strehl_ratio_fall_with_defocus():
    found = [
        predict_acuity(typical(4.0, d), zernike_radius_mm=2.0)
        for d in (0.25, 0.5, 1.0, 2.0, 4.0)
    ]
    assert np.all(np.diff([a.log_mar for a in found]) > 0.0)
    assert np.all(np.diff([a.visual_strehl_ratio for a in found]) < 0.0)


def test_a_perfect_eye_has_a_ratio_of_one_and_tilt_does_not_matter():
    perfect = predict_acuity(NONE_UM, zernike_radius_mm=1.5)
    assert perfect.visual_strehl_ratio == pytest.approx(1.0)
    tilted = typical(5.0)
    tilted[1:3] = [3.0, -2.0]
    assert predict_acuity(tilted, zernike_radius_mm=2.5) == predict_acuity(
        typical(5.0), zernike_radius_mm=2.5
    )


def test_a_wavefront_too_steep_is_refused():
    steep = np.zeros(28)
    steep[4] = 200.0
    with pytest.raises(ValueError, match="up to"):
        predict_acuity(steep, zernike_radius_mm=3.0)
