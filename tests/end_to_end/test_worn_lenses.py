"""Worn lenses through the program and the filter, by every engine."""

import json

import numpy as np
import pytest

from clients.commands.program import app
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from estimator.psf.compute import compute_psfs
from filter_service import Camera, EyeFilter, FilterSettings
from filter_service.command_line import exit_code
from filter_service.image_files import write_image

PUPIL_MM = 3.4
BIFOCAL = {
    "kind": "prescription",
    "sphere_dpt": 0.0,
    "correction": {
        "kind": "iol",
        "design": "bifocal",
        "add_dpt": 3.0,
        "cornea_spherical_aberration_um": 0.0,
    },
}
CAMERA = Camera.from_fov(8.0, width_px=96, height_px=96)
MIDDLE = 48
RADIUS_PX = 12
GREEN_NM = 536.0


def true_kernel(object_dpt):
    """Kernel (25, 25) of green light, computed for that distance alone."""
    eye = MeasuredWavefront.from_profile(parse_profile(BIFOCAL))
    state = eye.state(
        pupil_diameter_mm=PUPIL_MM,
        object_dpt=object_dpt,
        focus_dpt=0.0,
        wavelength_nm=GREEN_NM,
    )
    psf = compute_psfs(
        state.zernike_um[None],
        pupil_diameter_mm=PUPIL_MM,
        wavelength_nm=GREEN_NM,
        pixel_pitch_mrad=CAMERA.pixel_pitch_mrad,
        pupil_screen=eye.rings,
    )[0]
    found = np.zeros((2 * RADIUS_PX + 1,) * 2)
    cut = min(psf.radius_px, RADIUS_PX)
    inside = slice(RADIUS_PX - cut, RADIUS_PX + cut + 1)
    middle = slice(psf.radius_px - cut, psf.radius_px + cut + 1)
    found[inside, inside] = psf.kernel[middle, middle]
    return found


@pytest.mark.parametrize("by", ["native", pytest.param("gl", marks=pytest.mark.gl)])
@pytest.mark.long("an eye with two foci is computed over pupils and distances")
def test_a_point_is_seen_through_all_foci(by):
    """Between the nodes of the cache too, in pupil and distance."""
    color = np.zeros((96, 96, 3), np.float32)
    color[MIDDLE, MIDDLE] = 1.0
    settings = FilterSettings(
        mode="on-axis",
        eye_model="wavefront",
        pupil_range_mm=(3.0, 4.0),
        object_range_dpt=(0.0, 3.0),
    )
    with EyeFilter(BIFOCAL, CAMERA, settings, engine=by) as eye_filter:
        eye_filter.wait()
        # Between the foci light swings with the pupil, faster than its nodes lie.
        for object_dpt, limit in ((0.02, 0.05), (1.0, 0.12), (2.15, 0.05)):
            depth_m = np.full((96, 96), 1.0 / object_dpt, np.float32)
            seen = eye_filter.filter(
                color,
                depth_m,
                pupil_diameter_mm=PUPIL_MM,
                focus_dpt=0.0,
                output="linear",
            ).color
            near = slice(MIDDLE - RADIUS_PX, MIDDLE + RADIUS_PX + 1)
            expected = true_kernel(object_dpt)
            error = np.abs(np.asarray(seen)[near, near, 1] - expected).max()
            assert error < limit * expected.max(), object_dpt


@pytest.mark.long("an eye with two foci is built three times")
def test_a_frame_through_two_foci_does_not_depend_on_earlier_ones():
    """Nor on preparation: tables of the lens once ended at the widest pupil so far."""
    color = np.random.default_rng(2).random((24, 32, 3)).astype(np.float32)
    depth_m = np.full((24, 32), 0.5, np.float32)
    camera = Camera.from_fov(3.0, width_px=32, height_px=24)
    pupils_mm = [3.1, 4.9]

    def images(prepare, order):
        settings = {
            "mode": "on-axis",
            "eye_model": "wavefront",
            "prepare": prepare,
            "focus_range_dpt": (0.0, 0.0),
            "object_range_dpt": (1.9, 2.1),
            "pupil_range_mm": (3.0, 5.0),
        }
        with EyeFilter(BIFOCAL, camera, settings, engine="native") as eye_filter:
            found = [
                eye_filter.filter(
                    *(color, depth_m),
                    pupil_diameter_mm=pupil_mm,
                    focus_dpt=0.0,
                    output="linear",
                    whole=True,
                ).color
                for pupil_mm in pupils_mm[::order]
            ]
        return found[::order]

    with EyeFilter(engine="native"):  # keeps the build worker
        expected = images("stream", 1)
        for found in (images("stream", -1), images("ranges", 1)):
            for one, other in zip(found, expected, strict=True):
                assert np.array_equal(one, other)


def test_far_and_near_are_both_sharp(tmp_path, capsys):
    """`ocufilter psf`: a monofocal lens has one focus, a bifocal one two."""
    peaks = {}
    for design in ("monofocal", "bifocal"):
        correction = BIFOCAL["correction"]
        if design == "monofocal":
            correction = {k: v for k, v in correction.items() if k != "add_dpt"}
            correction["design"] = design
        file = tmp_path / f"{design}.json"
        file.write_text(json.dumps(BIFOCAL | {"correction": correction}))
        for object_dpt in ("0", "1.1", "2.18"):
            words = ["psf", str(file), "--pupil-mm", "3", "--wavelength-nm", "550"]
            words += ["--pixel-arcmin", "1", "--object-dpt", object_dpt]
            words += ["-o", str(tmp_path / "psf.npy"), "--json"]
            assert exit_code(app, words, "ocufilter") == 0
            facts = json.loads(capsys.readouterr().out)
            peaks[design, object_dpt] = facts["peak_ratio"]
    assert peaks["monofocal", "2.18"] < 0.1 * peaks["monofocal", "0"]
    assert peaks["bifocal", "2.18"] == pytest.approx(peaks["bifocal", "0"], rel=0.1)
    assert peaks["bifocal", "0"] == pytest.approx(
        0.42 * peaks["monofocal", "0"], rel=0.2
    )
    assert peaks["bifocal", "1.1"] < 0.3 * peaks["bifocal", "0"]


def test_the_program_takes_worn_lenses(tmp_path, capsys):
    """`estimate` and `filter` of one profile, and a clear error of a wrong one."""
    file = tmp_path / "eye.json"
    file.write_text(json.dumps(BIFOCAL))
    assert exit_code(app, ["estimate", str(file), "--json"], "ocufilter") == 0
    assert json.loads(capsys.readouterr().out)
    image, depth = tmp_path / "in.png", tmp_path / "depth.npy"
    write_image(image, np.full((32, 32, 3), 128, np.uint8))
    np.save(depth, np.full((32, 32), 0.5, np.float32))
    words = ["filter", "--color", str(image), "--depth", str(depth), "--fov-deg", "5"]
    words += ["--profile", str(file), "-o", str(tmp_path / "out.png"), "--json"]
    assert exit_code(app, words, "ocufilter") == 0
    assert json.loads(capsys.readouterr().out)
    wrong = BIFOCAL | {"correction": {"kind": "iol", "design": "bifocal"}}
    file.write_text(json.dumps(wrong))
    assert exit_code(app, words, "ocufilter") == 2
    assert "correction.add_dpt" in capsys.readouterr().err


def test_a_lens_with_rings_needs_diffraction():
    settings = FilterSettings(mode="on-axis", diffraction=False)
    with EyeFilter(BIFOCAL, CAMERA, settings) as eye_filter:
        with pytest.raises(Exception, match="diffraction"):
            eye_filter.wait()
