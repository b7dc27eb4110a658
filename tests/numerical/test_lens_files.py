"""Eyes in lens files that optiland wrote, against the rays that it traced."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest

from estimator.bounded_files import InvalidFile
from estimator.optics.raytrace import RayStatus, trace_rays
from estimator.profiles.files import load_profile, profile_body
from estimator.profiles.parse import parse_profile
from estimator.wavefront.aberrations import wavefront_aberrations
from tests.numerical.optiland_eye import FROZEN_FILES, FROZEN_FORMS, WAVELENGTH_NM

FILES = json.loads(FROZEN_FILES.read_text(encoding="utf-8"))["files"]
OLD_FILES = json.loads(
    FROZEN_FILES.with_name("optiland_old_files.json").read_text(encoding="utf-8")
)["files"]
TRACED = json.loads(FROZEN_FORMS.read_text(encoding="utf-8"))["eyes"]


def loaded(tmp_path, name, kind):
    path = tmp_path / f"eye.{kind}"
    content = FILES[name][kind]
    path.write_text(content if kind == "zmx" else json.dumps(content), encoding="utf-8")
    return load_profile(path)


def assert_same_rays(eye, name, limit_mm):
    kept = TRACED[name]
    rays, points = np.array(kept["rays"]), np.array(kept["points_mm"], float)
    complete = np.isfinite(points).all(axis=(1, 2))
    found = trace_rays(
        eye,
        start_mm=rays[complete, :3],
        direction=rays[complete, 3:],
        wavelength_nm=WAVELENGTH_NM,
    )
    assert np.all(found.status_index == RayStatus.TRACED)
    assert np.abs(found.points_mm - points[complete]).max() < limit_mm


@pytest.mark.parametrize("name", FILES)
def test_an_eye_saved_by_optiland_has_its_rays(tmp_path, name):
    """Tilts, decentrations, even aspheres, toroids, biconics and Zernike sags."""
    eye = loaded(tmp_path, name, "json").surfaces.relaxed
    assert len(eye.surfaces) == 4
    assert_same_rays(eye, name, 1e-12)


@pytest.mark.parametrize("version", OLD_FILES)
def test_an_eye_saved_by_an_older_optiland_has_its_rays(tmp_path, version):
    path = tmp_path / "eye.json"
    path.write_text(json.dumps(OLD_FILES[version]["json"]), encoding="utf-8")
    eye = load_profile(path).surfaces.relaxed
    assert_same_rays(eye, OLD_FILES[version]["eye"], 1e-12)


def test_a_zemax_file_of_optiland_has_its_rays(tmp_path):
    eye = loaded(tmp_path, "even asphere, centered", "zmx").surfaces.relaxed
    for name, medium in eye.media.items():
        # optiland writes constant indices with the Abbe number 99.99
        eye.media[name] = type(medium)(medium.d_line_index, 1e9)
    assert_same_rays(eye, "even asphere, centered", 1e-9)


ZMX = """\
MODE SEQ
NAME Schematic eye
UNIT MM X W X CM MR CPMM
SURF 0
  TYPE STANDARD
  CURV 0.0
  DISZ INFINITY
SURF 1
  COMM in front of the eye
  TYPE STANDARD
  CURV 0.0
  DISZ 10
SURF 2
  TYPE STANDARD
  CURV 0.1282051 0 0 0 0
  DISZ 3.6
  CONI -0.25
  GLAS ___BLANK 1 0 1.3375 0 0 0 0 0 0 0
SURF 3
  STOP
  TYPE STANDARD
  CURV 0.0
  DISZ 0.1
  DIAM 2 1 0 0 1 ""
  GLAS ___BLANK 1 0 1.3375 0 0 0 0 0 0 0
SURF 4
  TYPE COORDBRK
  PARM 1 0.2
  PARM 2 -0.1
  DISZ 0
SURF 5
  TYPE STANDARD
  CURV 0.1
  DISZ 3.9
  CLAP 0 4.5 0
  GLAS ___BLANK 1 0 1.42 50 0 0 0 0 0 0
SURF 6
  TYPE STANDARD
  CURV -0.16667
  DISZ 16.4
  GLAS ___BLANK 1 0 1.336 0 0 0 0 0 0 0
SURF 7
  TYPE STANDARD
  CURV -0.08
  DISZ 0
