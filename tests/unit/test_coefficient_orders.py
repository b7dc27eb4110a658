"""Profiles and files with coefficients in stated orders, normalizations and units."""

import json
import re

import numpy as np
import pytest

from estimator.optics.zernike_orders import (
    DEFAULT_NORMALIZATION,
    FIRST_INDEX,
    term_of,
    zernike_to,
)
from estimator.profiles.files import load_profile
from estimator.profiles.parse import ProfileError, parse_profile
from tests.source_tree import ROOT

TERMS_UM = {"2,0": 1.0, "2,2": 0.5, "2,-2": -0.5, "3,1": 0.6, "3,-1": 0.25}
PAGE = ROOT / "docs" / "how-to" / "measurements.md"
BODY = {"kind": "zernike", "pupil_diameter_mm": 6.0, "wavelength_nm": 555.0}
EXPECTED = parse_profile({**BODY, "zernike_um": TERMS_UM})
SETTINGS = "# pupil_diameter_mm: 6.0\n# wavelength_nm: 555\n"


def in_order(order, **how):
    values = zernike_to(EXPECTED.zernike_um[:10], order=order, **how)
    return values.tolist()


def loaded(tmp_path, text, suffix="csv"):
    path = tmp_path / f"eye.{suffix}"
    path.write_text(text, encoding="utf-8")
    return load_profile(path)


def assert_expected(found):
    assert np.abs(found.zernike_um - EXPECTED.zernike_um).max() < 1e-12
    assert found.pupil_diameter_mm == EXPECTED.pupil_diameter_mm


@pytest.mark.parametrize("order", FIRST_INDEX)
@pytest.mark.parametrize("frame", ["eye", "examiner"])
@pytest.mark.parametrize("eye_side", ["OD", "OS"])
def test_a_list_in_each_order_for_both_eyes_and_views(order, frame, eye_side):
    how = {"unit": "waves", "wavelength_nm": 555.0, "frame": frame}
    stated = {"order": order, "unit": "waves", "values": in_order(order, **how)}
    side = {"frame": frame, "eye_side": eye_side}
    found = parse_profile({**BODY, **side, "zernike": stated})
    assert_expected(found)
    assert found.eye_side == eye_side
    (note,) = found.notes
    assert note.code == "zernike_order"
    assert note.values == {"pupil_diameter_mm": 6.0, "wavelength_nm": 555.0}
    assert ("x to the examiner's right" in note) == (frame == "examiner")
    assert "no frame stated" not in note
    unstated = parse_profile({**BODY, "eye_side": eye_side, "zernike": stated})
    said = "x to the person's right (no frame stated: read as the eye's view; "
    assert said in unstated.notes[0]
    assert ", in waves of 555 nm, positive where light is ahead, " in note
    is_rms = DEFAULT_NORMALIZATION[order] == "rms"
    assert f", {'' if is_rms else 'not '}normalized to RMS 1, " in note
    assert "on a circle of 6 mm: +1.000 um Z(2,0): myopia, M -0.77 dpt; " in note
    assert (
        "the tail of the image of a point points up and to the person's right" in note
    )


def test_values_by_number_by_term_and_from_json(tmp_path):
    numbered = {"order": "osa", "unit": "nm", "values": {"4": 1000, "5": 500}}
    numbered["values"] |= {"3": -500, "8": 600, "7": 250}
    assert_expected(parse_profile({**BODY, "zernike": numbered}))
    behind = {key: -1000 * value for key, value in TERMS_UM.items()}
    body = {**BODY, "pupil_radius_mm": 3.0} | {
        "zernike": {"order": "nm", "unit": "nm", "positive": "behind", "values": behind}
    }
    del body["pupil_diameter_mm"]
    assert_expected(loaded(tmp_path, json.dumps(body), "json"))
    assert_expected(load_profile(json.dumps(body)))


def test_measurements_of_a_set_may_state_an_order():
    stated = {"order": "noll", "unit": "um", "values": in_order("noll")}
    measurement = {"pupil_radius_mm": 3.0, "wavelength_nm": 555.0, "zernike": stated}
    body = {"kind": "zernike_set", "measurements": [measurement, {**measurement}]}
    body["measurements"][1]["h_deg"] = 20.0
    found = parse_profile(body)
    assert_expected(found)
    assert [note.code for note in found.notes] == ["zernike_order"]
    assert np.array_equal(found.measurements[1].zernike_um, found.zernike_um)


def rows(order, header="j,um\n", **how):
    values = in_order(order, **how)
    first = FIRST_INDEX[order]
    return header + "".join(f"{first + k},{v!r}\n" for k, v in enumerate(values))


NOLL = "# order: noll\n"


