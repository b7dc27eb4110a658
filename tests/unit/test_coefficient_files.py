"""Tables of coefficients as programs and people write them."""

import csv
import io

import numpy as np
import pytest

from estimator.optics.zernike import index_from_nm
from estimator.profiles.files import load_profile, profile_body
from estimator.profiles.parse import ProfileError, parse_profile

TERMS = {"2,0": 1.0, "2,2": 0.5, "2,-2": -0.5, "3,1": 0.6}
SETTINGS = "# pupil_diameter_mm: 6.0\n# wavelength_nm: 555\n"
ROWS = "n,m,um\n" + "".join(f"{key},{value}\n" for key, value in TERMS.items())
ABP = "Ap = 6.0\nWa = 555\n" + "".join(
    f"Z[{key}] = {value}\n" for key, value in TERMS.items()
)
BODY = {"kind": "zernike", "zernike_um": TERMS, "pupil_diameter_mm": 6.0} | {
    "wavelength_nm": 555.0
}


WIDE = (
    "# units: um\npupil_diameter_mm,wavelength_nm,Z2_0,Z2_2,Z2_-2,Z3_1\n"
    "6.0,555,1.0,0.5,-0.5,0.6\n"
)


def loaded(tmp_path, content, suffix="csv"):
    path = tmp_path / f"eye.{suffix}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return load_profile(path)


def assert_same_eye(found, **changes):
    expected = parse_profile({**BODY, **changes})
    np.testing.assert_array_equal(found.zernike_um, expected.zernike_um)
    assert (found.eye_side, found.age_years) == (expected.eye_side, expected.age_years)
    assert found.pupil_diameter_mm == expected.pupil_diameter_mm
    assert found.wavelength_nm == expected.wavelength_nm


@pytest.mark.parametrize("suffix", ["csv", "abp"])
@pytest.mark.parametrize(
    "comments",
    [
        "# frame: examiner\n# eye_side: OS\n",
        "# FRAME = Examiner\n# Eye_Side: os\n",
        "# frame examiner\n# Eye: left\n",
        "# frame: ISO 24157\n# Eye side: left\n",
        "# Frame: ANSI Z80.28\n# eye side = Left\n",
        "#frame,examiner,\n#eye_side;OS;\n",
        "# Frame: examiner\n# left eye\n# eye: L\n",
    ],
)
def test_a_comment_that_states_a_setting_counts(tmp_path, suffix, comments):
    content = comments + (ABP if suffix == "abp" else SETTINGS + ROWS)
    found = loaded(tmp_path, content, suffix)
    assert_same_eye(found, frame="examiner", eye_side="OS")
    assert found.zernike_um[index_from_nm(3, 1)] == -0.6


@pytest.mark.parametrize(
    "settings",
    [
        "# wavelength_nm: 555 nm\n# Pupil_Diameter_mm: 6\n",
        "# Wavelength: 555nm\n# Pupil diameter (mm): 6.0\n",
        "# WAVELENGTH [nm] = 555,0\n# pupil-diameter = 6,0 mm\n# age: 30 years\n",
        "pupil_diameter_mm,6.0\nwavelength_nm,555\n",
        "# wavelength_nm: 555\n# pupil_diameter_mm = 6\n# units: µm\n"
        "# Zernike standard: OSA\n# ordering: ANSI Z80.28\n",
    ],
)
def test_settings_in_any_case_and_with_their_unit(tmp_path, settings):
    age_years = 30 if "age" in settings else None
    changes = {} if age_years is None else {"age_years": age_years}
    found = loaded(tmp_path, settings + ROWS)
    assert_same_eye(found, **changes)
    assert not found.notes


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("# pupil_mm: 6", "line 1: 'pupil_mm' is not a setting; allowed: pupil_diam"),
        ("# pupil radius (m): 3", "'pupil radius .m.' has 'm'; allowed: mm, as in"),
        ("# iris radius (mm): 3", "line 1: 'iris radius .mm.' is not a setting"),
        ("# h_deg: 20", "'h_deg' is not a setting"),
        ("# eye side of the examiner: left", "is not a setting"),
        ("# units: mm", "line 1: unit is 'mm'; allowed: um, nm, waves"),
        ("# units: um\n# unit: nm", "line 2: unit is 'nm', but um in line 1; allow"),
        ("# wavelength: 0.555 um", "'wavelength' has 'um'; allowed: nm"),
        ("# wavelength_nm: 0.555 um", "'wavelength_nm' has 'nm' and 'um'"),
        ("# wavelength: 555", "'wavelength' has no unit; allowed: nm, as in"),
        ("# wavelength 2 (nm): 555", "'wavelength 2 .nm.' is not a setting"),
        ("# frame: camera", "frame: 'camera' is unknown"),
        ("# eye: Anna", "eye_side: 'Anna' is unknown"),
        ("# Zernike standard: Malacara", "line 1: the order is 'malacara', but terms"),
        ("# order: noll", "line 1: the order is 'noll', but terms are n,m; allowed: t"),
        ("# order: zemax", "line 1: order is 'zemax'; allowed: osa, noll, fringe, ma"),
        ("# normalization: zemax", "normalization is 'zemax'; allowed: none, rms"),
        ("# positive: up", "positive is 'up'; allowed: ahead, behind"),
        ("# Zernike coefficients by Noll", "line 1: .* names 'noll'; allowed: a setti"),
        ("# ordering: by frequency", "order is 'by frequency'; allowed: osa, noll"),
        ("# left eye", "line 1: the comment 'left eye' does not state 'eye_side'"),
        ("# OS", "does not state 'eye_side'"),
        ("# as the examiner sees it", "does not state 'frame'"),
        ("# pupil_diameter_mm: wide", "line 1: 'wide' is not a number"),
    ],
)
@pytest.mark.parametrize("suffix", ["csv", "abp"])
def test_a_comment_that_may_be_a_setting_is_refused_by_name(
    tmp_path, suffix, line, message
):
    content = f"{line}\n" + (ABP if suffix == "abp" else SETTINGS + ROWS)
    with pytest.raises(ProfileError, match=message):
        loaded(tmp_path, content, suffix)


