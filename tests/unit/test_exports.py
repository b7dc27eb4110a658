"""Profiles in exports: VisionPrescription of FHIR, and the aberrometer irx3."""

import json

import numpy as np
import pytest

from estimator import ProfileError, load_profile
from estimator.optics.prescription import power_vectors_dpt
from estimator.optics.zernike import flip_horizontal, index_from_nm
from tests.exports import (
    IRX3_PUPIL_MM,
    IRX3_TERMS_UM,
    irx3_export,
    lens,
    vision_prescription,
)


def fhir(tmp_path, resource):
    path = tmp_path / "rx.json"
    path.write_text(json.dumps(resource), encoding="utf-8")
    return load_profile(path)


def same_as(profile, **body):
    expected = load_profile(json.dumps({"kind": "prescription", **body}))
    assert profile.digest == expected.digest


def texts(profile):
    return [str(note) for note in profile.notes if note.code == "file_prescription"]


def test_the_right_eye_is_read_unless_a_field_says_otherwise(tmp_path):
    both = vision_prescription()
    right = fhir(tmp_path, both)
    same_as(right, sphere_dpt=-2.25, add_dpt=1.5)
    assert any("lenses for both eyes: the right eye is used" in t for t in texts(right))
    left = fhir(tmp_path, both | {"eye_side": "OS"})
    same_as(
        left,
        eye_side="OS",
        sphere_dpt=-1.5,
        cylinder_dpt=-0.75,
        axis_deg=170,
        add_dpt=1.5,
    )
    assert not any("both eyes" in t for t in texts(left))


def test_the_only_eye_is_read(tmp_path):
    profile = fhir(tmp_path, vision_prescription(lens("left", sphere=0.5)))
    assert profile.eye_side == "OS"
    assert not any("both eyes" in t for t in texts(profile))


def test_the_axis_is_the_examiners(tmp_path):
    """M, J0 and J45 by Thibos's formulas, with x to the person's right."""
    only = lens("right", sphere=-1.0, cylinder=-2.0, axis=30)
    profile = fhir(tmp_path, vision_prescription(only))
    found = power_vectors_dpt(profile.zernike_um, profile.pupil_diameter_mm / 2.0)
    axis = np.radians(30.0)
    expected = -2.0, np.cos(2 * axis), np.sin(2 * axis)
    assert found * [1, 1, -1] == pytest.approx(expected, abs=1e-9)


def test_vertex_distance_and_age_may_be_added(tmp_path):
    resource = vision_prescription(lens("right", sphere=-8.0))
    same_as(fhir(tmp_path, resource), sphere_dpt=-8.0)
    profile = fhir(tmp_path, resource | {"vertex_mm": 12, "age_years": 40})
    same_as(profile, sphere_dpt=-8.0, vertex_mm=12, age_years=40)
    assert not texts(profile)


def test_a_contact_lens_has_a_power_at_the_cornea(tmp_path):
    contact = lens("right", code="contact", power=-2.75, cylinder=-2.25, axis=160)
    profile = fhir(tmp_path, vision_prescription(contact))
    same_as(profile, sphere_dpt=-2.75, cylinder_dpt=-2.25, axis_deg=160)
    assert not texts(profile)
    assert not any("vertex_mm is missing" in note for note in profile.notes)
    with pytest.raises(ProfileError, match="vertex_mm: is given for a contact lens"):
        fhir(tmp_path, vision_prescription(contact) | {"vertex_mm": 12})


def test_prisms_and_other_oddities_get_notes(tmp_path):
    profile = fhir(
        tmp_path,
        vision_prescription(
            lens("right", sphere=1.0, cylinder=0.5, axis=10),
            lens("left", sphere=1.0, cylinder=-0.5, axis=100),
            status="draft",
        ),
    )
    assert any("status of the file is draft" in text for text in texts(profile))
    assert any("plus cylinder, the other one a minus" in t for t in texts(profile))
    prism = fhir(tmp_path, vision_prescription())
    assert any("left out: 1 prism dpt base in" in text for text in texts(prism))


def test_equal_lenses_of_one_eye_are_one(tmp_path):
    pair = lens("right", sphere=-1.0), lens("right", sphere=-1.0, color="green")
    same_as(fhir(tmp_path, vision_prescription(*pair)), sphere_dpt=-1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"resourceType": "Patient"}, "resourceType: 'Patient'; .*VisionPrescription"),
        ({"status": "entered-in-error"}, "status: 'entered-in-error'; .*active"),
        ({"lensSpecification": []}, "lensSpecification: .*1 to 20 lenses"),
        (
            {"lensSpecification": None, "dispense": []},
            "dispense: is of FHIR before R4",
        ),
        ({"eye_side": "both"}, "eye_side: 'both'; .*OD or OS"),
        ({"vertex_mm": 40}, "vertex_mm: .*0 to 25"),
    ],
)
def test_a_wrong_resource_is_named(tmp_path, changes, message):
    with pytest.raises(ProfileError, match=message):
        fhir(tmp_path, vision_prescription() | changes)