"""


ENCODINGS = ["utf-8", "utf-16", "utf-16-le", "utf-16-be", "latin-1"]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_dummy_surfaces_are_dropped_and_the_stop_is_kept(tmp_path, encoding):
    path = tmp_path / "eye.zmx"
    path.write_bytes(ZMX.encode(encoding))
    profile = load_profile(path)
    eye = profile.surfaces.relaxed
    assert profile.name == "Schematic eye"
    assert [s.z_mm for s in eye.surfaces] == pytest.approx([0.0, 3.7, 7.6])
    assert eye.stop_z_mm == pytest.approx(3.6)
    assert eye.surfaces[0].conic_constant == -0.25
    assert eye.surfaces[1].decentration_mm == (0.2, -0.1)
    assert [s.clear_radius_mm for s in eye.surfaces] == [math.inf, 4.5, math.inf]
    assert eye.retina.z_mm == pytest.approx(24.0)
    assert eye.retina.radius_mm == pytest.approx((-12.5, -12.5))
    lens = eye.media[eye.surfaces[1].medium_after]
    assert (lens.d_line_index, lens.abbe_number) == (1.42, 50.0)


OPERANDS = """\
  SSID 3
  FIMP

  COAT AR
  SCOL 4 0
  TCED 23.5 0 0
  HIDE 0 0 0 0 0 0 0 0 0 0 0 0 0
  MIRR 2 0
  SLAB 1
  VDSZ 0 0
  PZUP 5.0 1 0 0
  MAZH 0 0
  MEMA 10.4 0 0 0 1 ""
  POPS 0 0 0 0 0 0 0 0 1 1 1 1 0 0 0 0
