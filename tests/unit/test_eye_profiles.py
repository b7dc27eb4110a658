"""Profiles that hold an eye, several measurements, or a retina."""

import json
import subprocess
import sys

import numpy as np
import pytest

from estimator.eye.parameters import EyeParameters, RetinaShape
from estimator.optics.zernike import flip_horizontal
from estimator.profiles.parse import ProfileError, parse_profile, preset_names
from tests.source_tree import ROOT

ONE = {"pupil_diameter_mm": 4, "wavelength_nm": 555, "zernike_um": {"2,0": 1.0}}
EYE = {"kind": "eye", "parameters": EyeParameters.mean_eye().to_mapping()}


def a_set(*measurements, **more):
    return {"kind": "zernike_set", "measurements": list(measurements), **more}


def test_a_set_leads_with_its_widest_axial_measurement():
    wide = ONE | {"pupil_diameter_mm": 6, "zernike_um": {"2,0": 3.0}}
    side = ONE | {"h_deg": 20, "v_deg": -5}
    profile = parse_profile(a_set(side, ONE, wide))
    assert profile.kind == "zernike_set"
    assert profile.zernike_um[4] == 3.0
    assert profile.pupil_diameter_mm == profile.max_pupil_diameter_mm == 6.0
    assert [m.pupil_diameter_mm for m in profile.measurements] == [6.0, 4.0, 4.0]
    assert (profile.measurements[1].h_deg, profile.measurements[1].v_deg) == (20, -5)
    assert [m.is_on_axis for m in profile.measurements] == [True, False, True]


def test_frame_of_a_set_holds_for_all_unless_one_says_otherwise():
    coma = ONE | {"zernike_um": {"3,1": 0.2}}
    elsewhere = coma | {"frame": "eye", "h_deg": 10.0}
    profile = parse_profile(a_set(coma, elsewhere, frame="examiner"))
    examiner, eye = (m.zernike_um for m in profile.measurements)
    assert np.array_equal(examiner, flip_horizontal(eye))


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"kind": "zernike_set"}, "measurements"),
        (a_set(), "measurements"),
        (a_set(ONE | {"h_deg": 20}), "measurements"),
        (a_set(ONE, ONE | {"v_deg": 80}), "measurements.1.v_deg"),
        (a_set(ONE, {}), "measurements.1.wavelength_nm"),
        (a_set(ONE, {"wavelength_nm": 555}), "measurements.1.zernike_um"),
        (a_set(ONE | {"zernike_um": {"11,1": 1}}), "measurements.0.zernike_um.11,1"),
        (a_set(ONE | {"sphere_dpt": 1}), "measurements.0.sphere_dpt"),
        (a_set(ONE | {"kind": "eye"}), "measurements.0.kind"),
        (a_set(3), "measurements.0"),
        ({"kind": "eye"}, "parameters"),
        ({"kind": "eye", "parameters": {}}, "parameters.eye_length_mm"),
        (EYE | {"retina": {"radius_mm": 2}}, "retina.radius_mm"),
        (EYE | {"retina": {"conic_constant": 0}}, "retina.radius_mm"),
        (EYE | {"retina": {"radius_mm": 12, "k": 0}}, "retina.k"),
    ],
)
def test_bad_bodies_name_their_field(body, field):
    with pytest.raises(ProfileError) as caught:
        parse_profile(body)
    assert caught.value.field == field


def test_an_eye_keeps_its_parameters_and_traces_its_wavefront():
    profile = parse_profile(EYE | {"age_years": 30})
    assert profile.eye.to_mapping() == EYE["parameters"]
    assert profile.age_years == 30
    assert profile.measurements == ()
    # the mean eye is about 0.7 dpt hyperopic with negative spherical aberration
    assert profile.zernike_um[4] < 0.0
    assert profile.zernike_um[12] < 0.0


def test_every_kind_takes_a_retina():
    retina = {"radius_mm": 12.0, "conic_constant": -0.2}
    bodies = [
        {"kind": "preset", "name": preset_names()[0]},
        {"kind": "prescription", "sphere_dpt": -2},
        {"kind": "zernike", **ONE},
        a_set(ONE),
        EYE,
    ]
    for body in bodies:
        assert parse_profile(body).retina is None
        assert parse_profile({**body, "retina": retina}).retina == RetinaShape(12, -0.2)


def test_single_measurements_are_their_own_set():
    for body in ({"kind": "zernike", **ONE}, {"kind": "prescription", "sphere_dpt": 1}):
        profile = parse_profile(body)
        (only,) = profile.measurements
        assert only.zernike_um is profile.zernike_um
        assert only.is_on_axis


def test_a_given_eye_is_read_without_tracing_it():
    script = (
        "import json, sys\n"
        "from estimator.profiles.parse import parse_profile\n"
        "profile = parse_profile(json.loads(sys.argv[1]))\n"
        "sys.exit('estimator.wavefront.aberrations' in sys.modules"
        " or 'zernike_um' in vars(profile))"
    )
    command = [sys.executable, "-c", script, json.dumps(EYE)]
    assert subprocess.run(command, cwd=ROOT).returncode == 0
