"""`ocufilter wavefront` from a JSON file to JSON on stdout, and its refusals."""

import json

import numpy as np
import pytest

from estimator.estimate.model import eye_model
from estimator.field.field_table import field_table
from estimator.optics.zernike import rescale_pupil
from estimator.profiles.files import load_profile
from estimator.wavefront.aberrations import pupil_magnification
from estimator.wavefront.compiled import PupilEllipse
from tests.commands import run_command
from tests.numerical.schematic_eyes import reference

CASE = next(
    c
    for c in reference()["zernike_cases"]
    if c["field_deg"] == 20 and c["stop_diameter_mm"] == 4.0
)
VIEW = ["--stop-mm", "4", "--wavelength-nm", "555", "--v-deg", "-20"]


@pytest.fixture
def eye_file(tmp_path):
    eye = reference()["eye"]
    body = {
        "surfaces": [
            {
                "radius_mm": s["R"],
                "conic_constant": s["k"],
                "z_mm": s["z"],
                "medium_after": s["after"],
            }
            for s in eye["surfaces"]
            if s["name"] != "stop"
        ],
        "stop_z_mm": 3.6,
        "retina": {
            "radius_mm": eye["retina_R_mm"],
            "conic_constant": 0.0,
            "z_mm": eye["retina_z_ESN1999_mm"],
        },
        "indices": None,
    }
    path = tmp_path / "eye.json"
    path.write_text(json.dumps(body), encoding="utf-8")
    return path


def _json(*arguments):
    ended = run_command("wavefront", *arguments, "--json")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("\n") == 1
    return json.loads(ended.stdout)


@pytest.mark.parametrize(("fit", "key"), [("opd", "C_um"), ("slope", "C_slope_um")])
def test_reference_set_through_the_command_line(eye_file, fit, key):
    found = _json(eye_file, *VIEW, "--fit", fit)
    radius_mm = CASE["circle"]["radius_mm"]
    zernike_um = rescale_pupil(
        found["zernike_um"], radius_ratio=radius_mm / found["zernike_radius_mm"]
    )
    assert np.abs(zernike_um - CASE["circle"][key])[1:].max() < 1e-4
    assert 0.0 < found["rms_residual_um"] < 1e-3
    assert found["notes"] == []
    ellipse = found["pupil_ellipse"]
    assert abs(ellipse["ratio"] - CASE["pupil_ellipse"]["ratio"]) < 1e-6


def test_pupil_and_stop_are_told_apart(eye_file):
    view = ["--wavelength-nm", "555"]
    stop = _json(eye_file, "--stop-mm", "4", *view)
    pupil = _json(eye_file, "--pupil-mm", "4", *view)
    assert abs(4.0 / pupil["stop_diameter_mm"] - 1.13325) < 1e-5
    assert pupil["zernike_radius_mm"] < 2.0 < stop["zernike_radius_mm"]


def test_a_near_object_makes_the_eye_hyperopic_by_its_vergence(eye_file):
    view = ["--stop-mm", "1", "--wavelength-nm", "555"]
    far = _json(eye_file, *view)
    near = _json(eye_file, *view, "--object-dpt", "3")
    change_um = near["zernike_um"][4] - far["zernike_um"][4]
    added_dpt = -4 * np.sqrt(3) * change_um / far["zernike_radius_mm"] ** 2
    assert 3.0 < added_dpt < 3.05  # seen at the cornea, 3 mm nearer


@pytest.mark.parametrize("command", ["wavefront", "psf"])
def test_the_notes_of_the_profile_are_printed(eye_file, tmp_path, command):
    body = json.loads(eye_file.read_text(encoding="utf-8"))
    text = "entries of the file without effect: 'Patient'"
    body["notes"] = [{"code": "file_comments", "text": text, "values": {}}]
    eye_file.write_text(json.dumps(body), encoding="utf-8")
    out = ["--pixel-arcmin", "1", "-o", tmp_path / "psf.npy"]
    view = ["--pupil-mm", "4", "--wavelength-nm", "555"]
    ended = run_command(command, eye_file, *view, *(out if command == "psf" else []))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert f"note: {text}\n" in ended.stdout