@pytest.mark.parametrize(
    ("lenses", "message"),
    [
        ([7], r"lensSpecification\.0: 7; .*an object"),
        ([lens("both", sphere=1)], r"lensSpecification\.0\.eye: 'both'; .*right or"),
        ([lens("right")], r"lensSpecification\.0\.sphere: is missing"),
        (
            [lens("right", sphere="-1")],
            r"lensSpecification\.0\.sphere: '-1'; .*a number",
        ),
        ([lens("right", sphere=-1, cylinder=-1)], r"\.0\.axis: is missing"),
        (
            [lens("right", sphere=1, axis=9)],
            "cylinder: is missing beside an axis",
        ),
        ([lens("right", sphere=-1, cylinder=-1, axis=190)], r"\.axis: 190; .*0 to 180"),
        ([lens("right", sphere=1, power=2)], r"power: 2 is not the sphere, 1"),
        ([lens("right", sphere=-225)], "sphere_dpt: .*-30 to 30"),
        ([lens("right", sphere=1, add=9)], "add_dpt: .*0 to 4"),
        (
            [lens("right", sphere=1), lens("right", sphere=2)],
            r"lensSpecification\.1: differs from lensSpecification\.0",
        ),
        (
            [lens("right", sphere=1, prism=[{"amount": 1, "base": "nasal"}])],
            r"prism\.0\.base: 'nasal'; .*up or down or in or out",
        ),
        ([lens("right", sphere=1, prism=[{"base": "in"}])], "amount: is missing"),
        ([lens("right", sphere=1, prism={})], r"\.prism: .*up to 8 objects"),
    ],
)
def test_a_wrong_element_is_named(tmp_path, lenses, message):
    with pytest.raises(ProfileError, match=message):
        fhir(tmp_path, vision_prescription(*lenses))


def test_the_eye_asked_for_must_have_a_lens(tmp_path):
    only = vision_prescription(lens("right", sphere=1))
    with pytest.raises(ProfileError, match="no lens for the left eye; allowed: OD"):
        fhir(tmp_path, only | {"eye_side": "OS"})


def irx3(tmp_path, text, **given):
    path = tmp_path / "export.txt"
    path.write_bytes(text.encode("latin-1"))
    return load_profile(path, **given)


def test_coefficients_are_read_in_the_examiners_frame(tmp_path):
    profile = irx3(tmp_path, irx3_export(), wavelength_nm=780.0)
    expected_um = np.zeros(28)
    for (n, m), value in IRX3_TERMS_UM.items():
        expected_um[index_from_nm(n, m)] = value
    found_um = profile.measurements[0].zernike_um
    assert found_um == pytest.approx(flip_horizontal(expected_um), abs=1e-12)
    assert profile.eye_side == "OS"
    assert profile.pupil_diameter_mm == IRX3_PUPIL_MM
    assert profile.wavelength_nm == 780.0
    assert profile.name == "export"  # not the person's


def test_the_stimulus_is_told(tmp_path):
    (note,) = irx3(tmp_path, irx3_export(), wavelength_nm=780.0).notes
    assert note.code == "file_measurement"
    assert note.values == {"stimulus_dpt": -0.5}


def test_the_wavelength_may_be_a_line_of_the_file(tmp_path):
    text = irx3_export(**{"Wavelength (nm)": "780"})
    assert irx3(tmp_path, text).wavelength_nm == 780.0
    with pytest.raises(ProfileError, match=r"wavelength_nm: is missing.*Wavelength"):
        irx3(tmp_path, irx3_export())


@pytest.mark.parametrize(
    ("terms_um", "stated"),
    [
        ({(2, 0): -1.6}, "D \\(2 , 0\\) D: .*positive where light is ahead"),
        ({(2, 0): 1.6 * 3**0.5}, "D \\(2 , 0\\) D: .*OSA terms"),
        ({(2, -2): 0.35}, "Degree: 74.9, but coefficients say 105.1 deg"),
    ],
    ids=["sign", "normalization", "frame"],
)
def test_other_conventions_contradict_the_diopters(tmp_path, terms_um, stated):
    """Files whose coefficients have another sign, normalization or frame."""
    own = {f"z ({n} , {m}) (µm)": f"{um:.3f}" for (n, m), um in terms_um.items()}
    with pytest.raises(ProfileError, match=stated):
        irx3(tmp_path, irx3_export(**own), wavelength_nm=780.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Software version": None}, "Software version: has no"),
        ({"Software version": "Other 2"}, "'Other 2'; .*an export of the irx3"),
        ({"Side": "OU"}, "Side: OU; .*OD or OS"),
        ({"Side": None}, "Side: is missing"),
        ({"Normalized pupil diameter (mm)": None}, "pupil diameter .*is missing"),
        ({"Normalized pupil diameter (mm)": "0"}, "diameter above 0"),
        ({"Normalized pupil diameter (mm)": "4,7"}, "'4,7'; .*a number"),
        ({"Normalized pupil X position (mm)": "0.2"}, "X position .*0.2"),
        ({"z (2 , 1) (µm)": "0.1"}, "no such term"),
        ({"z (99 , 1) (µm)": "0.1"}, "no such term"),
        ({"z (3 , -1) (nm)": "0.1"}, "the unit is 'nm'; .*um"),
        ({"z (3 , -1) (µm)": "x"}, "'x'; .*a number"),
        ({"z (3 , -1) (µm)": "0.1\t0.2"}, "has 2 values; .*one"),
        ({"z (2 , 0) (µm)": None}, r"z \(2 , 0\): is missing"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path, changes, message):
    with pytest.raises(ProfileError, match=message):
        irx3(tmp_path, irx3_export(**changes), wavelength_nm=780.0)


def test_two_measurements_in_a_file_are_refused(tmp_path):
    text = irx3_export() + irx3_export(**{"Measurement n°": "2"})
    with pytest.raises(ProfileError, match="one measurement in a file"):
        irx3(tmp_path, text, wavelength_nm=780.0)


def test_other_texts_are_refused_with_the_way_out(tmp_path):
    with pytest.raises(ProfileError, match=r"rename a table of n,m,um to \.csv"):
        irx3(tmp_path, "n,m,um\n2,0,1\n")
