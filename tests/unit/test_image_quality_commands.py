"""`ocufilter mtf`, `acuity`, `through-focus`, and `psf` of lists of states."""

import csv
import json

import numpy as np
import pytest
from PIL import Image

from clients.commands.image_quality import _within_light
from clients.commands.state_options import listed_numbers, named_eyes
from estimator import Eye
from estimator.psf.compute import disc_mask
from tests.commands import run_command

PSF = ["--wavelength-nm", "555", "--pixel-arcmin", "1"]


def printed(*arguments):
    ended = run_command(*arguments)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def rows_of(text):
    return list(csv.DictReader(text.splitlines()))


@pytest.mark.long("transfer functions of three pupils")
def test_an_mtf_table_of_three_pupils_is_one_command():
    words = ("mtf", "emmetropia", "--pupil-mm", "3,4,5", "--frequency-cpd", "10,20")
    rows = rows_of(printed(*words, "--csv"))
    expected = Eye("emmetropia").mtf(
        frequency_cpd=[10, 20], pupil_diameter_mm=[3, 4, 5]
    )
    assert len(rows) == 6
    for row, values in zip(rows, expected.rows(), strict=True):
        assert [float(cell) for cell in row.values()] == pytest.approx(values, abs=1e-9)
    assert list(rows[0]) == expected.columns()

    text = printed(*words, "--pupil-mm", "2,3")
    assert "pupil_diameter_mm  frequency_cpd  modulation_ratio" in text
    assert "emmetropia: h_deg 0, v_deg 0, focus_dpt 0, object_dpt 0" in text
    found = json.loads(printed(*words, "--pupil-mm", "3", "--json"))
    assert found["rows"][1]["modulation_ratio"] == pytest.approx(
        float(rows[1]["modulation_ratio"])
    )
    assert found["eye"] == "emmetropia"

    white = printed("mtf", "emmetropia", "--pupil-mm", "2", "--white-light")
    assert "wavelength_nm 555, light white, stiles_crawford centered" in white


@pytest.mark.long("five transfer functions and a figure")
def test_options_of_light_change_the_mtf(tmp_path):
    words = ("mtf", "emmetropia", "--frequency-cpd", "20", "--csv", "--pupil-mm", "2")
    values = [
        float(rows_of(printed(*words, *option))[0]["modulation_ratio"])
        for option in (
            (),
            ("--orientation-deg", "0"),
            ("--white-light",),
            ("--stiles-crawford",),
            ("--straylight",),
        )
    ]
    assert len(set(values)) == 5
    out = tmp_path / "mtf.png"
    printed(
        "mtf",
        "emmetropia",
        "--frequency-cpd",
        "0:60:20",
        "--pupil-mm",
        "2",
        "--plot",
        out,
    )
    assert np.asarray(Image.open(out)).std() > 10.0


@pytest.mark.long("acuity at two distances and three defoci")
def test_acuity_and_through_focus_have_a_column_for_each_quantity():
    words = ("--object-dpt", "0,6", "--notation", "feet", "--csv")
    rows = rows_of(printed("acuity", "myopia", *words))
    far, near = (float(row["log_mar"]) for row in rows)
    assert near < 0.0 < 0.8 < far
    assert rows[0]["acuity"] == f"20/{20.0 * 10.0**far:.0f}"
    words = ("through-focus", "emmetropia", "--defocus-dpt=-1:1:1", "--csv")
    rows = rows_of(printed(*words))
    assert [float(row["defocus_dpt"]) for row in rows] == [-1.0, 0.0, 1.0]
    assert list(rows[0])[-3:] == ["log_mar", "visual_strehl_ratio", "modulation_ratio"]