@pytest.mark.parametrize(
    ("name", "given", "options"),
    [
        ("emmetropia", "--pupil-mm", {"h_deg": 30.0, "v_deg": -10.0}),
        ("astigmatism", "--pupil-mm", {"h_deg": 0.0, "v_deg": 0.0, "focus_dpt": 1.0}),
        ("emmetropia", "--stop-mm", {"h_deg": -20.0, "v_deg": 0.0, "object_dpt": 2.0}),
    ],
)
def test_a_measurement_has_the_wavefront_of_frames(name, given, options):
    """It was that of the eye model alone: 0.7 um of defocus less at 20 deg."""
    words = [(f"--{key.replace('_', '-')}", value) for key, value in options.items()]
    view = ["--wavelength-nm", 555, *(word for pair in words for word in pair)]
    found = _json(name, given, 4, *view)
    pupil_mm = 4.0
    profile = load_profile(name)
    if given == "--stop-mm":
        pupil_mm *= pupil_magnification(eye_model(profile).relaxed)
    state = {"pupil_diameter_mm": pupil_mm, "wavelength_nm": 555.0}
    expected = field_table(profile, **state, **options)
    assert found["zernike_um"] == pytest.approx(expected.zernike_um[0], abs=1e-12)
    assert found["zernike_radius_mm"] == expected.zernike_radius_mm[0]
    ratio = PupilEllipse.of(expected.pupil_ellipse[0]).axis_ratio
    assert found["pupil_ellipse"]["ratio"] == ratio
    assert not any("eye model" in note for note in found["notes"])


def test_slopes_are_those_of_the_eye_model():
    view = ["--pupil-mm", "4", "--wavelength-nm", "555"]
    found = _json("emmetropia", *view, "--fit", "slope")
    assert "--fit opd includes" in " ".join(found["notes"])


def test_a_direction_that_light_does_not_pass_is_a_failure():
    view = ["--pupil-mm", "12", "--wavelength-nm", "555", "--h-deg", "60"]
    code, text = _refused("emmetropia", *view)
    assert code == 1
    assert "h 60 v 0 deg: light passes a pupil of 12 mm only nearer to the a" in text


def test_without_json_it_prints_a_table(eye_file):
    ended = run_command("wavefront", eye_file, *VIEW)
    assert ended.returncode == 0
    assert len(ended.stdout.splitlines()) == 29
    assert "stop diameter 4 mm; at the cornea: circle radius 2.2570 mm" in ended.stdout
    named = run_command("wavefront", eye_file, "--pupil-mm", "4", *VIEW[2:])
    assert "entrance pupil diameter 4 mm; at the cornea: circle ra" in named.stdout


def _refused(*arguments):
    ended = run_command("wavefront", *arguments)
    assert ended.stdout == ""
    assert ended.stderr.count("\n") == 1
    return ended.returncode, ended.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--wavelength-nm", "555"], "--stop-mm, --pupil-mm: allowed: exactly one"),
        (["--stop-mm", "4", "--wavelength-nm", "300"], "--wavelength-nm is 300"),
        ([*VIEW, "--h-deg", "90"], "--h-deg is 90; allowed: -75 to 75"),
        (["--pupil-mm", "0.05", *VIEW[2:]], "--pupil-mm is 0.05; allowed: 0.1 to 12"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(eye_file, arguments, message):
    code, text = _refused(eye_file, *arguments)
    assert code == 2
    assert message in text


def test_surfaces_in_one_state_do_not_accommodate(eye_file):
    facts = _json(eye_file, *VIEW, "--focus-dpt", "2")
    assert "nearer than the near point" in " ".join(facts["notes"])


def test_a_wrong_surface_is_named(eye_file):
    body = json.loads(eye_file.read_text(encoding="utf-8"))
    del body["surfaces"][2]["z_mm"]
    eye_file.write_text(json.dumps(body), encoding="utf-8")
    code, text = _refused(eye_file, *VIEW)
    assert code == 2
    assert "surfaces.2.z_mm" in text


def test_a_lost_chief_ray_is_a_failure_in_words(eye_file):
    body = json.loads(eye_file.read_text(encoding="utf-8"))
    body["surfaces"][1]["clear_radius_mm"] = 0.2
    eye_file.write_text(json.dumps(body), encoding="utf-8")
    code, text = _refused(eye_file, *VIEW)
    assert code == 1
    assert "no chief ray: outside a clear radius" in text


def test_the_45_parameters_are_an_eye_too(tmp_path):
    from estimator.eye.parameters import EyeParameters

    path = tmp_path / "mean.json"
    body = {"kind": "eye", "parameters": EyeParameters.mean_eye().to_mapping()}
    path.write_text(json.dumps(body), encoding="utf-8")
    view = ["--pupil-mm", "4", "--wavelength-nm", "555", "--h-deg", "10"]
    relaxed = _json(path, *view)
    focused = _json(path, *view, "--focus-dpt", "4")
    assert focused["zernike_um"][4] - relaxed["zernike_um"][4] > 0.5


def test_a_measurement_before_surgery_is_not_beside_the_eye_after_it():
    body = {"kind": "preset", "name": "keratoconus"}
    view = ("--pupil-mm", "4", "--wavelength-nm", "555")
    before = _json(json.dumps(body), *view)
    implant = {"kind": "iol", "residual_sphere_dpt": 0}
    after = _json(json.dumps(body | {"correction": implant}), *view)
    assert "measured" in before
    assert "measured" not in after
    j = 4  # (2,0)
    assert abs(after["zernike_um"][j]) < 0.005 < 1.0 < before["zernike_um"][j]
