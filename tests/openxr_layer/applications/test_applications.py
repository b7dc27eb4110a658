"""Qt Quick 3D Xr, Psychtoolbox and Blender, unchanged, through two different eyes.

For the root of `setup_root.sh --applications`: make test-layer-applications
"""

import json
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from clients.openxr_layer.program import LIBRARY_VARIABLE
from tests.native_build import runtime_of
from tests.openxr_layer import build
from tests.openxr_layer.applications.applications import (
    APPLICATIONS,
    Running,
    coarse,
    stripe_contrasts,
)
from tests.openxr_layer.layered import layer_environment

LAYER = (sys.executable, "-m", "ocufilter", "layer")
EYES = (
    *("--left", json.dumps({"kind": "prescription", "sphere_dpt": -4.0})),
    *("--right", "emmetropia", "--focus-dpt", "0", "--pupil-mm", "6"),
    *("--flat-dpt", "0", "--max-age-ms", "5000", "--json"),
)
"""Both are focused at infinity, so that the left eye sees sharply at 25 cm."""

BLURRED_RATIO, SHARP_RATIO = 0.5, 0.8
"""Contrast of stripes, relative to the unfiltered one: at most that where an eye is
defocused by 4 D, at least that where it is not."""

COARSE_TOLERANCE = 0.03  # of linear light in blocks
N_FRAMES = 10
READY = "right eye: ready"
ENDINGS = {True: 0, False: 128 + signal.SIGTERM}

pytestmark = pytest.mark.skipif(
    shutil.which("monado-service") is None, reason="no Monado here"
)


def each(*wanted):
    """Return a mark for tests of applications, those with these names or all."""
    found = [each for each in APPLICATIONS if not wanted or each.name in wanted]
    return pytest.mark.parametrize("application", found, ids=lambda given: given.name)


@pytest.fixture(autouse=True)
def skip_missing(application):
    """Skip where the application is missing."""
    if application.is_missing:
        pytest.skip(f"no {application.program} here")


@pytest.fixture
def run_command(tmp_path):
    """Return `ocufilter layer run`, without the program."""
    return (*LAYER, "run", "--socket", str(tmp_path / "layer.sock"), *EYES, "--")


def report_of(output):
    """Return the report at the end of what the command prints."""
    return json.loads(output.splitlines()[-1])


@each()
def test_each_eye_sees_as_it_does(application, layer, run_command, tmp_path):
    with Running(application, tmp_path / "plain") as running:
        plain = running.screenshot()
    library = {LIBRARY_VARIABLE: str(layer)}
    folder = tmp_path / "filtered"
    with Running(application, folder, *run_command, **library) as running:
        running.wait_until(lambda: READY in running.said)
        time.sleep(2.0)  # until it is shown
        seen = running.screenshot()
        code, output = running.end()
        said = running.said
    report, own = report_of(output), stripe_contrasts(plain)
    ratios = {name: found / own[name] for name, found in stripe_contrasts(seen).items()}
    away = np.abs(coarse(seen) - coarse(plain)).max()
    print(application.name, ratios, f"{away:.4f}", report)
    assert code == ENDINGS[application.ends_itself]
    assert report["shown_filtered"] >= N_FRAMES
    assert report["fallback"] == 0
    # Without depth, everything is as far away as the wall.
    left, right = ratios["far"]
    assert left < BLURRED_RATIO
    assert right > SHARP_RATIO
    left, right = ratios["near"]
    if application.has_depth:
        assert "planes are in centimeters" in said
        left, right = right, left
    else:
        assert "depth: there is none" in said
    assert left < BLURRED_RATIO
    assert right > SHARP_RATIO
    # Nothing is flipped, exchanged, darker or of another color.
    assert away < COARSE_TOLERANCE


VALIDATED = [given.name for given in APPLICATIONS if given.name != "qt-egl"]
"""The validation layer refuses sessions with EGL, also without any other layer."""


