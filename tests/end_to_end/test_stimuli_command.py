"""`ocufilter stimuli`: pictures of known parameters, and what eyes see of them."""

import hashlib
import json
import math
import re
from datetime import datetime

import numpy as np
import pytest
from PIL import Image

from clients.provenance import METADATA_KEY, code_version
from filter_service.image_files import read_color
from ocufilter import EyeFilter, FilterSettings, stimuli
from tests.commands import run_command

PERSON = json.dumps({"kind": "prescription", "sphere_dpt": 0.0})
SMALL = ("--size", "48x40", "--pixel-arcmin", "0.5")
QUICK = ("--settings", '{"mode": "on-axis"}', "--workers", 1)


def run(*arguments, code=0):
    finished = run_command("stimuli", *arguments)
    assert finished.returncode == code, finished.stderr
    return finished.stdout if code == 0 else finished.stderr


def listing(out):
    return json.loads((out / "stimuli.json").read_text())


@pytest.mark.long("fifteen stimuli are drawn")
def test_pictures_and_their_listing(tmp_path):
    out = tmp_path / "out"
    told = run(
        *("--letters", "CK", "--height-arcmin", "8,10", "--tumbling-e", "90"),
        *("--grating-cpd", "6", "--contrast", "0.2,0.8", "--gabor-cpd", "9"),
        *("--gabor-sd-arcmin", 3, "--edge", "--noise", "1,2", "--text", "o"),
        *("--x-height-arcmin", "4", "--white-nit", 100, *SMALL, "-o", out),
    )
    assert "15 stimuli of 48x40 px, 0.5 arcmin per pixel" in told
    found = listing(out)
    assert found["made_by"] == code_version()
    assert found["displays"]["display"] == {
        "width_px": 48,
        "height_px": 40,
        "pixel_arcmin": 0.5,
        "white_nit": 100.0,
    }
    files = {path.relative_to(out).as_posix() for path in out.glob("originals/*")}
    assert files == {one["file"] for one in found["stimuli"].values()}
    for name, one in found["stimuli"].items():
        content = (out / one["file"]).read_bytes()
        assert one["bytes"] == len(content)
        assert one["sha256"] == hashlib.sha256(content).hexdigest()
        with Image.open(out / one["file"]) as image:
            metadata = json.loads(image.text[METADATA_KEY])
        assert metadata["stimulus"]["name"] == name
        assert metadata["pixel_arcmin"] == 0.5
    grating = found["stimuli"]["sine_6cpd_0deg_0deg_0.8"]
    assert grating["measured"]["most_nit"] == pytest.approx(90.0, rel=0.01)
    drawn = read_color(out / grating["file"])
    display = stimuli.Display(width_px=48, height_px=40, pixel_arcmin=0.5)
    np.testing.assert_array_equal(
        drawn, stimuli.grating(6.0, display=display, contrast=0.8).srgb
    )


@pytest.mark.long("four commands")
def test_a_folder_of_other_stimuli_is_kept_unless_told(tmp_path):
    out = tmp_path / "out"
    first = ("--letters", "C", "--height-arcmin", "8", *SMALL, "-o", out)
    run(*first)
    run(*first)
    other = ("--letters", "D", "--height-arcmin", "8", *SMALL, "-o", out)
    assert "contains other stimuli" in run(*other, code=2)
    run(*other, "--overwrite")
    (path,) = out.glob("originals/*")
    assert path.name == "sloan_D_8arcmin.png"


@pytest.mark.clients
@pytest.mark.long("eyes of two persons are prepared by a worker")
def test_people_pupils_and_foci_see_what_the_filter_shows(tmp_path):
    out = tmp_path / "out"
    arguments = (
        *("--letters", "C", "--height-arcmin", "8", *SMALL, "--distance-m", "2"),
        *("-p", f"p={PERSON}", "--people", 2, "--pupil-mm", "3,5", *QUICK, "-o", out),
    )
    told = run(*arguments)
    assert "4 of 4 images, 4 of them in this run" in told
    assert "largest kernel" not in told
    seen = read_color(out / "p_1/pupil5mm/sloan_C_8arcmin.png")
    display = stimuli.Display(width_px=48, height_px=40, pixel_arcmin=0.5)
    letter = stimuli.sloan_letters("C", height_arcmin=8.0, display=display)
    settings = FilterSettings(mode="on-axis", object_planes_dpt=(0.5,))
    state = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5, "render_tolerance": 0.0}
    with EyeFilter(
        json.loads(PERSON) | {"sample": 1}, display.camera, settings, engine="native"
    ) as eye:
        eye.wait()
        depth_m = np.full((40, 48), 2.0, np.float32)
        expected = eye.filter(letter.srgb, depth_m, **state).color
    np.testing.assert_array_equal(seen, expected)
    shown = {
        "stimulus": {"name": letter.name, **letter.parameters},
        "pixel_arcmin": 0.5,
        "margin_arcmin": 6.0,  # 40 px of 0.5 arcmin, less 8 arcmin, on both sides
    }
    with Image.open(out / "p_1/pupil5mm/sloan_C_8arcmin.png") as image:
        metadata = json.loads(image.text[METADATA_KEY])
    told_of_view = {
        "distance_m": 2.0,
        "distance_dpt": 0.5,
        "sample": 1,
        "display_nm": [618.0, 536.0, 453.0],
        "render_tolerance": 0.0,
    }
    assert metadata.items() >= (shown | told_of_view).items()
    lines = map(json.loads, (out / "manifest.jsonl").read_text().splitlines()[1:])
    assert all(line["source"].items() >= shown.items() for line in lines)
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["made_by"] == code_version()
    assert manifest["source"]["displays"]["display"]["pixel_arcmin"] == 0.5
    assert "sloan_C_8arcmin" in manifest["source"]["stimuli"]
    assert set(manifest["profiles"]) == {"p_0", "p_1"}
    assert manifest["settings"]["object_planes_dpt"] == [0.5]
    assert datetime.fromisoformat(manifest["created"]).tzinfo is not None
    assert manifest["argv"][:3] == ["ocufilter", "stimuli", "--letters"]
    assert manifest["display_nm"] == [618.0, 536.0, 453.0]
    assert "drawn with sample 1" in " ".join(manifest["eye_notes"]["p_1"])
    assert "4 of 4 images, 0 of them in this run" in run(*arguments)
    resumed = json.loads((out / "manifest.json").read_text())
    for name in ("created", "argv", "eye_notes"):
        assert resumed[name] == manifest[name]


