"""The `ocufilter` program as a person runs it: exit codes, JSON, files, errors."""

import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import clients
import estimator
import filter_service
from estimator.networks.inference import NETWORK_NAMES
from tests.commands import full_disk
from tests.commands import run_command as run
from tests.source_tree import ROOT

TIMEOUT_S = 120
WIDTH_PX, HEIGHT_PX = 48, 32


def run_process(*arguments, cwd=ROOT, **environment):
    """Run the program in a process of its own, for what is read at its start."""
    return subprocess.run(
        [sys.executable, "-m", "ocufilter", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )


def run_json(*arguments):
    finished = run(*arguments, "--json")
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout)


def refusal(*arguments):
    """Return the one line on stderr of a run that must end with code 2."""
    finished = run(*arguments)
    assert finished.returncode == 2, finished.stderr
    assert finished.stdout == ""
    assert finished.stderr.count("\n") == 1, finished.stderr
    return finished.stderr


def psnr_db(image, reference):
    error = np.mean((image.astype(np.float64) - reference) ** 2)
    return 10.0 * np.log10(1.0 / max(error, 1e-20))


@pytest.fixture
def scene(tmp_path, rng):
    """Linear color, planar depth with a step and a hole, as files."""
    linear = rng.random((HEIGHT_PX, WIDTH_PX, 3), dtype=np.float32)
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), np.inf, np.float32)
    np.save(tmp_path / "color.npy", linear)
    np.save(tmp_path / "depth.npy", depth_m)
    return tmp_path, linear


def filter_arguments(folder, *extra, profile="emmetropia", fov_deg=50, out="out.npy"):
    return (
        *("filter", "--color", folder / "color.npy", "--depth", folder / "depth.npy"),
        *("--fov-deg", fov_deg, "--profile", profile, "-o", folder / out),
        *extra,
    )


NO_OPENGL = {"GLCONTEXT_LINUX_LIBEGL": "libnothing.so"}

PLAIN = ("--mode", "on-axis", "--eye-model", "wavefront")
IDENTITY = ("--no-diffraction", "--no-chromatic", "--pupil-mm", "3", *PLAIN)


@pytest.mark.long("seven probes, each in a process of its own")
def test_doctor_reports_a_machine_that_can_serve():
    report = run_json("doctor")
    assert report["ok"]
    assert report["works"]["serve"]
    assert report["gl"]["renderer"]
    assert report["gl"]["limits"]["GL_MAX_COMPUTE_WORK_GROUP_INVOCATIONS"] >= 64
    works = [d for d in report["gl"]["devices"] if d["error"] is None]
    assert report["gl"]["renderer"] in [device["renderer"] for device in works]
    checks = {check["name"]: check["ok"] for check in report["checks"]}
    assert checks["compute"]
    assert checks["shaders"]
    assert checks["networks"]
    assert set(report["networks"]) == set(NETWORK_NAMES)
    assert all(card["n_parameters"] > 0 for card in report["networks"].values())
    assert report["version"] == version("ocufilter")


def test_the_version_is_that_of_the_installed_package():
    finished = run("--version")
    assert (finished.returncode, finished.stderr) == (0, "")
    assert finished.stdout == f"ocufilter {version('ocufilter')}\n"
    assert {p.__version__ for p in (clients, estimator, filter_service)} == {
        version("ocufilter")
    }


@pytest.mark.parametrize("command", [(), ("status",), ("keys", "add")])
def test_help_has_a_short_name(command):
    short, long = run(*command, "-h"), run(*command, "--help")
    assert short.returncode == long.returncode == 0, short.stderr
    assert short.stdout == long.stdout
    assert "usage:" in short.stdout.lower()


@pytest.mark.slow
def test_doctor_without_opengl_says_that_the_service_works_and_the_demo_does_not():
    finished = run_process("doctor", "--json", **NO_OPENGL)
    assert finished.returncode == 0
    report = json.loads(finished.stdout)
    assert report["works"]["serve"]
    assert not report["works"]["demo"]
    engine = next(check for check in report["checks"] if check["name"] == "engine")
    assert engine["detail"].startswith("native: no OpenGL")
    assert any("apt-get install" in command for command in report["install"])