def test_other_comments_are_named_in_a_note(tmp_path):
    comments = "# Patient: Anna\n# measured in 2024\n# Date = 2024-05-01\n"
    found = loaded(tmp_path, comments + SETTINGS + ROWS)
    assert_same_eye(found)
    (note,) = found.notes
    assert note == "entries of the file without effect: 'Patient', 'Date'"
    assert (note.code, note.values) == ("file_comments", {"comment_count": 2.0})
    # commands and the service get the note with the profile
    assert parse_profile(profile_body(tmp_path / "eye.csv")).notes == (note,)
    assert found.digest == loaded(tmp_path, SETTINGS + ROWS).digest


def wide_rows(*, start="Z(", between=",", end=") um", **values):
    """A row of settings and terms, with names of a style."""
    names = [start + between.join(key.split(",")) + end for key in TERMS]
    row = {"pupil_diameter_mm": 6.0, "wavelength (nm)": 555, **values}
    return [[*row, *names], [*row.values(), *TERMS.values()]]


@pytest.mark.parametrize(
    ("style", "how"),
    [
        ({}, {}),  # quoted, because names have commas
        ({}, {"delimiter": ";"}),
        ({}, {"quoting": csv.QUOTE_ALL}),
        ({"start": "c_", "between": "_", "end": "_um"}, {}),
        ({"start": "z", "between": "", "end": " [µm]"}, {}),
        ({"start": "Z[", "between": ", ", "end": "] (micron)"}, {"delimiter": "\t"}),
    ],
)
def test_a_row_with_a_column_for_each_term(tmp_path, style, how):
    found = loaded(tmp_path, written(wide_rows(**style), **how))
    assert_same_eye(found)
    assert not found.notes


def test_columns_of_a_wide_row_are_settings_or_named_in_a_note(tmp_path):
    rows = wide_rows(**{"": 0, "Eye": "left", "frame": "examiner", "Patient": "Anna"})
    found = loaded(tmp_path, "# unit: um\n" + written(rows))
    assert_same_eye(found, frame="examiner", eye_side="OS")
    (note,) = found.notes
    assert note == "entries of the file without effect: 'Patient'"


@pytest.mark.parametrize(
    "content",
    [
        WIDE,
        WIDE.replace("# units: um\n", "")
        .replace("Z3_1", "Z3_1,units")
        .replace("0.6", "0.6,um"),
        WIDE.replace(",", ";").replace(".", ","),
        WIDE.replace(",", " "),
        # settings in lines of their own, behind the row too
        "# units: um\n# Z2_0,Z2_2,Z2_-2,Z3_1\n1.0,0.5,-0.5,0.6\n" + SETTINGS,
        # "Z20" is a term among such as "Z2-2"
        SETTINGS + "Z20 um,Z22 um,Z2-2 um,Z31 um\n1.0,0.5,\u22120.5,0.6\n",
    ],
)
def test_wide_rows_of_other_programs(tmp_path, content):
    assert_same_eye(loaded(tmp_path, content))


def written(rows, **how):
    """Return a table as Python's csv module writes it."""
    text = io.StringIO()
    csv.writer(text, **how).writerows(rows)
    return text.getvalue()


