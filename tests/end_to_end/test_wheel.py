"""The wheel, installed where no checkout is near, does what the checkout does."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from clients.service_process import ServiceProcess
from tests.end_to_end import test_documentation, test_examples
from tests.page_commands import (
    ENDPOINT,
    PAGES,
    SLOW,
    WAYS_PAGE,
    commands_of,
    make_files,
    ways_in,
)
from tests.release.smoke import REQUEST
from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

TIMEOUT_S = 300
WIDTH_PX, HEIGHT_PX = 24, 16
PACKAGES = ("clients", "estimator", "filter_service", "ocufilter")
BRIEF_PAGES = ("docs/how-to/deploy.md", "docs/how-to/eye-models.md")

HELD = (
    *(f"{package}/**/{name}" for package in PACKAGES for name in ("*.py", "*.pyi")),
    *(f"{package}/py.typed" for package in PACKAGES),
    "shaders/**/*.glsl",
    "shaders/README.md",
    "estimator/networks/weights/*.onnx",
    "estimator/networks/weights/*.json",
    "estimator/profiles/presets.json",
    "estimator/color/cie_2006.csv",
    "estimator/estimate/eye_table.json",
    "estimator/profiles/published/*.json",
    "estimator/periphery/population.json",
    "estimator/profiles/synteyes.json",
    "filter_service/PROTOCOL.md",
    "filter_service/*.schema.json",
    "filter_service/display_spectra.json",
    "filter_service/service/ocufilter.service",
    "clients/assets/*",
    "clients/cpp/*",
    "clients/js/*.js",
    "clients/js/package.json",
    "clients/scenarios.json",
    "clients/js/README.md",
    "clients/web/*.css",
    "clients/web/*.js",
)
"""Files of the checkout that a wheel holds, and no others."""

COMPILED = {
    "estimator/native/_core.so",
    "filter_service/native/_loops.so",
    "filter_service/service/_drop_parts.so",
}
"""Libraries that any C compiler makes; the OpenXR layer also needs headers."""


def copy_checkout(folder):
    """Copy what git would: a build leaves files behind in the folder it is made of."""
    for name in files_of_git() or files_without_git():
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def files_of_git():
    if shutil.which("git") is None:
        return []
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    finished = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True)
    return finished.stdout.split("\0")[:-1]


def files_without_git():
    found = [
        path.relative_to(ROOT)
        for name in (*PACKAGES, "shaders")
        for path in (ROOT / name).rglob("*")
        if "__pycache__" not in path.parts
    ]
    return [*found, "pyproject.toml", "README.md"]


def pip(*arguments):
    finished = subprocess.run(
        [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert finished.returncode == 0, finished.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of the checkout as it is."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    copy_checkout(source)
    build = ("wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, source)
    pip(*map(str, build))
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def wheel_names(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """An environment that has the wheel, and of this one's packages all others."""
    folder = tmp_path_factory.mktemp("installed")
    venv = [sys.executable, "-m", "venv", "--without-pip", folder / "venv"]
    subprocess.run(venv, check=True, timeout=TIMEOUT_S)
    python = folder / "venv" / "bin" / "python"
    install = ("install", "-q", "--no-deps", "--no-index", "--no-compile", wheel)
    pip("--python", str(python), *map(str, install))
    site = next((folder / "venv").glob("lib/python*/site-packages"))
    # A .pth file names a folder but reads no .pth file in it, such as that of the
    # checkout's editable install.
    others = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (site / "others.pth").write_text("\n".join(others) + "\n", encoding="utf-8")
    empty = folder / "empty"
    empty.mkdir()
    return SimpleNamespace(
        python=python, ocufilter=python.parent / "ocufilter", site=site, cwd=empty
    )


def start(installed, *command, cwd=None, **variables):
    """Run in an empty folder, with nothing that leads to the checkout."""
    leads = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    environment = {k: v for k, v in os.environ.items() if k not in leads}
    return subprocess.run(
        [str(word) for word in command],
        cwd=cwd or installed.cwd,
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )


@pytest.fixture
def run(installed):
    def run(*arguments):
        return start(installed, installed.ocufilter, *arguments)

    return run


@pytest.fixture
def run_json(run):
    def run_json(*arguments):
        finished = run(*arguments, "--json")
        assert finished.returncode == 0, finished.stderr
        return json.loads(finished.stdout)

    return run_json