@pytest.mark.long("the program looks for devices twice")
def test_a_device_that_is_not_there_is_refused_with_those_that_are(scene):
    folder, _ = scene
    arguments = filter_arguments(folder, *IDENTITY, "--engine", "gl")
    finished = run(*arguments, OCUFILTER_GL_DEVICE="7")
    assert finished.returncode != 0
    said = " ".join(finished.stderr.split())
    assert "gl_device is 7; allowed: auto, or an EGL device: 0 (" in said
    refused = run("serve", "--gl-device", "7", "--bind", "tcp://127.0.0.1:*")
    assert refused.returncode == 1
    assert "gl_device is 7; allowed: auto" in " ".join(refused.stderr.split())


def test_a_picture_needs_no_opengl(scene):
    folder, linear = scene
    arguments = filter_arguments(folder, *IDENTITY)
    finished = run(*arguments, "--json", **NO_OPENGL)
    assert finished.returncode == 0, finished.stderr
    assert json.loads(finished.stdout)["engine"] == "native"
    assert psnr_db(np.load(folder / "out.npy"), linear) >= 60.0


@pytest.mark.parametrize("name", ["gl", "native"])
def test_an_engine_can_be_asked_for(scene, name):
    folder, linear = scene
    summary = run_json(*filter_arguments(folder, *IDENTITY, "--engine", name))
    assert summary["engine"] == name
    assert ("native" in summary["renderer"]) == (name == "native")
    assert psnr_db(np.load(folder / "out.npy"), linear) >= 60.0


def test_an_unaberrated_eye_gives_the_image_back(scene):
    folder, linear = scene
    summary = run_json(*filter_arguments(folder, *IDENTITY))
    filtered = np.load(folder / "out.npy")
    assert filtered.dtype == np.float32
    assert psnr_db(filtered, linear) >= 60.0
    assert summary["missing_depth_count"] == 0
    assert summary["width_px"] == WIDTH_PX
    assert summary["height_px"] == HEIGHT_PX


def test_exr_and_npy_outputs_hold_the_same_linear_light(scene):
    folder, _ = scene
    defocus = ("--pupil-mm", "3", *PLAIN)
    run_json(*filter_arguments(folder, *defocus, profile="myopia"))
    run_json(*filter_arguments(folder, *defocus, profile="myopia", out="out.exr"))
    with OpenEXR.File(str(folder / "out.exr")) as file:
        stored = file.channels()["RGB"].pixels
    np.testing.assert_allclose(stored, np.load(folder / "out.npy"), atol=1e-5)


def test_half_floats_and_negative_light_pass_through(scene):
    folder, linear = scene
    light = (30.0 * linear - 1.0).astype(np.float16)
    light[0, 0] = np.nan
    np.save(folder / "color.npy", light)
    summary = run_json(*filter_arguments(folder, *IDENTITY, "--half", out="out.exr"))
    with OpenEXR.File(str(folder / "out.exr")) as file:
        filtered = file.channels()["RGB"].pixels
    assert filtered.dtype == np.float16
    light[0, 0] = 0.0
    assert psnr_db(filtered / 30.0, light.astype(np.float64) / 30.0) >= 60.0
    assert summary["bad_color_count"] == 1
    assert summary["overflow_count"] == 0
    text = refusal(*filter_arguments(folder, "--half", out="out.png"))
    assert "--half" in text


def test_png_input_and_output_are_srgb(scene, rng):
    folder, _ = scene
    srgb = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    Image.fromarray(srgb).save(folder / "color.png")
    millimeters = np.full((HEIGHT_PX, WIDTH_PX), 50_000, np.uint16)
    Image.fromarray(millimeters).save(folder / "depth.png")
    arguments = (
        *("filter", "--color", folder / "color.png", "--depth", folder / "depth.png"),
        *("--fov-deg", 30, "--profile", "emmetropia", "--focus-dpt", 0.02),
        *("--depth-scale", 0.001, "--depth-kind", "radial", "-o", folder / "out.png"),
    )
    summary = run_json(*arguments, *IDENTITY)
    assert summary["object_range_dpt"] == pytest.approx([0.02, 0.02])
    filtered = np.asarray(Image.open(folder / "out.png"))
    # one step of rounding on the way through linear light
    assert np.abs(filtered.astype(int) - srgb).max() <= 1


def test_missing_depth_is_filled_and_counted(scene):
    folder, _ = scene
    depth_m = np.load(folder / "depth.npy")
    depth_m[3, 5:9] = [0.0, -1.0, np.nan, 2.0]
    np.save(folder / "depth.npy", depth_m)
    summary = run_json(*filter_arguments(folder, *IDENTITY))
    assert summary["missing_depth_count"] == 3


def write_depth(folder, *stored_m):
    depth_m = np.resize(np.array(stored_m, np.float32), (HEIGHT_PX, WIDTH_PX))
    np.save(folder / "depth.npy", depth_m)