@each(*VALIDATED)
def test_validation(application, layer, run_command, tmp_path):
    library = {LIBRARY_VARIABLE: str(layer)}
    with Running(
        application, tmp_path / "seen", *run_command, is_validated=True, **library
    ) as running:
        running.wait_until(lambda: READY in running.said)
        time.sleep(3.0)
        code, output = running.end()
        complaints = running.complaints()
    assert code == ENDINGS[application.ends_itself]
    assert report_of(output)["shown_filtered"] > 0
    assert "VUID-CoreValidation-Initialize" in complaints[0]
    # Qt uses hand trackers that it could not create.
    wrong = [line for line in complaints if "VALID_DEBUG" not in line]
    assert [line for line in wrong if "HandTrackerEXT handle" not in line] == []


class Serving:
    """`ocufilter layer serve`, until the context ends."""

    def __init__(self, folder, name):
        self._said = folder / f"{name}.txt"
        with self._said.open("wb") as said:
            self.process = subprocess.Popen(
                [*LAYER, "serve", "--socket", str(folder / "layer.sock"), *EYES],
                stdout=subprocess.PIPE,
                stderr=said,
                text=True,
            )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.kill()
        self.process.stdout.close()

    def kill(self):
        self.process.kill()
        self.process.wait()

    @property
    def is_ready(self):
        return READY in self._said.read_text(encoding="utf-8")

    def report(self):
        self.process.terminate()
        output, _ = self.process.communicate()
        return report_of(output)


def layer_variables(library, folder, **others):
    """Return variables of a program with the layer."""
    found = layer_environment(library, folder, folder / "layer.sock")
    wanted = ("XR_API_LAYER_PATH", "XR_ENABLE_API_LAYERS", "OCUFILTER_LAYER_SOCKET")
    return {name: found[name] for name in wanted} | others


@each("qt-glx", "qt-egl", "psychtoolbox-untimed", "psychtoolbox-presenter-thread")
def test_helper_is_killed_and_comes_back(application, layer, tmp_path):
    variables = layer_variables(layer, tmp_path)
    with (
        Running(application, tmp_path / "seen", **variables) as running,
        Serving(tmp_path, "first") as first,
    ):
        plain = running.screenshot()
        running.wait_until(lambda: first.is_ready)
        time.sleep(2.0)
        seen = running.screenshot()
        first.kill()
        time.sleep(1.0)
        alone = running.screenshot()
        with Serving(tmp_path, "second") as second:
            running.wait_until(lambda: second.is_ready)
            time.sleep(2.0)
            again = running.screenshot()
            code, _ = running.end()
            report = second.report()
    assert code == 0
    assert not np.array_equal(seen, plain)
    np.testing.assert_array_equal(alone, plain)
    np.testing.assert_array_equal(again, seen)
    assert report["shown_filtered"] >= N_FRAMES
    assert report["fallback"] == 0


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    """Return the layer with sanitizers, and the libraries that it requires."""
    found = runtime_of("address")
    if found is None:
        pytest.skip("no AddressSanitizer here")
    flags = ("-fsanitize=address,undefined", "-fno-omit-frame-pointer")
    folder = tmp_path_factory.mktemp("sanitized")
    # The sanitizer wraps functions of C++, which most of the programs load later.
    return build.build_layer(folder, *flags), f"{found}:libstdc++.so.6"


@each()
def test_sanitizers(application, sanitized, tmp_path):
    library, preloaded = sanitized
    own = {"LD_PRELOAD": preloaded, "ASAN_OPTIONS": "detect_leaks=0"}
    variables = layer_variables(library, tmp_path, **own)
    with (
        Serving(tmp_path, "helper") as helper,
        Running(application, tmp_path / "seen", **variables) as running,
    ):
        running.wait_until(lambda: helper.is_ready)
        time.sleep(5.0)
        code, _ = running.end()
        said, report = running.said, helper.report()
    assert "Sanitizer" not in said
    assert "runtime error" not in said
    assert code == (0 if application.ends_itself else -signal.SIGTERM)
    assert report["shown_filtered"] > 0