CELLS = [[*key.split(","), str(value)] for key, value in TERMS.items()]


@pytest.mark.parametrize(
    "content",
    [
        SETTINGS + written([["n", "m", "um"], *CELLS], delimiter=";"),
        SETTINGS + written(CELLS, delimiter="\t"),
        SETTINGS + written([["N", "M", "C (um)"], *CELLS], quoting=csv.QUOTE_ALL),
        # a spreadsheet with a decimal comma, whose rows all have four cells
        "sep=;\r\n"
        + written(
            [
                ["# pupil_diameter_mm: 6,0", "", "", ""],
                ["# wavelength_nm: 555", "", "", ""],
                ["n", "m", "um", ""],
                *([n, m, um.replace(".", ","), ""] for n, m, um in CELLS),
            ],
            delimiter=";",
        ),
        SETTINGS
        + written([["", "j", "n", "m", "um"], *(["0", "4", *c] for c in CELLS)]),
        SETTINGS + ROWS.replace("-", "\u2212"),
        SETTINGS + ROWS.replace("2,2", "+2,+2").replace(",", " "),
        (SETTINGS + ROWS).encode("utf-16"),
        (SETTINGS + ROWS).encode("utf-16-le"),
        (SETTINGS + ROWS).encode("utf-16-be"),
        (SETTINGS + ROWS).encode("utf-8-sig"),
        ("# gemessen für Anna\n" + SETTINGS + ROWS).encode("latin-1"),
        SETTINGS + ROWS + "7,1,0\n8,-8,0.0\n",
    ],
)
def test_tables_of_other_programs(tmp_path, content):
    assert_same_eye(loaded(tmp_path, content))


@pytest.mark.parametrize("order", [["n", "m", "um"], ["m", "n", "um"]])
def test_a_table_that_numpy_writes(tmp_path, order):
    columns = {"n": [2, 2, 2, 3], "m": [0, 2, -2, 1], "um": [*TERMS.values()]}
    path = tmp_path / "eye.csv"
    table = np.array([columns[name] for name in order], float).T
    header = "pupil_diameter_mm: 6\nwavelength_nm: 555\n" + ",".join(order)
    np.savetxt(path, table, delimiter=",", header=header)
    assert_same_eye(load_profile(path))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            SETTINGS + ROWS + "# pupil_diameter_mm: 4\n2,0,0.4\n",
            "line 8: 'pupil_diameter_mm' is given twice, first in line 1: which exam",
        ),
        (SETTINGS + ROWS + ROWS, "line 9: '2,0' is given twice.*which examination"),
        (
            SETTINGS + "n,m,um_OD,um_OS\n2,0,1,2\n",
            "columns of coefficients in 'n', 'm', 'um_OD', 'um_OS': which examination",
        ),
        (
            "patient;sphere;cylinder;axis;vertex\nAnna;-2;-1;20;12\nBen;-3;0;0;12\n",
            "line 1: a table with the columns 'patient', 'sphere', 'cylinder', 'axis', "
            r"\.\.\. and 2 rows, 'Anna', 'Ben': which examination.*\"prescription\"",
        ),
        (
            WIDE.replace("6.0,555", "6.0,555,OD").replace("_nm", "_nm,eye")
            + "5.0,555,OS,1,2,3,4\n",
            "line 2: a table with the columns 'pupil_diameter_mm', 'wavelength_nm', "
            "'eye', .* and 2 rows, '6.0', '5.0': which examination",
        ),
        (WIDE.partition("\n6")[0], "line 2: a table with the columns"),
        (
            "eye,pupil_mm,Z2_0 um,Z2_2 um\nOD,6,1.0,0.5\n",
            "line 2: 'pupil_mm' is not a setting; allowed: pupil_diameter_mm",
        ),
        (
            "pupil_diameter_mm,Z2_0,Z2_2\n6,1.0,0.5\n",
            "line 1: the columns 'Z2_0', 'Z2_2' state no unit; allowed: 'Z.n,m. um'",
        ),
        ("Z2_0 um,Z2_2 nm\n1,2\n", "line 1: the column 'Z2_2 nm' does not tell n fr"),
        ("Z2_0 um,Z5 um\n1,2\n", "line 1: the column 'Z5 um' does not tell n from m"),
        ("Z20 um,Z22 um\n1,2\n", "line 1: the column 'Z20 um' does not tell n from"),
        ("Z3 um,Z4 um\n1,2\n", "line 1: a table with the columns 'Z3 um', 'Z4 um'"),
        ("Z2_0 um,Z2_0 um\n1,2\n", "line 2: '2,0' is given twice"),
        ("Z2_0 um,Noll\n1,2\n", "line 2: the column 'Noll' names 'noll'"),
        ("Z2_0 um,axis\n1,2\n", "line 2: 'axis' is not a setting"),
        ("Z2_0 um,Z2_2 um,\n1,x\n", "line 2: 'x' is not a number"),
        ("Z2_0 um,Z2_2 um\n1,2,3\n", "line 2: cannot read '1,2,3'.* 2 cells, as in l"),
        # visisipy: coefficients by Noll's index, in waves
        (",coefficient,value\n0,1,0.48\n", "the columns '', 'coefficient', 'value'"),
        ("n,m,value\n2,0,1\n", "'n', 'm', 'value' state no coefficients in um"),
        ("n,m,um,name\n2,0,1,defocus\n", "columns behind 'um'"),
        ("n,m,mm\n2,0,1000\n", "state no coefficients in um"),
        ("# units: nm\nn,m,um\n2,0,1\n", "line 2: unit is 'um', but nm in line 1"),
        (SETTINGS + "2,0,3,2\n", "line 3: cannot read '2,0,3,2'.*or n;m;um"),
        (SETTINGS + "2,0,1 nm\n", "line 3: '1 nm' is in 'nm'; allowed: um"),
        (SETTINGS + "2.5,0,1\n", "line 3: '2.5' is not an order"),
        (SETTINGS + "2,0,nan\n", "line 3: 'nan' is not a number"),
        (SETTINGS + "2,0,\n", "line 3: the term '2' does not tell n from m; allowed"),
        (SETTINGS, "the file has no coefficients"),
        ("Listing of Zernike data\n", "line 1: cannot read 'Listing of Zernike data'"),
        (SETTINGS + ROWS + "11,1,0.1\n", "zernike_um.11,1: radial order 11, 0.1 um"),
        (SETTINGS + ROWS + "7,2,0\n", "zernike_um.7,2"),
        (b"\0\1\2\3", "is not a text file"),
    ],
)
def test_a_table_that_is_not_understood_is_refused(tmp_path, content, message):
    with pytest.raises(ProfileError, match=message):
        loaded(tmp_path, content)