@pytest.mark.parametrize(
    ("stored_m", "words"),
    [
        ((2.0, 5.0), "depth 2 m to 5 m"),
        ((2.5,), "depth 2.5 m"),
        ((3.0, np.nan), "depth 3 m, 50 % missing, filled from neighbors"),
        ((0.5, np.inf), "depth 0.5 m to infinity"),
        ((np.nan,), "no depth; infinity is assumed"),
        ((211.0, 502.0), "note: all depth is beyond 100 m: is it in meters?"),
    ],
)
def test_what_was_read_and_assumed_of_depth_is_said(scene, stored_m, words):
    folder, _ = scene
    write_depth(folder, *stored_m)
    finished = run(*filter_arguments(folder, *IDENTITY))
    assert finished.returncode == 0, finished.stderr
    assert words in finished.stdout.splitlines(), finished.stdout


def test_a_photograph_without_depth_stands_at_a_distance(scene):
    folder, _ = scene
    write_depth(folder, 2.0)
    source = ("filter", "--color", folder / "color.npy", "--profile", "myopia")
    pixels = ("--fov-deg", 50, *PLAIN, "--json")
    pictures = []
    for name, depth in (
        ("a.npy", ("--depth", folder / "depth.npy")),
        ("b.npy", ("--distance-m", 2)),
    ):
        finished = run(*source, *depth, *pixels, "-o", folder / name)
        assert finished.returncode == 0, finished.stderr
        pictures.append(np.load(folder / name))
    np.testing.assert_array_equal(*pictures)


def test_a_camera_is_told_by_its_angle_its_focal_length_or_its_calibration(scene):
    folder, _ = scene
    focal_px = HEIGHT_PX / 2 / np.tan(np.radians(25.0))
    lens = f"{focal_px},{focal_px},{(WIDTH_PX - 1) / 2},{(HEIGHT_PX - 1) / 2}"
    source = ("filter", "--color", folder / "color.npy", "--distance-m", 1)
    pictures = []
    for camera in (
        ("--fov-deg", 50),
        ("--focal-px", focal_px),
        ("--intrinsics", lens),
    ):
        out = folder / f"{camera[0]}.npy"
        finished = run(*source, *camera, "--profile", "myopia", *PLAIN, "-o", out)
        assert finished.returncode == 0, finished.stderr
        pictures.append(np.load(out))
    for picture in pictures[1:]:
        np.testing.assert_allclose(picture, pictures[0], atol=1e-6)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ((), "--depth, --distance-m: none is given"),
        (
            ("--distance-m", 1, "--depth", "d.npy"),
            "--depth and --distance-m: given together",
        ),
        (("--distance-m", 0.001), "--distance-m is 0.001; allowed:"),
        (("--distance-m", "nan"), "--distance-m is nan; allowed:"),
        (("--distance-m", 1), "--fov-deg, --focal-px, --intrinsics: none is given"),
        (("--distance-m", 1, "--intrinsics", "1,2"), "allowed: FX,FY,CX,CY"),
        (("--distance-m", 1, "--focal-px", 0), "--focal-px is 0; allowed:"),
        (
            ("--distance-m", 1, "--fov-deg", 50, "--focal-px", 9),
            "--fov-deg and --focal-px: given together",
        ),
    ],
)
def test_contradictions_about_camera_and_distance_are_refused(scene, extra, words):
    folder, _ = scene
    said = refusal(
        *("filter", "--color", folder / "color.npy", "--profile", "myopia"),
        *("-o", folder / "out.npy", *extra),
    )
    assert words in said


def test_a_photograph_is_turned_upright_and_so_is_its_depth_expected(scene, rng):
    folder, _ = scene
    stored = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    turned = Image.Exif()
    turned[0x0112] = 6  # the camera was held upright
    Image.fromarray(stored).save(folder / "phone.png", exif=turned)
    common = ("filter", "--color", folder / "phone.png", "--profile", "emmetropia")
    out = ("--fov-deg", 50, "-o", folder / "out.png", *IDENTITY)
    finished = run(*common, "--distance-m", "inf", *out)
    assert finished.returncode == 0, finished.stderr
    seen = np.asarray(Image.open(folder / "out.png"))
    upright = np.rot90(stored, -1)
    assert seen.shape == upright.shape
    assert np.abs(seen.astype(int) - upright).max() <= 1
    said = refusal(*common, "--depth", folder / "depth.npy", *out)
    assert "48x32 px; allowed: the size of the color image, 32x48" in said
    assert "rotated upright" in said


