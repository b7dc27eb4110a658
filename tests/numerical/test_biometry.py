"""Lengths and powers of eyes, against published schematic eyes and closed forms."""

import pytest

from estimator.estimate.biometry import eye_biometry
from estimator.profiles.parse import parse_profile

PSEUDOPHAKIC = {
    "kind": "pseudophakic",
    "axial_length_mm": 23.6,
    "keratometry_dpt": [42.5, 43.75],
    "keratometry_axis_deg": 175,
    "acd_mm": 3.1,
    "lens_thickness_mm": 4.6,
    "implant": {"power_dpt": 21},
}


def test_an_eye_by_its_biometry_has_that_biometry():
    found = eye_biometry(parse_profile(PSEUDOPHAKIC).surfaces.relaxed)
    assert found.axial_length_mm == pytest.approx(23.6)
    assert found.keratometry_dpt == pytest.approx((42.5 + 43.75) / 2.0)
    assert found.chamber_depth_mm == pytest.approx(3.1 + 0.39 * 4.6 - 0.4)
    assert found.lens_thickness_mm == pytest.approx(0.8)
    # labeled in an aqueous of 1.336; ours has another index at 555 nm
    assert found.lens_power_dpt == pytest.approx(21.0, abs=0.5)


def test_the_schematic_eye_of_gullstrand_and_le_grand():
    """Le Grand & El Hage, Physiological Optics, 1980: 24.20 mm, R 7.8 mm, 21.78 dpt."""
    body = {"kind": "published", "name": "le_grand_relaxed"}
    found = eye_biometry(parse_profile(body).surfaces.relaxed)
    assert found.axial_length_mm == pytest.approx(24.2, abs=0.01)
    assert found.keratometry_dpt == pytest.approx(337.5 / 7.8)
    assert found.chamber_depth_mm == pytest.approx(3.6)
    assert found.lens_thickness_mm == pytest.approx(4.0)
    assert found.lens_power_dpt == pytest.approx(21.78, abs=0.05)


def test_eyes_with_other_surfaces_are_refused():
    body = {"kind": "published", "name": "bennett_rabbetts"}
    with pytest.raises(ValueError, match="surfaces; expected 4: cornea and lens"):
        eye_biometry(parse_profile(body).surfaces.relaxed)