def one_line(finished, code):
    assert finished.returncode == code, finished.stderr
    assert finished.stdout == ""
    assert finished.stderr.count("\n") == 1, finished.stderr
    return finished.stderr


def test_the_wheel_holds_everything_of_its_packages_and_nothing_else(wheel_names):
    expected = set()
    for pattern in HELD:
        found = {path.relative_to(ROOT).as_posix() for path in ROOT.glob(pattern)}
        assert found, pattern
        expected |= found
    expected = {re.sub("^shaders/", "filter_service/shaders/", n) for n in expected}
    held = {name for name in wheel_names if ".dist-info/" not in name}
    compiled = {name for name in held if name.endswith(".so")}
    assert compiled - {"clients/openxr_layer/_layer.so"} == COMPILED
    held -= compiled
    assert sorted(expected - held) == []
    assert sorted(held - expected) == []
    assert {name.split("/")[0] for name in held} == set(PACKAGES)


def test_what_is_imported_is_the_wheel_s(installed):
    script = (
        "import clients, estimator, filter_service as f, ocufilter, numpy\n"
        "from filter_service.gl.passes import SHADER_ROOT\n"
        "ours = clients, estimator, f, ocufilter\n"
        "print(*(m.__file__ for m in ours), SHADER_ROOT, sep='\\n')"
    )
    finished = start(installed, installed.python, "-c", script)
    assert finished.returncode == 0, finished.stderr
    files = [Path(line) for line in finished.stdout.splitlines()]
    assert len(files) == 5
    assert all(path.is_relative_to(installed.site) for path in files)


def test_public_names_and_the_command_line_need_no_checkout(installed):
    script = "import ocufilter; print(ocufilter.EyeFilter.__name__)"
    shown = start(installed, installed.python, "-c", script)
    assert shown.stdout == "EyeFilter\n", shown.stderr
    module = start(installed, installed.python, "-m", "ocufilter", "--version")
    command = start(installed, installed.ocufilter, "--version")
    assert module.stdout == command.stdout != "", module.stderr


def test_the_printed_lines_install_the_wheel(wheel, tmp_path):
    lines = [command.text for command in ways_in()["Wheel"]]
    (name,) = re.findall(r"ocufilter-.*\.whl", "\n".join(lines))
    shutil.copy(wheel, tmp_path / name)
    # Its dependencies are those of this environment, without a network.
    packages = ":".join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")})
    finished = subprocess.run(
        ["bash", "-ec", "\n".join(lines)],
        cwd=tmp_path,
        env=os.environ
        | {"PIP_NO_DEPS": "1", "PIP_NO_INDEX": "1", "PYTHONPATH": packages},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    own = tmp_path / "ocufilter-env"
    assert list(own.glob("lib/python*/site-packages/filter_service/native/_loops.so"))
    assert "serve" in finished.stdout


def test_doctor_finds_a_machine_that_can_serve(run_json):
    report = run_json("doctor")
    assert report["ok"]
    assert report["works"]["serve"]
    checks = {check["name"]: check["ok"] for check in report["checks"]}
    assert checks["shaders"]
    assert checks["native"]
    assert checks["networks"]
    fixes = " ".join(report["install"])
    assert "setup.sh" not in fixes
    assert "git" not in fixes


@pytest.fixture
def image(installed):
    """Files of a bright half beside a dark one, 2 m away."""
    color = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.float32)
    color[:, WIDTH_PX // 2 :] = 1.0
    np.save(installed.cwd / "color.npy", color)
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), 2.0, np.float32)
    np.save(installed.cwd / "depth.npy", depth_m)
    return (
        *("filter", "--color", "color.npy", "--depth", "depth.npy"),
        *("--fov-deg", "5", "--profile", "myopia", "-o", "out.npy"),
    )