def test_a_profile_may_be_json_on_the_command_line(scene):
    folder, _ = scene
    body = {"kind": "prescription", "sphere_dpt": -8, "vertex_mm": 12}
    finished = run(*filter_arguments(folder, *PLAIN, profile=json.dumps(body)))
    assert finished.returncode == 0, finished.stderr
    note = "note: prescription: -8.00 at 12 mm, -7.30 at the cornea"
    assert note in finished.stdout.splitlines()


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        ('{"kind": "prescription", "sphere": -2}', "did you mean 'sphere_dpt'?"),
        ('{"kind": "preset", "name": "myopa"}', "did you mean 'myopia'?"),
        ("keratoconnus", "did you mean 'keratoconus'?"),
        ('{"kind"', "profile: not JSON"),
        ("broken.json", "profile: file 'broken.json' does not exist"),
    ],
)
def test_a_wrong_profile_is_named_with_what_may_have_been_meant(scene, profile, words):
    folder, _ = scene
    said = refusal(*filter_arguments(folder, profile=profile))
    assert words in said
    assert "field 'profile'" not in said


def test_progress_names_what_is_done(scene):
    folder, _ = scene
    finished = run(*filter_arguments(folder, *PLAIN))
    stages = [line.partition("] ")[2] for line in finished.stderr.splitlines()]
    assert "preparing: frame, 100 %" in stages
    assert any(stage.startswith("preparing: PSFs, ") for stage in stages)
    assert not any("psfs" in stage for stage in stages)


@pytest.mark.parametrize(
    "pupil_mm", [2.90511, pytest.param(3.333333, marks=pytest.mark.slow)]
)
@pytest.mark.long("an eye is estimated and traced")
def test_a_pupil_is_never_outside_what_was_prepared_for_it(scene, pupil_mm):
    folder, _ = scene
    extra = ("--pupil-mm", pupil_mm, "--mode", "quality", "--json")
    finished = run(*filter_arguments(folder, *extra, profile="post_lasik"))
    assert finished.returncode == 0, finished.stderr
    notes = json.loads(finished.stdout)["notes"]
    assert not any("outside the prepared" in note for note in notes)


def test_a_pupil_above_the_measured_one_is_capped_and_said(scene):
    folder, _ = scene
    wide = (*PLAIN, "--pupil-mm", 7)
    finished = run(*filter_arguments(folder, *wide, profile="cataract"))
    assert finished.returncode == 0, finished.stderr
    assert "capped" in finished.stdout


def test_a_traced_eye_says_how_it_was_found(scene):
    folder, _ = scene
    traced = filter_arguments(folder, "--eye-model", "traced", "--mode", "on-axis")
    notes = run_json(*traced)["notes"]
    assert "refined from an eye in a table" in notes[0]
    assert not any("network" in note or "accuracy" in note for note in notes)


def test_cones_weigh_the_pupil_where_that_is_asked_for(scene):
    folder, _ = scene
    pupil = ("--pupil-mm", 5, *PLAIN)
    images = []
    for extra in ((), ("--stiles-crawford",)):
        run_json(*filter_arguments(folder, *pupil, *extra, profile="astigmatism"))
        images.append(np.load(folder / "out.npy"))
    assert 30.0 < psnr_db(*images) < 60.0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"profile": "hyperopia"}, "profile"),
        ({"fov_deg": 0}, "--fov-deg"),
        ({"fov_deg": "wide"}, "--fov-deg"),
        ({"out": "out.gif"}, "--out"),
        ({"out": "nowhere/out.png"}, "--out"),
    ],
)
def test_bad_filter_arguments_end_with_one_line_that_names_the_field(
    scene, change, named
):
    assert named in refusal(*filter_arguments(scene[0], **change))


@pytest.mark.parametrize(
    ("extra", "named"),
    [
        (("--pupil-mm", "30"), "--pupil-mm"),
        (("--pupil-mm", "nan"), "--pupil-mm"),
        (("--focus-dpt", "-1"), "--focus-dpt"),
        (("--depth-scale", "0"), "--depth-scale"),
        (("--mode", "peripheral"), "--mode"),
        (("--accumulation", "sum"), "--accumulation"),
        (("--nonsense",), "--nonsense"),
    ],
)
def test_bad_options_end_with_one_line_that_names_them(scene, extra, named):
    assert named in refusal(*filter_arguments(scene[0], *extra))


