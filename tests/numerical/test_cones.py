"""Cone fundamentals and color-matching functions, compared with other programs.

`tests/data/cone_references.json` contains values of colour-science 0.4.7, and of the
program of CIE TC 1-97 for other ages and field sizes.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from estimator.color import (
    color_matching,
    cone_fundamentals,
    lms_weights,
    xyz_weights,
)

REFERENCES = json.loads(
    (Path(__file__).parents[1] / "data" / "cone_references.json").read_text()
)
AT_NM = np.array(REFERENCES["wavelengths_nm"])
COLOUR = {k: np.array(v) for k, v in REFERENCES["colour_science"].items()}


@pytest.mark.parametrize("size_deg", [2, 10])
def test_standard_functions_equal_those_of_colour_science(size_deg):
    lms = cone_fundamentals(AT_NM, field_size_deg=size_deg)
    np.testing.assert_allclose(lms, COLOUR[f"lms_{size_deg}deg"], rtol=0, atol=1e-6)
    xyz = color_matching(AT_NM, observer="cie_2006", field_size_deg=size_deg)
    expected = COLOUR[f"xyz_2006_{size_deg}deg"]
    np.testing.assert_allclose(xyz, expected, rtol=0, atol=1e-6)


def test_the_observer_of_1931_equals_that_of_colour_science():
    expected = COLOUR["xyz_1931"]
    np.testing.assert_allclose(color_matching(AT_NM), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("case", REFERENCES["tc_1_97"], ids=str)
def test_other_ages_and_sizes_agree_with_the_program_of_the_cie(case):
    # It uses the formula alone, from which the published tables differ by 2.6e-4.
    found = cone_fundamentals(
        AT_NM, age_years=case["age_years"], field_size_deg=case["field_size_deg"]
    )
    np.testing.assert_allclose(found, case["lms"], rtol=0, atol=4e-4)
    standard = cone_fundamentals(AT_NM)
    assert np.abs(standard - case["lms"]).max() > 0.02  # age and size matter


def test_integrals_of_a_spectrum_equal_those_of_colour_science():
    d65 = REFERENCES["d65"]
    power = np.array(d65["power"])
    xyz = power @ xyz_weights(AT_NM)
    np.testing.assert_allclose(xyz, d65["xyz_1931"], rtol=1e-6)
    lms = power @ lms_weights(AT_NM)
    np.testing.assert_allclose(lms, d65["lms_2deg"], rtol=1e-6)


def test_the_lens_of_an_older_eye_absorbs_blue():
    bands_nm = np.arange(400, 701, 10)
    young, old = (
        lms_weights(bands_nm, age_years=age_years).T @ (bands_nm < 480)
        for age_years in (20.0, 80.0)
    )
    assert np.all(young > old)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: cone_fundamentals([500.0], age_years=19.0), "age_years 19.0"),
        (lambda: lms_weights([500, 600], age_years=81.0), "age_years 81.0"),
        (lambda: lms_weights([500, 600], field_size_deg=11.0), "field_size_deg 11.0"),
        (lambda: lms_weights([600, 500]), "ascending"),
        (lambda: lms_weights([500.0]), "at least 2"),
        (lambda: color_matching([500.0], observer="cie_1964"), "cie_1931, cie_2006"),
        (lambda: color_matching([500.0], field_size_deg=10.0), "allowed is 2"),
    ],
)
def test_what_is_out_of_range_is_named(call, named):
    with pytest.raises(ValueError, match=named):
        call()