@pytest.mark.clients
@pytest.mark.long("an eye is prepared by a worker")
def test_a_screen_has_other_pixels_at_each_distance(tmp_path):
    out = tmp_path / "out"
    run(
        *("--grating-cpd", "3", "--size", "48x40", "--distance-m", "0.5,1"),
        *("--screen-width-mm", 531, "--screen-width-px", 1920, *QUICK),
        *("-p", f"p={PERSON}", "--pupil-mm", "3", "-o", out),
    )
    near_arcmin = listing(out)["displays"]["distance0.5m"]["pixel_arcmin"]
    assert near_arcmin == pytest.approx(60 * math.degrees(0.531 / 1920 / 0.5), rel=1e-4)
    found = {path.relative_to(out / "p").as_posix() for path in out.glob("p/*/*")}
    name = "sine_3cpd_0deg_0deg_0.5"
    assert found == {f"distance{m}m/{name}.png" for m in (0.5, 1)}
    lines = (out / "manifest.jsonl").read_text().splitlines()
    focused = {
        record["frame"]: (record["pupil_mm"], record["focus_dpt"])
        for record in map(json.loads, lines[1:])
    }
    assert focused[f"distance0.5m/{name}"] == pytest.approx((3.0, 2.0))
    assert focused[f"distance1m/{name}"] == pytest.approx((3.0, 1.0))


@pytest.mark.clients
@pytest.mark.long("an eye is prepared by a worker")
def test_blur_beyond_the_margin_is_noted(tmp_path):
    myopic = '{"kind": "prescription", "sphere_dpt": -6, "higher_order": "none"}'
    told = run(
        *("--letters", "C", "--height-arcmin", "8", *SMALL, "--distance-m", "4"),
        *("-p", f"p={myopic}", "--pupil-mm", "0.5,5", *QUICK, "-o", tmp_path / "out"),
    )
    (note,) = [line for line in told.splitlines() if "exceeds the margin" in line]
    radius, margin = map(float, re.findall(r"of (?:radius )?([\d.]+) arcmin", note))
    # The entrance pupil is about 3 mm behind the cornea.
    defocus_dpt = 6.0 / (1.0 + 0.003 * 6.0) - 0.25
    expected_arcmin = 60.0 * math.degrees(2.5 * defocus_dpt / 1000.0)
    assert radius == pytest.approx(expected_arcmin, rel=0.01)
    assert margin == 6.0


def test_steps_of_8_bits_are_noted_and_absent_from_exr(tmp_path):
    faint = ("--grating-cpd", "6", "--contrast", "0.02", *SMALL)
    assert "steps of 8-bit sRGB" in run(*faint, "-o", tmp_path / "png")
    told = run(*faint, "--format", "exr", "-o", tmp_path / "exr")
    assert "steps of 8-bit" not in told
    (path,) = (tmp_path / "exr/originals").iterdir()
    light = read_color(path)
    assert np.ptp(light) == pytest.approx(0.02, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "no stimulus is given"),
        (("--letters", "C"), "--height-arcmin is not given, but an optotype needs it"),
        (("--text", "o"), "--x-height-arcmin is not given, but --text needs it"),
        (("--letters", "CC", "--height-arcmin", "8"), "drawn twice"),
        (("--grating-cpd", "70"), "frequency_cpd is 70 with pixels of 0.5 arcmin"),
        (("--grating-cpd", "six"), "--grating-cpd is 'six'; allowed: a number"),
        (("--noise", "1.5"), "--noise is 1.5; allowed: integers"),
        (("--edge", "--people", "2"), "--profile is not given, but --people needs it"),
        (("--edge", "-p", "myopia"), "--distance-m is not given, but --profile"),
        (("--edge", "--screen-width-mm", "500"), "one of them is given"),
        (
            (
                *("--edge", "--screen-width-mm", "500", "--screen-width-px", "1000"),
                *("--distance-m", "1"),
            ),
            "pixel_arcmin is 0.5, but a pixel of 500 mm / 1000 px at 1 m is 1.7189",
        ),
    ],
)
def test_bad_input_is_refused_in_a_line(tmp_path, arguments, words):
    told = run(*arguments, *SMALL, "-o", tmp_path / "out", code=2)
    assert words in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_size_of_pixels_is_required(tmp_path):
    told = run("--edge", "-o", tmp_path / "out", code=2)
    assert "--pixel-arcmin is not given" in told
