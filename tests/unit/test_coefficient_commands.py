"""Coefficients in other orders on the command line, and those of the measurement."""

import json
import re

import numpy as np
import pytest

from estimator.optics.zernike_orders import zernike_to
from estimator.profiles.files import load_profile
from tests.commands import run_command

# 0.25 um of vertical coma, and defocus, as a paper may list them
PAPER = {
    "kind": "zernike",
    "frame": "examiner",
    "pupil_diameter_mm": 5,
    "wavelength_nm": 555,
    "zernike": {
        "order": "noll",
        "unit": "um",
        "values": [0, 0, 0, 0.5, 0, 0, 0.25, 0.1, 0, 0, 0.05],
    },
}
VIEW = ["--stop-mm", "4.4", "--wavelength-nm", "555"]


def printed(command, *arguments):
    ended = run_command(command, *arguments)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def facts():
    return json.loads(printed("wavefront", json.dumps(PAPER), *VIEW, "--json"))


def test_a_list_of_a_paper_is_one_argument_and_is_read_back_in_words():
    lines = printed("wavefront", json.dumps(PAPER), *VIEW, "--describe").splitlines()
    (note,) = [line for line in lines if line.startswith("note: coefficients by")]
    assert note == (
        "note: coefficients by Noll, normalized to RMS 1, in um, positive where light "
        "is ahead, x to the examiner's right, on a circle of 5 mm: +0.500 um Z(2,0): "
        "myopia, M -0.55 dpt; +0.250 um Z(3,-1), -0.100 um Z(3,1): the tail of the "
        "image of a point points up; +0.050 um Z(4,0): the edge of the pupil has more "
        "power than its center"
    )
    assert "  j  (n, m)        um      measured: 5 mm, 555 nm" in lines
    (coma,) = [line.split() for line in lines if line.startswith("  7  (3,-1)")]
    # on the traced circle of 4.95 mm, and as the paper has it
    assert 0.23 < float(coma[-2]) < 0.245
    assert coma[-1] == "+0.250000"
    assert any("the tail of the image of a point points up" in x for x in lines[-5:])


def test_json_has_the_measured_coefficients_and_nothing_else_new(facts):
    measured = facts["measured"]
    assert (measured["pupil_diameter_mm"], measured["wavelength_nm"]) == (5, 555)
    assert measured["zernike_um"][:9] == [0, 0, 0, 0, 0.5, 0, 0, 0.25, -0.1]
    assert {"convention", "terms", "values", "in_words"}.isdisjoint(facts)


@pytest.mark.parametrize("order", ["noll", "malacara", "nm"])
def test_a_csv_of_any_order_is_a_profile_of_the_same_wavefront(tmp_path, facts, order):
    how = ["--order", order, "--unit", "waves", "--frame", "examiner"]
    text = printed("wavefront", json.dumps(PAPER), *VIEW, *how, "--csv")
    path = tmp_path / "eye.csv"
    path.write_text(text, encoding="utf-8")
    profile = load_profile(path)
    difference_um = profile.zernike_um - facts["zernike_um"]
    assert np.abs(difference_um).max() < 1e-12
    assert profile.pupil_diameter_mm == 2 * facts["zernike_radius_mm"]


def test_json_in_another_order(facts):
    how = ["--order", "born-wolf", "--unit", "waves", "--normalization", "rms"]
    found = json.loads(
        printed("wavefront", json.dumps(PAPER), *VIEW, *how, "--json", "--describe")
    )
    assert found["convention"] == {
        "order": "born-wolf",
        "unit": "waves",
        "normalization": "rms",
        "frame": "eye",
    }
    expected = zernike_to(
        facts["zernike_um"],
        order="born-wolf",
        normalization="rms",
        unit="waves",
        wavelength_nm=555.0,
    )
    assert found["values"] == pytest.approx(expected, abs=1e-12)
    assert found["terms"] == [str(number) for number in range(1, 29)]
    assert found["measured_values"][8] == pytest.approx(0.25 / 0.555)
    assert found["in_words"][-1].startswith("+0.0")


def test_fringe_names_what_it_lacks_and_files_off_the_axis_are_no_profile(tmp_path):
    body = {**PAPER, "zernike_um": {"2,0": 0.5, "6,6": 0.02}}
    del body["zernike"]
    view = ["--pupil-mm", "5", "--wavelength-nm", "555", "--h-deg", "10"]
    ended = run_command(
        "wavefront", json.dumps(body), *view, "--order", "fringe", "--csv"
    )
    assert ended.returncode == 0, ended.stderr
    assert "note: order fringe lacks terms that are 0.0" in ended.stderr
    path = tmp_path / "eye.csv"
    path.write_text(ended.stdout, encoding="utf-8")
    with pytest.raises(ValueError, match="'h_deg' is not a setting"):
        load_profile(path)
    refused = run_command("wavefront", json.dumps(body), *view, "--csv", "--json")
    assert refused.returncode == 2
    assert "--csv, --json: allowed: one of them" in refused.stderr


def test_estimate_compares_the_measured_coefficients():
    lines = printed("estimate", json.dumps(PAPER)).splitlines()
    terms = re.findall(r"(Z\(\d,-?\d\)) (\S+) \((\S+)\)", lines[-2])
    assert lines[-2].startswith("measured on 5 mm, um (estimated eye): Z(2,0) ")
    assert {name: float(um) for name, um, _ in terms} == {
        "Z(2,0)": 0.5,
        "Z(3,-1)": 0.25,
        "Z(3,1)": -0.1,
        "Z(4,0)": 0.05,
    }
    assert all(abs(float(um) - float(fitted)) < 1e-3 for _, um, fitted in terms)
    assert "measured" not in printed(
        "estimate", '{"kind": "prescription", "sphere_dpt": -2}'
    )