def test_depth_of_another_size_is_refused_with_both_sizes(scene):
    np.save(scene[0] / "depth.npy", np.ones((4, 6), np.float32))
    line = refusal(*filter_arguments(scene[0]))
    assert "--depth" in line
    assert "6x4" in line
    assert f"{WIDTH_PX}x{HEIGHT_PX}" in line


def test_a_hidden_layer_is_seen_around_a_blurred_edge(scene):
    folder, linear = scene
    near = np.arange(WIDTH_PX)[None, :] < WIDTH_PX // 2
    linear[:] = np.where(near[..., None], 1.0, 0.0)
    behind = np.zeros_like(linear)
    np.save(folder / "color.npy", linear)
    depth_m = np.broadcast_to(np.where(near, 0.1, np.inf), behind.shape[:2])
    np.save(folder / "depth.npy", depth_m.astype(np.float32))
    np.save(folder / "behind.npy", behind)
    hidden_m = np.where(near, np.inf, 0.0) + np.zeros((HEIGHT_PX, 1))
    np.save(folder / "behind_m.npy", hidden_m.astype(np.float32))
    files = ("--hidden-color", folder / "behind.npy")
    files += ("--hidden-depth", folder / "behind_m.npy")
    defocus = (*IDENTITY[:2], *PLAIN, "--pupil-mm", "8")
    shown = []
    for extra in (defocus, (*defocus, *files)):
        summary = run_json(*filter_arguments(folder, *extra, fov_deg=20))
        shown.append(np.load(folder / "out.npy")[HEIGHT_PX // 2, :, 1])
    assert summary["object_range_dpt"] == pytest.approx([0.0, 10.0], rel=0.02)
    column = WIDTH_PX // 2 - 1
    assert shown[0][column] > 0.98  # without it, only the near thing is there
    assert 0.5 < shown[1][column] < 0.8


@pytest.mark.parametrize(
    ("arrays", "named"),
    [
        ({"hidden-color": np.zeros((4, 6, 3), np.float32)}, "--hidden-depth"),
        ({"hidden-depth": np.zeros((4, 6), np.float32)}, "--hidden-color"),
        (
            {
                "hidden-color": np.zeros((4, 6, 3), np.float32),
                "hidden-depth": np.zeros((4, 6), np.float32),
            },
            "6x4",
        ),
        (
            {
                "hidden-color": np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8),
                "hidden-depth": np.zeros((HEIGHT_PX, WIDTH_PX), np.float32),
            },
            "uint8",
        ),
    ],
)
def test_a_hidden_layer_that_does_not_fit_is_refused(scene, arrays, named):
    extra = ()
    for name, array in arrays.items():
        np.save(scene[0] / f"{name}.npy", array)
        extra += (f"--{name}", scene[0] / f"{name}.npy")
    assert named in refusal(*filter_arguments(scene[0], *extra))


@pytest.mark.parametrize("name", ["color.npy", "depth.npy"])
def test_unreadable_and_missing_files_are_refused(scene, name):
    option = "--" + name.split(".")[0]
    (scene[0] / name).write_bytes(b"not an array")
    assert option in refusal(*filter_arguments(scene[0]))
    (scene[0] / name).unlink()
    assert option in refusal(*filter_arguments(scene[0]))


def test_a_profile_file_with_a_wrong_field_names_it(scene):
    path = scene[0] / "eye.json"
    path.write_text('{"kind": "prescription", "sphere_dpt": -400}')
    assert "sphere_dpt" in refusal(*filter_arguments(scene[0], profile=path))


PSF_OPTIONS = ("--pupil-mm", 3, "--wavelength-nm", 549, "--pixel-arcmin", 1)


def test_psf_writes_a_kernel_of_unit_sum(tmp_path):
    facts = run_json("psf", "keratoconus", *PSF_OPTIONS, "-o", tmp_path / "psf.npy")
    kernel = np.load(tmp_path / "psf.npy")
    assert kernel.shape == (2 * facts["radius_px"] + 1,) * 2
    assert kernel.sum() == pytest.approx(1.0, abs=1e-4)
    assert facts["lost_energy_ratio"] < 0.01
    assert facts["method"] in ("fourier", "geometric")


def test_psf_of_a_prescription_has_the_aberrations_of_the_age(tmp_path):
    spread_px = []
    for more in ({}, {"higher_order": "none"}):
        body = json.dumps({"kind": "prescription", "sphere_dpt": 0, **more})
        facts = run_json("psf", body, *PSF_OPTIONS, "-o", tmp_path / "psf.npy")
        spread_px.append(facts["blur_radius_px"])
    assert spread_px[0] > 1.05 * spread_px[1]


def test_psf_writes_a_picture_with_a_scale_bar(tmp_path):
    run_json("psf", "myopia", *PSF_OPTIONS, "-o", tmp_path / "psf.png")
    picture = np.asarray(Image.open(tmp_path / "psf.png"))
    assert min(picture.shape[:2]) >= 300
    inside_bar = picture[-12 - 3, 14:40]  # margin, half the height
    assert (inside_bar == 255).all()


def test_psf_of_a_profile_of_its_own_file(tmp_path):
    eye = tmp_path / "eye.abp"
    eye.write_text("Ap = 5\nWa = 587.56\nZ[2, 0] = 1  # um\n")
    facts = run_json("psf", eye, *PSF_OPTIONS, "-o", tmp_path / "psf.npy")
    assert facts["profile"] == "eye.abp"


@pytest.mark.parametrize(
    ("option", "value"),
    [("--wavelength-nm", 200), ("--pixel-arcmin", 0), ("--method", "guess")],
)
def test_psf_refuses_values_out_of_range(tmp_path, option, value):
    given = dict(zip(PSF_OPTIONS[::2], PSF_OPTIONS[1::2], strict=True))
    given[option] = value
    options = [word for pair in given.items() for word in pair]
    assert option in refusal("psf", "myopia", *options, "-o", tmp_path / "psf.npy")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("demo", "--size", "wide"), "--size"),
        (("demo", "--frames", "0"), "--frames"),
        (("bench", "everything"), "everything"),
        (("serve", "--config", "no-such-file.toml"), "--config"),
        (("serve", "--bind", "nowhere"), "bind"),
        (("psf", "myopia"), "--pupil-mm"),
        (("dance",), "dance"),
    ],
)
def test_other_commands_refuse_bad_input_with_one_line(arguments, named):
    assert named in refusal(*arguments)