def test_filter_blurs_a_picture(run_json, installed, image):
    assert run_json(*image)["engine"] == "native"
    filtered = np.load(installed.cwd / "out.npy")
    assert filtered.shape == (HEIGHT_PX, WIDTH_PX, 3)
    assert np.isfinite(filtered).all()
    middle = filtered[HEIGHT_PX // 2, WIDTH_PX // 2, 1]
    assert 0.2 < middle < 0.8


def test_filter_refuses_a_bad_option_in_one_line(run, image):
    assert "--pupil-mm" in one_line(run(*image, "--pupil-mm", "30"), 2)


def test_serve_answers_a_client(installed):
    finished = start(installed, installed.python, "-c", REQUEST, installed.ocufilter)
    assert finished.returncode == 0, finished.stderr


def test_latency_measures_a_service_in_another_process(run_json, installed):
    plain = ("--mode", "on-axis", "--eye-model", "wavefront")
    few = ("--size", "64x36", "--frames", 3, "--plot", "latency.png", *plain)
    with ServiceProcess(start_timeout_s=TIMEOUT_S) as service:
        (row,) = run_json("latency", service.endpoint, *few)["rows"]
    frames = row["frames"]
    assert frames["filtered"] + sum(frames["dropped"].values()) == 3
    assert row["error"]["psnr_db"] > 35
    assert (installed.cwd / "latency.png").read_bytes().startswith(b"\x89PNG")


def test_estimate_finds_an_eye(run_json):
    found = run_json("estimate", "emmetropia")
    assert found["mean_abs_error_um"] <= 5e-4


def test_wavefront_is_traced(run_json):
    options = ("--pupil-mm", "3", "--wavelength-nm", "555")
    found = run_json("wavefront", "emmetropia", *options)
    assert len(found["zernike_um"]) == 28


def test_psf_is_written(run_json, installed):
    options = ("--pupil-mm", "3", "--wavelength-nm", "549", "--pixel-arcmin", "1")
    run_json("psf", "emmetropia", *options, "-o", "psf.npy")
    kernel = np.load(installed.cwd / "psf.npy")
    assert kernel.sum() == pytest.approx(1.0, abs=1e-4)


def test_a_benchmark_of_the_tests_needs_a_checkout(installed):
    module = (installed.python, "-m", "ocufilter")
    assert "checkout" in one_line(start(installed, *module, "bench", "psf"), 1)


@pytest.fixture
def psychopy(installed):
    """PsychoPy's metadata, which pip reads, without its gigabyte of packages."""
    folder = installed.site / "psychopy-2026.2.5.dist-info"
    folder.mkdir()
    text = "Metadata-Version: 2.1\nName: psychopy\nVersion: 2026.2.5\n"
    (folder / "METADATA").write_text(text)
    yield
    shutil.rmtree(folder)


def test_the_adapters_install_where_the_wheel_is(installed, psychopy, tmp_path):
    adapters = tmp_path / "adapters"
    shutil.copytree(ROOT / "examples" / "adapters", adapters)  # a build leaves files
    install = ("install", "-q", "--no-index", "--no-build-isolation", adapters)
    pip("--python", str(installed.python), *map(str, install))
    (point,) = installed.site.glob("psychopy_ocufilter-*.dist-info/entry_points.txt")
    assert "SeenImageStim = psychopy_ocufilter:SeenImageStim" in point.read_text()


EXTRAS = (
    *("glfw", "OpenGL", "pyrender", "trimesh"),
    *("xr", "nicegui", "fastapi", "uvicorn", "av", "ray"),
    *("prometheus_client", "skimage", "weasyprint"),
)
WITHOUT_EXTRAS = f"import sys\nsys.modules.update(dict.fromkeys({EXTRAS!r}))\n"


@pytest.fixture
def bare(installed):
    """The wheel with none of the packages of its extras, which come by a .pth file."""
    (installed.site / "without_extras.py").write_text(WITHOUT_EXTRAS)
    switch = installed.site / "without_extras.pth"
    switch.write_text("import without_extras\n")
    yield installed
    switch.unlink()


def first_command(bare):
    """Return the command that `ocufilter --help` tells to start with."""
    shown = start(bare, bare.ocufilter, "--help").stdout
    return re.search(r"Start\s+with\s+`ocufilter (\w+)`", shown)[1]


def test_the_first_command_needs_no_extra(bare):
    command = (bare.ocufilter, first_command(bare), "--frames", 0)
    assert "allowed: 1 or more" in start(bare, *command).stderr


@pytest.mark.slow
def test_the_first_command_runs(bare, tmp_path):
    first = first_command(bare)
    words = (bare.ocufilter, first, "--frames", 2, "--size", "64x36")
    finished = start(bare, *words, cwd=tmp_path)
    assert finished.returncode == 0, finished.stderr
    with Image.open(tmp_path / "out" / "demo" / "demo.gif") as film:
        assert film.n_frames == 2


@pytest.mark.parametrize(
    ("page", "is_brief"),
    [(page, True) for page in BRIEF_PAGES]
    + [
        pytest.param(page, False, marks=pytest.mark.slow)
        for page in PAGES
        if any(command.ends for command in commands_of(page))
    ],
)
def test_commands_of_a_page_run_or_name_what_to_install(bare, page, is_brief, tmp_path):
    make_files(tmp_path)
    for command in commands_of(page):
        is_left_out = is_brief and command.is_one_of(SLOW)
        if command.ends and ENDPOINT not in command.arguments and not is_left_out:
            words = (bare.ocufilter, *command.arguments)
            home = dict.fromkeys(("HOME", "XDG_CONFIG_HOME"), str(tmp_path))
            finished = start(bare, *words, cwd=tmp_path, **home)
            command.check(finished.returncode, finished.stderr, may_lack=True)


@pytest.mark.slow
@pytest.mark.parametrize("path", test_documentation.PAGES, ids=lambda path: path.stem)
def test_python_examples_of_a_page_run(installed, path, tmp_path):
    script = tmp_path / "example.py"
    script.write_text(test_documentation.example_of(path), encoding="utf-8")
    finished = start(installed, installed.python, script)
    assert finished.returncode == 0, finished.stderr


@pytest.mark.slow
@pytest.mark.parametrize("path", test_examples.SCRIPTS, ids=lambda path: path.stem)
def test_an_example_runs(installed, path, tmp_path):
    examples = tmp_path / "examples"
    shutil.copytree(path.parent, examples)
    script = (installed.python, f"examples/{path.name}")
    finished = start(installed, *script, cwd=tmp_path)
    assert finished.returncode == 0, finished.stderr
    assert list((tmp_path / "out" / "examples").glob(f"{path.stem}.*"))


@pytest.mark.parametrize(
    ("page", "file"),
    [
        (WAYS_PAGE, ".config/systemd/user/ocufilter.service"),
        (WAYS_PAGE, "ocufilter-js/filter_client.js"),
        (WAYS_PAGE, "ocufilter-cpp/example.cpp"),
        ("docs/how-to/deploy.md", ".config/systemd/user/ocufilter.service"),
        ("clients/js/README.md", "ocufilter-js/filter_client.js"),
        ("clients/cpp/README.md", "ocufilter-cpp/ocufilter.hpp"),
    ],
)
def test_files_of_the_package_are_where_pages_say(installed, page, file, tmp_path):
    script = "\n".join(c.text for c in commands_of(page) if c.copies)
    path = f"{installed.python.parent}:{os.environ['PATH']}"
    words = ("sh", "-ec", script)
    finished = start(installed, *words, cwd=tmp_path, HOME=str(tmp_path), PATH=path)
    assert finished.returncode == 0, finished.stderr
    assert (tmp_path / file).is_file()


@pytest.mark.parametrize(
    ("command", "package"),
    [
        (("headset",), "ocufilter[headset]"),
        (("web", "--no-browser"), "ocufilter[web]"),
        (
            ("batch", "a.mp4", "-p", "myopia", "-o", "out", "--fov-deg", 50),
            "ocufilter[batch]",
        ),
        (
            ("batch", "rgbd", "-p", "myopia", "-o", "out", "--fov-deg", 50, "--ray"),
            "ocufilter[batch-ray]",
        ),
        (("serve", "--config", "metrics.toml"), "ocufilter[metrics]"),
        (("paper",), "git clone"),
        (("bench", "psf"), "git clone"),
    ],
)
def test_what_is_missing_is_said_in_one_line_with_its_command(bare, command, package):
    (bare.cwd / "a.mp4").write_bytes(b"")
    (bare.cwd / "metrics.toml").write_text(
        'bind = "tcp://127.0.0.1:*"\nmetrics_port = 1'
    )
    for name in ("rgbd/color", "rgbd/depth"):
        (bare.cwd / name).mkdir(parents=True, exist_ok=True)
        image = np.full((8, 8), 1000, np.uint16)
        Image.fromarray(image).save(bare.cwd / name / "a.png")
    if command[-1] == "--ray":
        command = (*command, "local")
    finished = start(bare, bare.ocufilter, *command)
    said = finished.stderr.strip().splitlines()
    assert finished.returncode in (1, 2), finished.stdout
    assert package in said[-1], finished.stderr
    assert "Traceback" not in finished.stderr
