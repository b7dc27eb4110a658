"""Coordinate breaks of .zmx files: against optiland's rays, and in closed form."""

import json
import math

import numpy as np
import pytest

from estimator.bounded_files import InvalidFile
from estimator.optics.raytrace import RayStatus, trace_rays
from estimator.profiles.files import load_profile, profile_body
from tests.numerical.optiland_eye import (
    FROZEN_BREAKS,
    WAVELENGTH_NM,
    coordinate_break,
)

FILES = json.loads(FROZEN_BREAKS.read_text(encoding="utf-8"))["files"]

BLOCKS = {
    "object": ["TYPE STANDARD", "DISZ INFINITY"],
    "dummy": ["TYPE STANDARD", "DISZ 10"],
    "cornea": ["TYPE STANDARD", "CURV 0.128", "DISZ 3.6", "GLAS X 1 0 1.3375 0 0"],
    "stop": ["TYPE STANDARD", "STOP", "DISZ 0.1", "GLAS X 1 0 1.3375 0 0"],
    "lens": ["TYPE STANDARD", "CURV 0.1", "DISZ 3.9", "GLAS X 1 0 1.42 0 0"],
    "back": ["TYPE STANDARD", "CURV -0.16", "DISZ 16.4", "GLAS X 1 0 1.336 0 0"],
    "retina": ["TYPE STANDARD", "CURV -0.08"],
}
FIELDS = ("z_mm", "decentration_mm", "rotation_deg", "tilt_deg")


def written(folder, *, unit="MM", changes=None, **before):
    """A file of the eye, with blocks of lines in front of its surfaces."""
    text = f"MODE SEQ\nUNIT {unit}\n"
    blocks = []
    for name, lines in BLOCKS.items():
        blocks += [*before.get(name, []), [*lines, *(changes or {}).get(name, [])]]
    for number, lines in enumerate(blocks):
        text += f"SURF {number}\n" + "".join(f"  {line}\n" for line in lines)
    path = folder / "eye.zmx"
    path.write_text(text, encoding="utf-8")
    return path


def eye_in(folder, **parts):
    return load_profile(written(folder, **parts)).surfaces.relaxed


def assert_same_geometry(found, expected):
    assert found.stop_z_mm == pytest.approx(expected.stop_z_mm, abs=1e-12)
    parts = (*found.surfaces, found.retina), (*expected.surfaces, expected.retina)
    for one, other in zip(*parts, strict=True):
        for name in FIELDS:
            value = getattr(other, name)
            assert getattr(one, name) == pytest.approx(value, abs=1e-12), name


@pytest.mark.parametrize("way", ["single", "several"])
@pytest.mark.parametrize("name", FILES)
def test_rays_are_those_of_optiland(tmp_path, name, way):
    """In one break of several parts, in several of one part, with order flags.

    optiland traces in the frame of the file; an eye's z axis is that of the stop.
    """
    kept = FILES[name]
    path = tmp_path / "eye.zmx"
    path.write_text(kept["zmx"][way], encoding="utf-8")
    eye = load_profile(path).surfaces.relaxed
    x, y, z = np.array(kept["stop_axes"])[:, 2]
    about_x, about_y = -math.asin(y), math.atan2(x, z)
    (cx, cy), (sx, sy) = np.cos([about_x, about_y]), np.sin([about_x, about_y])
    axes = np.array([[cy, sy * sx, sy * cx], [0, cx, -sx], [-sy, cy * sx, cy * cx]])

    def of_eye(points_mm):
        return (points_mm - kept["stop_mm"]) @ axes + [0.0, 0.0, eye.stop_z_mm]

    rays = np.array(kept["rays"])
    found = trace_rays(
        eye,
        start_mm=of_eye(rays[:, :3]),
        direction=rays[:, 3:] @ axes,
        wavelength_nm=WAVELENGTH_NM,
    )
    assert np.all(found.status_index == RayStatus.TRACED)
    points_mm = of_eye(np.array(kept["points_mm"]))
    assert np.abs(found.points_mm - points_mm).max() < 1e-12
    assert np.abs(found.path_mm - kept["paths_mm"]).max() < 1e-12


