"""Pseudophakic eyes: formulas, axes, corneal aberrations and position of the lens."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from estimator import power_vector_from_zernike, prescription_from_power_vector
from estimator.estimate.model import eye_model
from estimator.optics.zernike import index_from_nm
from estimator.profiles.given_eyes import biconvex_radius_mm
from estimator.profiles.parse import ProfileError, parse_profile
from estimator.wavefront.aberrations import wavefront_aberrations
from tests.numerical.iol_formulas import FORMULAS

MEAN_MM, MEAN_DPT, MEAN_ACD_MM = 23.5, 43.5, 3.1
EYE = {
    "kind": "pseudophakic",
    "axial_length_mm": MEAN_MM,
    "keratometry_dpt": [MEAN_DPT, MEAN_DPT],
    "acd_mm": MEAN_ACD_MM,
    "lens_thickness_mm": 4.6,
    "implant": {"power_dpt": 21.0},
}
CENTER_MM = MEAN_ACD_MM + 0.39 * 4.6
ACD_SLOPE = 0.15
"""Deepening of the chamber with axial length: r = 0.45 (Haddad et al. 2019, 600 eyes)
times the ratio of the standard deviations, about 1/3."""


def refraction_dpt(length_mm, k_dpt, power_dpt, center_mm):
    body = {
        "kind": "pseudophakic",
        "axial_length_mm": length_mm,
        "keratometry_dpt": [k_dpt, k_dpt],
        "lens_center_mm": center_mm,
        "implant": {"power_dpt": power_dpt},
    }
    return eye_model(parse_profile(body)).refraction_dpt


@pytest.fixture(scope="module")
def mean_power_dpt():
    """The implant that makes the mean eye emmetropic."""
    return brentq(lambda p: refraction_dpt(MEAN_MM, MEAN_DPT, p, CENTER_MM), 5, 35)


@pytest.mark.parametrize("name", FORMULAS)
def test_refraction_agrees_with_a_formula_where_it_puts_the_lens(name, mean_power_dpt):
    """With the constant matched at the mean eye; 22 to 26 mm, 40 to 47 dpt."""
    power_dpt, position_mm = FORMULAS[name]
    own_mm = position_mm(MEAN_MM, MEAN_DPT, MEAN_ACD_MM)
    constant_mm = brentq(
        lambda c: power_dpt(MEAN_MM, MEAN_DPT, own_mm + c) - mean_power_dpt, -4.0, 8.0
    )
    for length_mm in (22.0, 23.0, 24.0, 25.0, 26.0):
        acd_mm = MEAN_ACD_MM + ACD_SLOPE * (length_mm - MEAN_MM)
        for k_dpt in (40.0, 42.0, MEAN_DPT, 45.0, 47.0):
            lens_mm = position_mm(length_mm, k_dpt, acd_mm)
            found_dpt = refraction_dpt(
                length_mm,
                k_dpt,
                power_dpt(length_mm, k_dpt, lens_mm + constant_mm),
                CENTER_MM + lens_mm - own_mm,
            )
            # Hoffer Q: -0.57 at 22 mm and 40 dpt, the flattest cornea of the grid
            is_corner = name == "Hoffer Q" and (length_mm, k_dpt) == (22.0, 40.0)
            assert abs(found_dpt) < (0.6 if is_corner else 0.5), (length_mm, k_dpt)


def test_the_power_on_the_label_is_that_of_the_thick_lens():
    for label_dpt in (-5.0, 6.0, 21.0, 34.0):
        radius_mm = biconvex_radius_mm(label_dpt, index=1.47, thickness_mm=0.8)
        surface_dpt = 1000.0 * (1.47 - 1.336) / radius_mm
        power_dpt = 2.0 * surface_dpt - surface_dpt**2 * 0.8e-3 / 1.47
        assert power_dpt == pytest.approx(label_dpt, abs=1e-9)
    assert biconvex_radius_mm(0.0, index=1.47, thickness_mm=0.8) == math.inf


@pytest.mark.parametrize("axis_deg", [180.0, 90.0, 30.0, 141.0])
def test_a_flat_meridian_is_the_axis_of_the_minus_cylinder(axis_deg):
    body = {**EYE, "keratometry_dpt": [42, 45], "keratometry_axis_deg": axis_deg}
    found = prescription_from_power_vector(
        *power_vector_from_zernike(
            parse_profile(body).zernike_um, zernike_radius_mm=2.0
        )
    )
    turned_deg = (found.axis_deg - axis_deg + 90.0) % 180.0 - 90.0  # 0 is 180
    assert turned_deg == pytest.approx(0.0, abs=0.01)
    assert found.cylinder_dpt == pytest.approx(-3.0, abs=0.15)


def test_aberrations_of_the_cornea_reach_the_eye():
    """Odd orders of the cornea alone: the centered implant adds none."""
    cornea = {"3,-1": 0.2, "3,3": -0.1, "5,1": 0.03, "4,0": 0.25}
    body = {**EYE, "cornea_zernike_um": cornea, "cornea_pupil_diameter_mm": 4.0}
    bare, found = (parse_profile(b).zernike_um for b in (EYE, body))
    for n, m, value_um in ((3, -1, 0.2), (3, 3, -0.1), (5, 1, 0.03)):
        j = index_from_nm(n, m)
        assert found[j] - bare[j] == pytest.approx(value_um, rel=0.02)
    mirrored = parse_profile({**body, "frame": "examiner"}).zernike_um
    j = index_from_nm(3, 3)
    assert mirrored[j] == pytest.approx(-found[j])


def test_a_lens_that_sits_deeper_makes_the_eye_more_hyperopic():
    """By the vergence of a thin lens, within the change of its principal planes."""
    first, second = (
        refraction_dpt(MEAN_MM, MEAN_DPT, 21.0, center_mm) for center_mm in (4.5, 5.0)
    )
    thin = []
    for lens_mm in (4.5, 5.0):
        behind = 1336.0 / (MEAN_MM - lens_mm) - 21.0
        thin.append(1336.0 / (1336.0 / behind + lens_mm))
    assert second - first == pytest.approx(thin[1] - thin[0], rel=0.05)


def test_tilt_and_decentration_add_coma_and_astigmatism():
    worst = {}
    for name, change in (
        ("centered", {}),
        ("tilted", {"tilt_deg": [0.0, 8.0]}),
        ("decentered", {"decentration_mm": [0.5, 0.0]}),
    ):
        body = {**EYE, "implant": {"power_dpt": 21.0, **change}}
        surfaces = parse_profile(body).surfaces.relaxed
        found = wavefront_aberrations(
            surfaces, wavelength_nm=555.0, pupil_diameter_mm=5.0
        )
        worst[name] = np.abs(found.zernike_um[[3, 5, 7, 8]]).max()
    assert worst["centered"] < 1e-6
    assert min(worst["tilted"], worst["decentered"]) > 0.03


def test_radii_describe_the_same_lens_as_the_power():
    radius_mm = biconvex_radius_mm(21.0, index=1.47, thickness_mm=0.8)
    radii = {"anterior_radius_mm": radius_mm, "posterior_radius_mm": -radius_mm}
    by_power, by_radii = (
        eye_model(parse_profile({**EYE, "implant": implant}))
        for implant in ({"power_dpt": 21.0}, radii)
    )
    assert by_radii.refraction_dpt == by_power.refraction_dpt


def test_a_diffractive_design_adds_its_foci():
    steps = {"kind": "iol", "design": "bifocal", "add_dpt": 3.0}
    eye = eye_model(parse_profile({**EYE, "correction": steps}))
    plain = eye_model(parse_profile(EYE))
    assert eye.profile.correction.rings is not None
    assert eye.refraction_dpt == pytest.approx(plain.refraction_dpt, abs=1e-9)
    assert eye.amplitude_dpt == plain.amplitude_dpt == 0.0


def test_the_reply_says_that_no_measured_wavefront_is_kept():
    (note,) = parse_profile(EYE).notes
    assert "traced through its implant" in note


@pytest.mark.parametrize("residual_dpt", [0.0, -2.5, 1.0])
@pytest.mark.parametrize(
    "biometry",
    [
        {},
        {"axial_length_mm": 27.5, "keratometry_dpt": [41, 42.5]}
        | {"keratometry_axis_deg": 20},
        {"axial_length_mm": 21.5, "cornea_zernike_um": {"4,0": 0.27}},
    ],
    ids=["mean", "long", "short"],
)
def test_the_power_is_solved_for_what_shall_remain(biometry, residual_dpt):
    """By another way to trace: through the pupil of the eye, on another circle."""
    body = {**EYE, **biometry, "implant": {"residual_dpt": residual_dpt}}
    profile = parse_profile(body)
    found = wavefront_aberrations(
        profile.surfaces.relaxed, wavelength_nm=555.0, pupil_diameter_mm=4.0
    )
    m_dpt, _, _ = power_vector_from_zernike(
        found.zernike_um, zernike_radius_mm=found.zernike_radius_mm
    )
    assert m_dpt == pytest.approx(residual_dpt, abs=0.03)
    (note,) = [n for n in profile.notes if n.code == "implant"]
    by_power = {**body, "implant": {"power_dpt": note.values["power_dpt"]}}
    assert parse_profile(by_power).digest == profile.digest


@pytest.mark.parametrize(
    ("implant", "said"),
    [
        ({"residual_dpt": 0, "power_dpt": 21}, "cannot be combined with power_dpt"),
        ({"residual_dpt": 0, "anterior_radius_mm": 9}, "needs|combined"),
    ],
)
def test_a_solved_power_excludes_others(implant, said):
    with pytest.raises(ProfileError, match=said):
        parse_profile({**EYE, "implant": implant})


def test_a_power_that_no_implant_has_is_refused():
    body = {**EYE, "axial_length_mm": 17, "implant": {"residual_dpt": -10}}
    with pytest.raises(ProfileError, match="needs an implant of another power"):
        parse_profile(body)