@pytest.mark.parametrize(
    ("suffix", "hint"),
    [
        ("zos", "save the lens as .zmx"),
        ("roa", "as .zmx or with optiland"),
        ("xlsx", "save the sheet of one eye as .csv"),
        ("dat", "rename a table of n,m,um to .csv"),
    ],
)
def test_files_of_other_programs_are_refused_with_the_way_out(tmp_path, suffix, hint):
    with pytest.raises(ProfileError, match=hint):
        load_profile(tmp_path / f"eye.{suffix}")


def test_a_json_profile_in_utf_16(tmp_path):
    text = '{"kind": "prescription", "sphere_dpt": -2}'
    found = loaded(tmp_path, text.encode("utf-16"), "json")
    assert found.kind == "prescription"


@pytest.mark.parametrize(("order", "n_terms"), [(6, 28), (7, 36), (8, 45), (10, 66)])
def test_terms_up_to_the_tenth_order_are_read(tmp_path, order, n_terms):
    rows = f"{order},{-order},0.25\n12,2,0\n"
    found = loaded(tmp_path, SETTINGS + ROWS + rows)
    assert found.zernike_um.shape == (n_terms,)
    assert found.zernike_um[n_terms - order - 1] == 0.25
    assert np.count_nonzero(found.zernike_um) == len(TERMS) + 1
    mirrored = loaded(tmp_path, "# frame: examiner\n" + SETTINGS + ROWS + rows)
    side = -1.0 if order % 2 == 0 else 1.0
    assert mirrored.zernike_um[n_terms - order - 1] == side * 0.25


@pytest.mark.parametrize("frame", ["eye", "examiner"])
def test_zeros_of_higher_orders_are_allowed_in_every_profile(frame):
    terms = {**TERMS, "7,1": 0, "12,-12": 0.0}
    found = parse_profile({**BODY, "frame": frame, "zernike_um": terms})
    expected = parse_profile({**BODY, "frame": frame})
    np.testing.assert_array_equal(found.zernike_um, expected.zernike_um)


@pytest.mark.parametrize(
    ("vertex_mm", "asks"), [(0.012, True), (1.2, True), (0, False), (12, False)]
)
def test_a_vertex_distance_that_cannot_be_in_mm_is_asked_about(vertex_mm, asks):
    power = {"sphere_dpt": -8, "vertex_mm": vertex_mm}
    for body in ({"kind": "prescription", **power}, {**BODY, "correction": power}):
        (note,) = parse_profile(body).notes
        assert ("is vertex_mm in mm?" in note) == asks
