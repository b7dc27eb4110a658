"""Profiles as typed bodies: errors message by message, schema, numbers of NumPy."""

import json
from types import MappingProxyType

import numpy as np
import pytest

from estimator.profiles import bodies
from estimator.profiles.parse import ProfileError, parse_profile
from tests.source_tree import ROOT

WRONG = json.loads(
    (ROOT / "tests" / "data" / "wrong_profiles.json").read_text(encoding="utf-8")
)["profiles"]


@pytest.mark.parametrize("row", WRONG, ids=range(len(WRONG)))
def test_a_wrong_profile_names_field_value_and_what_is_allowed(row):
    with pytest.raises(ProfileError) as caught:
        parse_profile(row["profile"])
    error = caught.value
    found = {"field": error.field, "problem": error.problem, "allowed": error.allowed}
    assert found == {name: row[name] for name in found}


@pytest.mark.parametrize("number", [np.float64(-2), np.float32(-2), np.int64(-2)])
def test_numbers_of_numpy_and_read_only_mappings_are_accepted(number):
    body = MappingProxyType({"kind": "prescription", "sphere_dpt": number})
    expected = parse_profile({"kind": "prescription", "sphere_dpt": -2})
    assert np.array_equal(parse_profile(body).zernike_um, expected.zernike_um)


@pytest.mark.parametrize("number", [10**9000, -(10**30), 2**70], ids=range(3))
def test_an_integer_that_no_float_holds_is_refused(number):
    with pytest.raises(ProfileError) as caught:
        parse_profile({"kind": "prescription", "sphere_dpt": number})
    assert caught.value.field == "sphere_dpt"


def test_keys_that_are_not_text_are_refused():
    for body in ({1: 2, "kind": "preset"}, {"kind": "zernike", "zernike_um": {2: 1}}):
        with pytest.raises(ProfileError):
            parse_profile(body)


def test_every_preset_is_a_body_of_its_kind():
    for name, body in bodies.PRESETS.items():
        assert parse_profile(body).kind == "zernike"
        assert parse_profile({"kind": "preset", "name": name}).name == name