@pytest.mark.tools
def test_benchmarks_say_that_they_need_a_checkout(tmp_path):
    (tmp_path / "estimator").symlink_to(ROOT / "estimator")
    for package in ("filter_service", "clients"):
        shutil.copytree(
            ROOT / package,
            tmp_path / package,
            ignore=shutil.ignore_patterns("__pycache__", "node_modules"),
        )
    finished = subprocess.run(
        [sys.executable, "-m", "ocufilter", "bench", "psf"],
        cwd=tmp_path,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert finished.returncode == 1
    assert finished.stderr.count("\n") == 1
    assert "checkout" in finished.stderr


def test_help_without_arguments_teaches_the_commands():
    finished = run()
    assert finished.returncode == 0
    for command in ("demo", "serve", "latency", "filter", "psf", "bench", "doctor"):
        assert f"\n  {command} " in finished.stdout


STATE = ("--pupil-mm", 3, "--wavelength-nm", 555)
FINE = ("--pixel-arcmin", 0.25)


@pytest.mark.long("computes what it then cannot write")
@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("psf", "myopia", *STATE, *FINE, "-o"), "psf.npy"),
        (("psf", "myopia", *STATE, *FINE, "-o"), "psf.png"),
        (("field", "$a", *STATE, "--h-deg", 0, "--plot"), "field.png"),
        (("estimate", "$a", "--plot"), "eye.png"),
    ],
)
def test_a_full_disk_leaves_the_earlier_file(tmp_path, words, name):
    """And a name that matplotlib would take for a formula does no harm."""
    profile = tmp_path / "a.json"
    profile.write_text(
        json.dumps({"kind": "prescription", "sphere_dpt": -2, "name": r"$\nope$"})
    )
    out = tmp_path / name
    out.write_text("earlier")
    with full_disk():
        ended = run(*(profile if word == "$a" else word for word in words), out)
    assert ended.returncode == 1
    assert "too large" in ended.stderr or "requested and" in ended.stderr  # np.save
    assert out.read_text() == "earlier"
    assert {path.name for path in tmp_path.iterdir()} == {"a.json", name}


@pytest.mark.long("computes a PSF")
def test_a_name_of_a_file_that_is_no_utf_8_ends_no_command(tmp_path):
    out = tmp_path / os.fsdecode(b"\xff.npy")
    ended = run("psf", "myopia", *STATE, *FINE, "-o", out)
    assert ended.returncode == 0, ended.stderr
    assert out.exists()
    assert r"\udcff.npy: myopia" in ended.stdout