@pytest.mark.parametrize(
    "text",
    [
        *(f"# order: {o}\n" + SETTINGS + rows(o) for o in FIRST_INDEX),
        SETTINGS + "# Zernike standard: OSA\n" + rows("osa", "index,um\n"),
        SETTINGS + "# units: um\n" + NOLL + rows("noll", "term,value\n"),
        SETTINGS + "# units: um\n" + rows("noll", "") + "# ordering: Noll\n",
        SETTINGS + NOLL + rows("noll", "term,coefficient [nm]\n", unit="nm"),
        SETTINGS
        + "# Order of terms: Fringe (University of Arizona)\n# normalization: rms\n"
        + rows("fringe", normalization="rms"),
        SETTINGS
        + "# order: osa\n# units: waves\n# Normalization: none\n"
        + rows("osa", "", unit="waves", wavelength_nm=555.0, normalization="none"),
        "# pupil radius: 3 mm\n# wavelength: 555 nm\n" + NOLL + rows("noll"),
        SETTINGS + NOLL + rows("noll").replace(",", ";").replace(".", ","),
        # a column for each term
        SETTINGS
        + "# order: born-wolf\n"
        + ",".join(f"Z{k + 1} um" for k in range(10))
        + "\n"
        + ",".join(map(repr, in_order("born-wolf"))),
        SETTINGS
        + "# order: OSA/ANSI\n# units: um\nc_4,c_5,c_3,c_8,c_7\n1,0.5,-0.5,0.6,0.25\n",
        # n,m
        SETTINGS
        + "n,m,nm\n"
        + "".join(f"{key},{1000 * value}\n" for key, value in TERMS_UM.items()),
        SETTINGS
        + "# positive: behind\nn,m,um\n"
        + "".join(f"{key},{-value}\n" for key, value in TERMS_UM.items()),
    ],
)
def test_tables_that_state_their_order(tmp_path, text):
    found = loaded(tmp_path, text)
    assert_expected(found)
    assert [note.code for note in found.notes] == ["zernike_order"]


def test_an_abp_file_in_waves(tmp_path):
    lines = "".join(f"Z[{key}] = {um / 0.555}\n" for key, um in TERMS_UM.items())
    text = f"# units: waves\nAp = 6.0\nWa = 555\n{lines}"
    assert_expected(loaded(tmp_path, text, "abp"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "4,0.25\n",
            "line 3: the term '4' does not tell n from m; allowed: n,m,um, or",
        ),
        (NOLL + "4,0.25\n", "line 4: the coefficients have no unit; allowed: '# units"),
        (NOLL + "# units: um\n4,0.25\n2,0,1\n", "line 5: the term '4' does not tell n"),
        (NOLL + "j,um\n4,0.25\n4,0.5\n", "line 6: 'term 4' is given twice, first in"),
        (NOLL + "j,um\n4,0.25 nm\n", "line 5: '0.25 nm' has a unit"),
        (NOLL + "j,um\n4.5,0.25\n", "line 5: '4.5' is not an order or frequency"),
        (NOLL + "j,um\n0,0.25\n", "zernike.values: noll has no term '0'; allowed: 1"),
        (NOLL + "j,um\n4,0.25,1\n", "line 5: cannot read '4,0.25,1'"),
        ("# order: osa\n# units: um\nZ20,Z22\n1,2\n", "'Z20' does not tell n from m"),
        (
            "# units: waves\nZ2_0_um,Z2_2_um\n1,2\n",
            "line 4: unit is 'um', but waves in line 3",
        ),
        ("# units: waves\n2,0,1 um\n", "line 4: unit is 'um', but waves in line 3"),
        ("# order: osa\n# ordering: noll\n", "order is 'noll', but osa in line 3"),
    ],
)
def test_a_table_whose_order_is_not_clear_is_refused(tmp_path, text, message):
    with pytest.raises(ProfileError, match=message):
        loaded(tmp_path, SETTINGS + text)


def test_the_page_lists_the_terms_and_defaults_of_each_order():
    page = PAGE.read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `([a-z-]+)`[^|]*\| (\d) \| (.*) \| (yes|no) \|$", page, re.M
    )
    assert [row[0] for row in rows] == list(FIRST_INDEX)
    for order, first, terms, is_normalized in rows:
        assert int(first) == FIRST_INDEX[order]
        assert (is_normalized == "yes") == (DEFAULT_NORMALIZATION[order] == "rms")
        shown = re.findall(r"(-?)\((\d),(-?\d)\)", terms)
        for number, (sign, n, m) in enumerate(shown, start=1):
            found = term_of(order, number - int(first))
            assert found == (int(n), int(m), -1 if sign else 1)
        assert len(shown) == 8