BREAK = ([0.2, -0.1], [3.0, -5.0, 40.0])
UNDONE = ([-0.2, 0.1], [-3.0, 5.0, -40.0])


def test_a_break_is_undone_by_its_negative_with_an_order_flag(tmp_path):
    plain = load_profile(written(tmp_path))
    there, back = coordinate_break(*BREAK), coordinate_break(*UNDONE, order=1)
    found = load_profile(written(tmp_path, cornea=[there, back], lens=[there, back]))
    assert_same_geometry(found.surfaces.relaxed, plain.surfaces.relaxed)
    assert not found.notes
    # without the flag, several tilts do not undo each other
    again = coordinate_break(*UNDONE)
    body = profile_body(written(tmp_path, lens=[there, again]))
    assert max(map(abs, body["surfaces"][1]["tilt_deg"])) > 1.0


@pytest.mark.parametrize(
    ("tilts_deg", "h_deg", "v_deg"),
    # an eye that is turned up by 5 deg has the file's axis 5 deg below its own
    [([5.0, 0.0, 0.0], 0.0, -5.0), ([0.0, 5.0, 0.0], 5.0, 0.0)],
)
def test_a_whole_eye_that_is_tilted_keeps_its_own_axis(
    tmp_path, tilts_deg, h_deg, v_deg
):
    plain = load_profile(written(tmp_path))
    found = load_profile(
        written(tmp_path, cornea=[coordinate_break([0.7, 8.0], tilts_deg)])
    )
    assert_same_geometry(found.surfaces.relaxed, plain.surfaces.relaxed)
    (note,) = found.notes
    assert note.code == "file_axis"
    expected = {"axis_h_deg": h_deg, "axis_v_deg": v_deg}
    assert note.values == pytest.approx(expected, abs=1e-12)
    assert f"its own axis is at h {h_deg:.3f}, v {v_deg:.3f} deg" in note


def test_a_turn_about_the_axis_needs_no_note(tmp_path):
    found = load_profile(
        written(tmp_path, cornea=[coordinate_break([0, 0], [0.0, 0.0, 30.0])])
    )
    assert not found.notes
    assert [s.rotation_deg for s in found.surfaces.relaxed.surfaces] == [
        pytest.approx(30.0)
    ] * 3


def test_the_axis_passes_through_a_decentered_stop(tmp_path):
    there, back = (coordinate_break([s * 0.3, 0.0], [0.0] * 3) for s in (1, -1))
    eye = eye_in(tmp_path, stop=[there], lens=[back])
    shifts_mm = [surface.decentration_mm for surface in (*eye.surfaces, eye.retina)]
    assert shifts_mm == [pytest.approx((-0.3, 0.0))] * 4
    assert eye.surfaces[0].z_mm == 0.0


def test_a_tilted_lens_is_decentered_by_its_depth(tmp_path):
    """Behind a tilt about x by a, the vertex at depth d is at y = -d sin a."""
    back = coordinate_break([0.0, 0.0], [-4.0, 0.0, 0.0])
    eye = eye_in(
        tmp_path,
        lens=[coordinate_break([0.0, 0.0], [4.0, 0.0, 0.0])],
        retina=[back],
    )
    angle = math.radians(4.0)
    front, behind = eye.surfaces[1:]
    assert front.tilt_deg == behind.tilt_deg == pytest.approx((4.0, 0.0))
    assert front.decentration_mm == (0.0, 0.0)
    assert behind.decentration_mm == pytest.approx((0.0, -3.9 * math.sin(angle)))
    assert behind.z_mm == pytest.approx(front.z_mm + 3.9 * math.cos(angle))
    assert eye.retina.tilt_deg == pytest.approx((0.0, 0.0))
    assert eye.retina.decentration_mm == pytest.approx((0.0, -20.3 * math.sin(angle)))


def test_tilts_of_a_surface_are_breaks_around_it(tmp_path):
    """What OpticStudio writes for the tab Tilt/Decenter."""
    there, back = coordinate_break(*BREAK), coordinate_break(*UNDONE, order=1)
    expected = eye_in(tmp_path, lens=[there], back=[back])
    # in the file, a surface lies in front of the break behind it
    changes = {
        "lens": [
            "SCBD 1 0 0 0.2 -0.1 3.0 -5.0 40.0",
            "SCBD 2 1 2 -0.2 0.1 -3.0 5.0 -40.0",
        ]
    }
    found = eye_in(tmp_path, changes=changes)
    assert found.surfaces[1] == expected.surfaces[1]
    assert found.surfaces[2].z_mm == pytest.approx(7.6)
    assert found.surfaces[2].tilt_deg == (0.0, 0.0)


