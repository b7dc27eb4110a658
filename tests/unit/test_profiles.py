"""Profile parsing: what is accepted, and what an error names."""

import json
from types import MappingProxyType

import numpy as np
import pytest

from estimator.field.prepare import prepare_eye
from estimator.optics.zernike import flip_horizontal, index_from_nm
from estimator.profiles.files import load_profile
from estimator.profiles.parse import ProfileError, parse_profile

GOOD = {
    "kind": "zernike",
    "pupil_diameter_mm": 5,
    "wavelength_nm": 587.56,
    "zernike_um": {"2,0": 5.41, "3,-1": -0.2, "3,1": 0.1},
}


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"kind": "guess"}, "kind"),
        ({"pupil_diameter_mm": 12}, "pupil_diameter_mm"),
        ({"pupil_diameter_mm": "5"}, "pupil_diameter_mm"),
        ({"pupil_diameter_mm": float("nan")}, "pupil_diameter_mm"),
        ({"wavelength_nm": None}, "wavelength_nm"),
        ({"zernike_um": {"11,1": 0.1}}, "zernike_um.11,1"),
        ({"zernike_um": {"3,2": 0.1}}, "zernike_um.3,2"),
        ({"zernike_um": {"2": 0.1}}, "zernike_um.2"),
        ({"zernike_um": {"2,0": True}}, "zernike_um.2,0"),
        ({"zernike_um": []}, "zernike_um"),
        ({"zernike_um": {"2,0": 1, "02,0": 2}}, "zernike_um.02,0"),
        ({"frame": "camera"}, "frame"),
        ({"eye_side": "left"}, "eye_side"),
        ({"age_years": -1}, "age_years"),
        ({"sphere_dpt": -1}, "sphere_dpt"),
        ({"correction": {"sphere_dpt": -1, "axis_deg": 200}}, "correction.axis_deg"),
    ],
)
def test_bad_field_is_named_with_its_range(change, field):
    with pytest.raises(ProfileError) as caught:
        parse_profile({**GOOD, **change})
    assert caught.value.field == field
    assert caught.value.allowed in str(caught.value)


def test_a_cylinder_needs_its_axis():
    body = {"kind": "prescription", "sphere_dpt": -6, "cylinder_dpt": -1}
    with pytest.raises(ProfileError) as caught:
        parse_profile(body)
    assert caught.value.field == "axis_deg"
    assert parse_profile({**body, "cylinder_dpt": 0}).kind == "prescription"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("eye.json", '{"kind": "preset", "name": "myopia", "name": "cataract"}'),
        ("eye.abp", "Ap = 5\nWa = 500\nZ[2,0] = 1\nZ[2, 0] = 2\n"),
        ("eye.csv", "# pupil_diameter_mm: 5\n# wavelength_nm: 500\n2,0,1\n2,0,3\n"),
    ],
)
def test_a_field_given_twice_is_refused(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ProfileError, match="twice"):
        load_profile(path)


def test_a_binary_file_is_refused_by_name(tmp_path):
    path = tmp_path / "eye.abp"
    path.write_bytes(b"\x80\x81\x82")
    with pytest.raises(ProfileError, match=r"eye\.abp"):
        load_profile(path)


@pytest.mark.parametrize("body", [None, [], "myopia", {1: 2}, {}])
def test_a_profile_that_is_no_object_is_refused(body):
    with pytest.raises(ProfileError):
        parse_profile(body)


def test_examiner_frame_is_mirrored_on_the_way_in():
    eye = parse_profile({**GOOD, "frame": "eye"}).zernike_um
    examiner = parse_profile({**GOOD, "frame": "examiner"}).zernike_um
    assert np.array_equal(examiner, flip_horizontal(eye))


def test_abp_file_reads_integers_comments_and_terms(tmp_path):
    path = tmp_path / "eye.abp"
    path.write_text(
        "# an eye\nAp = 5\nWa = 587.56\nZ[2, 0] = 5.4127 # myopia\nZ[3,-1]=1\n"
    )
    profile = load_profile(path)
    assert profile.pupil_diameter_mm == 5.0
    assert profile.zernike_um[index_from_nm(2, 0)] == 5.4127
    assert profile.zernike_um[index_from_nm(3, -1)] == 1.0


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("Ap = 5\nWa = 500\nZ[2 0] = 1\n", "line 3"),
        ("Ap = five\nWa = 500\n", "line 1"),
        ("Wa = 500\nZ[2,0] = 1\n", "pupil_diameter_mm"),
    ],
)
def test_broken_abp_names_the_line_or_field(tmp_path, text, where):
    path = tmp_path / "eye.abp"
    path.write_text(text)
    with pytest.raises(ProfileError, match=where):
        load_profile(path)