"""
ENDING = """\
BLNK
EFFL 0 2 0 0 0 0 17 1 0 0
OPDX 0 1 0 9.2E-1 -1.E-1 -9.E-1 0 2.0E-1 0 0
TOL TOFF   0   0 0.0000000000000000E+00 0.0000000000000000E+00   0 0 0 0 0
MNUM {configurations} 2
MOFF   0   1 "" 0 0 0 1 1 0 0.0 "" 0
THIC   2   1 0.5 0 0 1 1 1 0 0.0 "" 0
"""
"""What OpticStudio writes in every surface, and behind the last one."""


@pytest.mark.parametrize("count", ["1", "x", "", "9" * 5000])
def test_one_configuration_needs_no_note(tmp_path, count):
    path = tmp_path / "eye.zmx"
    path.write_text(ZMX + ENDING.format(configurations=count), encoding="utf-8")
    assert not load_profile(path).notes


@pytest.mark.parametrize("indented", [True, False])
def test_operands_without_effect_on_rays_are_ignored(tmp_path, indented):
    text = ZMX.replace("  TYPE STANDARD\n", f"  TYPE STANDARD\n{OPERANDS}")
    text += ENDING.format(configurations=2)
    if not indented:  # only the names tell where the surfaces end
        text = "".join(line.lstrip() for line in text.splitlines(keepends=True))
    plain, path = tmp_path / "plain.zmx", tmp_path / "eye.zmx"
    plain.write_text(ZMX, encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    expected, found = load_profile(plain), load_profile(path)
    assert found.digest == expected.digest
    assert not expected.notes
    (note,) = found.notes
    assert note == "the file has 2 configurations: number 2 is used"
    assert note.code == "file_configurations"
    assert note.values == {"configuration_count": 2, "configuration_index": 2}


def test_partial_dispersions_are_named_in_a_note(tmp_path):
    path = tmp_path / "eye.zmx"
    text = ZMX.replace("1.42 50 0", "1.42 50 0.01").replace(
        "1.336 0 0", "1.336 0 -0.02"
    )
    path.write_text(text, encoding="utf-8")
    (note,) = load_profile(path).notes
    assert note.endswith("partial dispersion is not used: glass of surface 5, 6")
    assert (note.code, note.values) == (
        "file_dispersion",
        {"partial_dispersion_ratio": -0.02},
    )


@pytest.mark.parametrize(
    ("kind", "x_mm", "form"),
    [
        ("BICONICX", 9.5, {"kind": "two_conics", "conic_constants": [-0.4, -1.5]}),
        ("TOROIDAL", 9.5, {"kind": "toroid"}),
        ("TOROIDAL", 0.0, {"kind": "toroid"}),
    ],
)
def test_a_surface_with_two_radii_has_that_along_y_in_curv(tmp_path, kind, x_mm, form):
    path = tmp_path / "eye.zmx"
    changed = f"TYPE {kind}\n  CURV 0.1\n  CONI -1.5\n  PARM 1 {x_mm}\n"
    changed += "  PARM 2 -0.4\n" if kind == "BICONICX" else ""
    text = ZMX.replace("TYPE STANDARD\n  CURV 0.1\n", changed)
    path.write_text(text, encoding="utf-8")
    body = profile_body(path)
    surface = body["surfaces"][1]
    assert surface["radius_mm"] == [x_mm or None, 10.0]
    assert (surface["conic_constant"], surface["form"]) == (-1.5, form)
    # as the same eye in JSON
    assert load_profile(path).digest == parse_profile(body).digest


def test_an_aperture_of_the_retina_is_ignored(tmp_path):
    plain, path = tmp_path / "plain.zmx", tmp_path / "eye.zmx"
    plain.write_text(ZMX, encoding="utf-8")
    path.write_text(ZMX + "  CLAP 0 9 0\n", encoding="utf-8")
    assert load_profile(path).digest == load_profile(plain).digest


def test_a_surface_without_a_type_is_a_conic(tmp_path):
    plain, path = tmp_path / "plain.zmx", tmp_path / "eye.zmx"
    plain.write_text(ZMX, encoding="utf-8")
    path.write_text(ZMX.replace("  TYPE STANDARD\n", ""), encoding="utf-8")
    assert load_profile(path).digest == load_profile(plain).digest


@pytest.mark.parametrize(
    ("unit", "unit_mm"), [("IN", 25.4), ("CM", 10.0), ("METER", 1000.0)]
)
def test_lengths_in_other_units_are_converted(tmp_path, unit, unit_mm):
    asphere = "TYPE EVENASPH\n  PARM 1 0.002\n  PARM 3 1E-05\n  CURV 0.1\n"
    in_mm = ZMX.replace("TYPE STANDARD\n  CURV 0.1\n", asphere)
    biconic = "TYPE BICONICX\n  PARM 1 -7.0\n  PARM 2 -0.5\n  CURV -0.16667\n"
    in_mm = in_mm.replace("TYPE STANDARD\n  CURV -0.16667\n", biconic)

    def converted(match):
        operand, value = match[1], float(match[2])
        power = {"CURV ": 1, "PARM 3 ": 5}.get(operand, -1)
        if (operand, value) == ("PARM 1 ", 0.002):
            power = 1
        if (operand, value) == ("PARM 2 ", -0.5):  # a conic constant
            power = 0
        return f"{operand}{value * unit_mm**power!r}"

    lengths = r"(CURV |DISZ |DIAM |CLAP 0 |PARM [123] )(-?[0-9.E-]+)"
    in_unit = re.sub(lengths, converted, in_mm).replace("UNIT MM", f"UNIT {unit}")
    eyes = []
    for text in (in_mm, in_unit):
        path = tmp_path / "eye.zmx"
        path.write_text(text, encoding="utf-8")
        eyes.append(load_profile(path).surfaces.relaxed)
    mm, other = eyes
    assert other.stop_z_mm == pytest.approx(mm.stop_z_mm)
    for one, two in zip(
        (*mm.surfaces, mm.retina), (*other.surfaces, other.retina), strict=True
    ):
        for field in dataclasses.fields(one):
            expected, found = getattr(one, field.name), getattr(two, field.name)
            if isinstance(expected, float | tuple):
                assert found == pytest.approx(expected, rel=1e-12), field.name
    state = {"wavelength_nm": 555.0, "stop_diameter_mm": 3.0, "h_deg": 10.0}
    expected, found = (wavefront_aberrations(eye, **state) for eye in eyes)
    assert found.zernike_um == pytest.approx(expected.zernike_um, abs=1e-9)


def test_a_floating_aperture_has_the_semi_diameter(tmp_path):
    path = tmp_path / "eye.zmx"
    text = ZMX.replace("CLAP 0 4.5 0", "DIAM 4.25 0 0 0 1\n  FLAP 0 4.5 0")
    path.write_text(text, encoding="utf-8")
    eye = load_profile(path).surfaces.relaxed
    assert [s.clear_radius_mm for s in eye.surfaces] == [math.inf, 4.25, math.inf]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("MODE SEQ", "MODE NSC", "MODE.*'NSC' is not sequential"),
        ("UNIT MM", "UNIT FURLONG", "UNIT.*'FURLONG'.*MM, CM, IN, METER"),
        ("TYPE STANDARD\n  CURV 0.1\n", "TYPE ODDASPHE\n  CURV 0.1\n", "'ODDASPHE'"),
        (
            "TYPE STANDARD\n  CURV 0.1\n",
            "TYPE TOROIDAL\n  PARM 1 9\n  PARM 3 1E-5\n  CURV 0.1\n",
            "surface 5 .*TOROIDAL with other terms",
        ),
        ("CLAP 0 4.5", "CLAP 1 4.5", "CLAP with an inner radius"),
        ("CURV 0.1\n", "CURV 0.1\n  XDAT 1 2\n", "operand 'XDAT'"),
        ("CURV 0.1\n", "CURV 0.1\n  SCBD 4 0 0 9 0\n", "operand 'SCBD 4'"),
        ("DISZ INFINITY", "DISZ INFINITY\n  GLAS ___BLANK 1 0 1.3 0", "surface 0.*air"),
        ("CLAP 0 4.5", "FLAP 0 0", "FLAP with an inner radius, or without"),
        ("CURV 0.1\n", "CURV nan\n", "CURV 'nan' is not a number"),
        ("___BLANK 1 0 1.42", "N-BK7 0 0 1.5", "'N-BK7' is in a catalog"),
        ("___BLANK 1 0 1.42", "MIRROR 0 0 1.5", "surface 5 .*is a mirror"),
        ("  STOP\n", "", "the file has no stop"),
        ("DISZ 3.9", "DISZ 900", r"z_mm.*out of range"),
    ],
)
def test_what_is_not_understood_is_refused_by_name(tmp_path, before, after, message):
    path = tmp_path / "eye.zmx"
    assert before in ZMX
    path.write_text(ZMX.replace(before, after), encoding="utf-8")
    with pytest.raises(InvalidFile, match=message):
        load_profile(path)


@pytest.mark.parametrize("place", ["shifted", "tilted"])
def test_the_axis_is_that_of_the_stop(tmp_path, place):
    plain = load_profile(_written(tmp_path, lambda data: data))
    stop = {"shifted": {"x": 0.3}, "tilted": {"ry": math.radians(4.0)}}[place]

    def moved(data):
        data["surface_group"]["surfaces"][3]["geometry"]["cs"].update(stop)
        return data

    found = load_profile(_written(tmp_path, moved))
    cornea = found.surfaces.relaxed.surfaces[0]
    if place == "shifted":
        assert cornea.decentration_mm == pytest.approx((-0.3, 0.0))
        assert not found.notes
        return
    stop_mm = plain.surfaces.relaxed.stop_z_mm
    assert cornea.tilt_deg == pytest.approx((0.0, -4.0))
    x_mm = stop_mm * math.sin(math.radians(4.0))
    assert cornea.decentration_mm == pytest.approx((x_mm, 0.0))
    assert found.notes[0].values == pytest.approx({"axis_h_deg": 4, "axis_v_deg": 0})


def _written(folder, change):
    data = json.loads(json.dumps(FILES["tilted conic"]["json"]))
    path = folder / "eye.json"
    path.write_text(json.dumps(change(data)), encoding="utf-8")
    return path


def _change(surface, **parts):
    def apply(data):
        entry = data["surface_group"]["surfaces"][surface]
        for name, value in parts.items():
            entry[name] = {**entry[name], **value} if isinstance(value, dict) else value
        return data

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_change(1, type="ParaxialSurface"), "surface 1.*'ParaxialSurface'"),
        (_change(1, geometry={"type": "ForbesGeometry"}), "'ForbesGeometry'"),
        (
            _change(2, material_post={"type": "Material", "name": "SK16"}),
            "surface 2.*'SK16' is in a catalog, not in the file",
        ),
        (
            lambda d: {
                "surface_group": {
                    "surfaces": [
                        *d["surface_group"]["surfaces"][:-1],
                        FILES["offset"]["json"]["surface_group"]["surfaces"][1],
                    ]
                }
            },
            "surface 6.*Zernike terms of the retina",
        ),
        (_change(0, material_post={"index": 1.33}), "surface 0.*is not air"),
        (_change(2, type="ImageSurface"), "surface 2.*'ImageSurface'"),
        (_change(2, is_reflective=True), "surface 2.*is_reflective: true"),
        (
            lambda d: _change(1, interaction_model=None)(d),
            "surface 1.*interaction_model: None is not an object",
        ),
        (_change(2, interaction_model={"is_reflective": True}), "surface 2"),
        (_change(1, geometry={"cs": None}), "surface 1.*cs: None is not an object"),
        (_change(1, geometry={"radius": "7"}), "surface 1.*radius: '7'"),
        (_change(1, geometry={"radius": [12, {}]}), r"surface 1.*radius: \[12, \{\}\]"),
        (_change(2, geometry={"conic": 1e308}), r"surface 2.*conic: 1e\+308"),
        (lambda d: {"surface_group": 3}, "surface_group: 3 is not an object"),
        (lambda d: {"surface_group": {}}, "surface_group: 'surfaces' is missing"),
        (lambda d: {"surface_group": {"surfaces": []}}, "the file has 0"),
    ],
)
def test_an_optic_that_is_not_understood_is_refused(tmp_path, change, message):
    path = _written(tmp_path, change)
    with pytest.raises(InvalidFile, match=message):
        load_profile(path)