@pytest.mark.long("transfer functions of two eyes, twice, and a figure")
def test_several_eyes_are_one_table_and_one_figure(tmp_path):
    body = json.dumps({"kind": "prescription", "sphere_dpt": -1})
    words = ("--pupil-mm", "2", "--frequency-cpd", "10,20")
    eyes = ("arizona", f"mine={body}")
    out = tmp_path / "mtf.png"
    rows = rows_of(printed("mtf", *eyes, *words, "--csv", "--plot", out))
    assert [row["eye"] for row in rows] == ["arizona", "arizona", "mine", "mine"]
    alone = [
        row for eye in eyes for row in rows_of(printed("mtf", eye, *words, "--csv"))
    ]
    values = [row["modulation_ratio"] for row in rows]
    assert values == [row["modulation_ratio"] for row in alone]
    # An eye given by its surfaces is relaxed: it has no focus.
    assert [row["focus_dpt"] for row in rows] == ["nan", "nan", "0.0", "0.0"]
    assert np.asarray(Image.open(out)).std() > 10.0
    text = printed("refraction", *eyes, "--pupil-mm", "2")
    assert "arizona, mine: h_deg 0, v_deg 0, pupil_diameter_mm 2" in text
    assert "note: mine: prescription: -1.00 at the cornea" in text


def test_names_of_eyes_are_not_parts_of_json_or_of_files(tmp_path):
    file = tmp_path / "a=b.json"
    file.touch()
    text = '{"kind": "prescription", "name": "a=b"}'
    assert named_eyes([text, str(file), f"me={text}", "myopia"]) == {
        text: text,
        str(file): str(file),
        "me": text,
        "myopia": "myopia",
    }
    with pytest.raises(ValueError, match="two eyes have the name 'me'"):
        named_eyes(["me=myopia", "me=emmetropia"])


def test_refraction_is_the_prescription_with_wavelength_and_pupil():
    body = {"kind": "prescription", "higher_order": "none", "vertex_mm": 12}
    body |= {"sphere_dpt": -3, "cylinder_dpt": -1, "axis_deg": 30}
    words = ("refraction", json.dumps(body), "--pupil-mm", "3,5", "--vertex-mm", "12")
    rows = rows_of(printed(*words, "--csv"))
    assert [float(row["pupil_diameter_mm"]) for row in rows] == [3.0, 5.0]
    for row in rows:
        found = [float(row[k]) for k in ("sphere_dpt", "cylinder_dpt", "axis_deg")]
        assert found == pytest.approx([-3.0, -1.0, 30.0], abs=0.02)
        # M = S + C / 2; J0, J45 = -C / 2 cos, sin of twice 180 - axis: eye's frame
        found = [float(row[k]) for k in ("M_dpt", "J0_dpt", "J45_dpt")]
        assert found == pytest.approx([-3.5, 0.25, -0.25 * 3**0.5], abs=0.02)
    text = printed("refraction", "emmetropia", "--method", "visual_strehl")
    assert "pupil_diameter_mm 4, wavelength_nm 555, vertex_mm 0" in text


@pytest.mark.long("PSFs of six states and their figure")
def test_psfs_of_lists_are_a_table_and_one_array(tmp_path):
    out = tmp_path / "psf.npy"
    words = ("psf", "emmetropia", "--pupil-mm", "3,5", "--h-deg", "0,20,30", *PSF)
    rows = rows_of(printed(*words, "-o", out, "--csv"))
    kernels = np.load(out)
    assert kernels.shape[:2] == (3, 2)  # direction, pupil
    np.testing.assert_allclose(kernels.sum(axis=(-1, -2)), 1.0, atol=1e-5)
    assert [float(row["peak_ratio"]) for row in rows] == pytest.approx(
        kernels.max(axis=(-1, -2)).ravel()
    )
    assert float(rows[0]["half_light_radius_arcmin"]) < 1.5
    text = printed(*words, "-o", tmp_path / "psf.png")
    assert "wrote light_ratio [h_deg, pupil_diameter_mm, y_arcmin, x_arcmin]" in text
    assert np.asarray(Image.open(tmp_path / "psf.png")).shape[0] > 400