def test_csv_takes_its_pupil_from_beside_it_or_from_comments(tmp_path):
    path = tmp_path / "eye.csv"
    path.write_text("n,m,um\n2,0,1.5\n3,-1,-0.25\n")
    with pytest.raises(ProfileError, match="wavelength_nm"):
        load_profile(path)
    with pytest.raises(ProfileError, match="pupil_diameter_mm"):
        load_profile(path, wavelength_nm=550.0)
    beside = load_profile(path, pupil_diameter_mm=6.0, wavelength_nm=550.0)
    path.write_text(
        "# pupil_diameter_mm: 6\n# wavelength_nm = 550\n2,0,1.5\n3,-1,-0.25"
    )
    inside = load_profile(path)
    assert np.array_equal(beside.zernike_um, inside.zernike_um)
    assert inside.pupil_diameter_mm == 6.0


def test_json_file_is_the_wire_object(tmp_path):
    path = tmp_path / "eye.json"
    path.write_text(json.dumps(GOOD))
    assert np.array_equal(load_profile(path).zernike_um, parse_profile(GOOD).zernike_um)


def test_unknown_name_lists_what_exists():
    with pytest.raises(ProfileError, match="keratoconus"):
        load_profile("kerataconus")


STRONG = {"kind": "prescription", "sphere_dpt": -8, "cylinder_dpt": -1.25}
ASKS = "vertex_mm is missing"


def test_powers_are_said_where_they_count_and_at_the_cornea():
    body = {**STRONG, "axis_deg": 80, "vertex_mm": 12}
    # F / (1 - d F): -8 to -7.299, and -9.25 to -8.326
    expected = "prescription: -8.00 -1.25 x 80 at 12 mm, -7.30 -1.03 x 80 at the cornea"
    assert parse_profile(body).notes == (expected,)
    worn = {**GOOD, "correction": {"sphere_dpt": 5, "vertex_mm": 14}}
    # 5 to 5.376
    expected = "worn spectacles: +5.00 at 14 mm, +5.38 at the cornea"
    assert parse_profile(worn).notes == (expected,)
    lens = {"kind": "contact_lens", "sphere_dpt": -5, "cylinder_dpt": -1, "axis_deg": 9}
    expected = "worn contact lens: -5.00 -1.00 x 9 at the cornea"
    assert parse_profile({**GOOD, "correction": lens}).notes == (expected,)


@pytest.mark.parametrize(
    ("body", "asks"),
    [
        ({**STRONG, "axis_deg": 80}, True),
        ({**STRONG, "axis_deg": 80, "vertex_mm": 0}, False),
        ({"kind": "prescription", "sphere_dpt": -3.75}, False),
        ({"kind": "prescription", "sphere_dpt": 4}, True),
        (
            {
                "kind": "prescription",
                "sphere_dpt": -2,
                "cylinder_dpt": -2,
                "axis_deg": 5,
            },
            True,
        ),
        ({**GOOD, "correction": {"sphere_dpt": -6}}, True),
        ({**GOOD, "correction": {"kind": "contact_lens", "sphere_dpt": -6}}, False),
        ({"kind": "prescription", "sphere_dpt": 0}, False),
        (GOOD, False),
    ],
)
def test_a_strong_prescription_without_a_distance_asks_for_it(body, asks):
    assert any(ASKS in note for note in parse_profile(body).notes) == asks


@pytest.mark.parametrize("eye_model", ["traced", "wavefront"])
def test_an_eye_is_prepared_with_the_notes_of_its_profile(eye_model):
    profile = parse_profile({**STRONG, "axis_deg": 80})
    _, notes = prepare_eye(profile, pupil_diameters_mm=(3.0,), eye_model=eye_model)
    assert any(ASKS in note for note in notes)


def test_json_text_is_a_profile_wherever_one_is_loaded():
    text = ' {"kind": "prescription", "sphere_dpt": -2}'
    np.testing.assert_array_equal(
        load_profile(text).zernike_um,
        parse_profile({"kind": "prescription", "sphere_dpt": -2}).zernike_um,
    )


def test_a_mapping_is_a_profile_wherever_one_is_loaded():
    body = MappingProxyType({"kind": "prescription", "sphere_dpt": -2})
    found, expected = load_profile(body), parse_profile(dict(body))
    np.testing.assert_array_equal(found.zernike_um, expected.zernike_um)
    with pytest.raises(ProfileError, match="sphere_dpt"):
        load_profile({"kind": "prescription", "sphere_dpt": "strong"})
    with pytest.raises(ProfileError):
        load_profile({})


@pytest.mark.parametrize("text", ["{", "{}", '{"kind": "guess"}', '{"a": ' * 5000])
def test_json_text_that_is_no_profile_is_refused(text):
    with pytest.raises(ProfileError):
        load_profile(text)


def test_a_long_slip_is_not_compared_with_all_names():
    with pytest.raises(ProfileError) as caught:
        parse_profile({**GOOD, "k" * 100_000: 1})
    assert "did you mean" not in str(caught.value)