def test_a_break_may_be_the_stop_and_may_return_to_a_surface(tmp_path):
    expected = eye_in(tmp_path)
    lines = ["TYPE COORDBRK", "STOP", "SCBD 3 1 1", "PARM 6 1", "DISZ 0.1"]
    text = written(tmp_path).read_text(encoding="utf-8")
    stop = "  " + "\n  ".join(BLOCKS["stop"])
    assert stop in text
    path = tmp_path / "eye.zmx"
    path.write_text(text.replace(stop, "  " + "\n  ".join(lines)), encoding="utf-8")
    assert_same_geometry(load_profile(path).surfaces.relaxed, expected)


def test_breaks_in_inches(tmp_path):
    inch_mm = 25.4
    changes = {"lens": ["SCBD 1 0 0 0.01 0.02 1.0 0 0"]}
    there = coordinate_break([0.01, -0.004], [2.0, 1.0, 0.0])
    text = written(tmp_path, unit="IN", lens=[there], changes=changes).read_text()
    for inches, mm in (("0.128", 0.128 * inch_mm), ("0.1\n", 0.1 * inch_mm)):
        text = text.replace(f"CURV {inches}", f"CURV {mm}\n")
    for length in ("10", "3.6", "0.1", "3.9", "16.4"):
        text = text.replace(f"DISZ {length}\n", f"DISZ {float(length) / inch_mm}\n")
    path = tmp_path / "eye.zmx"
    path.write_text(text, encoding="utf-8")
    found = load_profile(path).surfaces.relaxed
    changes = {"lens": ["SCBD 1 0 0 0.254 0.508 1.0 0 0"]}
    there = coordinate_break([0.254, -0.1016], [2.0, 1.0, 0.0])
    expected = eye_in(tmp_path, lens=[there], changes=changes)
    assert_same_geometry(found, expected)


def test_an_aperture_of_a_plane_within_the_eye_clips_rays(tmp_path):
    plane = ["TYPE STANDARD", "CLAP 0 1.5 0", "DISZ 0.5", "GLAS X 1 0 1.42 0 0"]
    eye = eye_in(tmp_path, back=[plane])
    depths_mm = [surface.z_mm for surface in eye.surfaces]
    assert depths_mm == pytest.approx([0.0, 3.7, 7.6, 8.1])
    assert [s.clear_radius_mm for s in eye.surfaces] == [math.inf] * 2 + [1.5, math.inf]
    path = written(tmp_path, changes={"dummy": ["CLAP 0 2 0"]})
    with pytest.raises(InvalidFile, match=r"surface 1 .*is an aperture in front of"):
        load_profile(path)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (([0.0, 0.0], [50.0, 0.0, 0.0]), "surface 5 .*tilted by 50 deg against the st"),
        (([0.0, 6.0], [0.0, 0.0, 0.0]), "surface 5 .*lies 6 mm beside the axis.*5 mm"),
        (([0.0, 0.0], [0.0, 180.0, 0.0]), "surface 5 .*tilted by 180 deg"),
    ],
)
def test_what_a_profile_cannot_express_is_refused_by_its_surface(
    tmp_path, parts, message
):
    path = written(tmp_path, lens=[coordinate_break(*parts)])
    with pytest.raises(InvalidFile, match=message):
        load_profile(path)


@pytest.mark.parametrize("value", ["nan", "x", "1e300"])
def test_a_tilt_that_is_no_number_is_refused(tmp_path, value):
    for changes, before in (
        ({}, {"lens": [["TYPE COORDBRK", f"PARM 3 {value}"]]}),
        ({"lens": [f"SCBD 1 0 0 0 0 {value}"]}, {}),
    ):
        path = written(tmp_path, changes=changes, **before)
        with pytest.raises(InvalidFile, match=f"surface . .*'{value}' is not a number"):
            load_profile(path)