@pytest.mark.long("PSFs of two states, twice")
def test_psfs_have_the_stated_radius_and_figures_most_of_the_light(tmp_path):
    out = tmp_path / "psf.npy"
    words = ("psf", "emmetropia", "--pupil-mm", "3,6", *PSF)
    rows = rows_of(printed(*words, "-o", out, "--radius-arcmin", "10", "--csv"))
    kernels = np.load(out)
    assert kernels.shape == (2, 21, 21)
    assert {row["radius_arcmin"] for row in rows} == {"10.0"}
    one = ("psf", "emmetropia", "--pupil-mm", "6", *PSF, "--radius-arcmin", "10")
    printed(*one, "-o", out)
    np.testing.assert_allclose(np.load(out), kernels[1], rtol=2e-3, atol=1e-6)

    found = Eye("emmetropia").psf(pupil_diameter_mm=[3, 6], pixel_arcmin=1)
    shown = _within_light(found)
    assert shown.coords["x_arcmin"][-1] < 0.5 * found.coords["x_arcmin"][-1]
    light = shown.values.sum(axis=(-1, -2))
    assert (light >= 0.99).all()
    smaller = shown.values[:, 2:-2, 2:-2] * disc_mask(shown.shape[-1] // 2 - 2)
    assert smaller.sum(axis=(-1, -2)).min() < 0.99


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("mtf emmetropia --pupil-mm 3,40", "--pupil-mm is 40; allowed: 0.5 to 12 mm"),
        ("mtf emmetropia --wavelength-nm 0.555", "(0.555 um is 555 nm)"),
        ("mtf emmetropia --frequency-cpd 0:60", "--frequency-cpd is '0:60'; allowed: "),
        ("acuity emmetropia --object-dpt near", "--object-dpt is 'near'; allowed: "),
        ("acuity nobody", "'nobody'"),
        ("mtf emmetropia --plot a.jpg", "a.jpg"),
        ("psf myopia --pupil-mm 3", "--wavelength-nm"),
        (
            "psf myopia --pupil-mm 3 --wavelength-nm 555 --pixel-arcmin 1",
            "--out is mis",
        ),
        (
            "psf myopia --pupil-mm 3,4 --wavelength-nm 555 --pixel-arcmin 1 "
            "--method enz",
            "--method is 'enz'; lists, --radius-arcmin and --csv allow: auto",
        ),
        (
            "psf myopia --pupil-mm 3 --wavelength-nm 555 --pixel-arcmin 1 "
            "--radius-arcmin 2000",
            "--radius-arcmin is 2000; allowed: 0 to 1023",
        ),
        ("refraction emmetropia --vertex-mm 60", "--vertex-mm is 60; allowed: 0 to 50"),
        ("mtf emmetropia --white-light --frequency-cpd 70", "expected 0 to 60"),
    ],
)
def test_refusals_name_the_option_and_what_is_allowed(words, said):
    ended = run_command(*words.split())
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert said in ended.stderr


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("3", [3.0]),
        ("3, 4 5", [3.0, 4.0, 5.0]),
        ("0:1:0.25", [0.0, 0.25, 0.5, 0.75, 1.0]),
        ("2:-2:-2,7", [2.0, 0.0, -2.0, 7.0]),
        ("0:0.3:0.1", [0.0, 0.1, 0.2, 0.3]),
    ],
)
def test_a_list_is_numbers_or_a_range(text, values):
    assert listed_numbers("--x-dpt", text, (-10.0, 10.0)) == values


@pytest.mark.parametrize(
    "text", ["", "3,", "inf:0:1", "0:1:0", "1:0:1", "0:1e9:1e-9", "nan", "1:2:3:4"]
)
def test_other_lists_are_refused(text):
    with pytest.raises(ValueError, match="--x-dpt is"):
        listed_numbers("--x-dpt", text, (-10.0, 10.0))
