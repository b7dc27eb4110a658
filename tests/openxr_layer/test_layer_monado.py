"""Programs with the layer in the runtime Monado, started with the public command."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from clients.openxr_layer.program import LIBRARY_VARIABLE
from tests.headset.monado import Monado
from tests.headset.rooms import stripes
from tests.openxr_layer.programs import VALIDATION
from tests.page_commands import ways_in

N_FRAMES = 300
TIMEOUT_S = 120
HALF_SIZE = {"XRT_COMPOSITOR_SCALE_PERCENTAGE": "50"}
PATIENT = ("--max-age-ms", "5000")
"""This machine may be busy, and results late."""

pytestmark = pytest.mark.skipif(
    shutil.which("monado-service") is None, reason="no Monado here"
)


class Run:
    """`ocufilter layer run` with a program, which ends with the context.

    Parameters
    ----------
    folder : Path
        For what is said, and for the socket.
    environment : dict
    *arguments : str
        Options, ``--``, and the program.
    """

    def __init__(self, folder, environment, *arguments):
        self._said = folder / "said.txt"
        socket = ("--socket", str(folder / "layer.sock"))
        command = (sys.executable, "-m", "ocufilter", "layer", "run")
        with self._said.open("wb") as said:
            self.process = subprocess.Popen(
                [*command, *socket, "--json", *map(str, arguments)],
                env=os.environ | environment,
                stdin=subprocess.PIPE,  # hello_xr ends with its input
                stdout=subprocess.PIPE,
                stderr=said,
                text=True,
            )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()
        self.process.stdin.close()

    @property
    def said(self):
        return self._said.read_text(encoding="utf-8", errors="replace")

    def wait_until(self, is_wanted):
        """Wait until the output is as wanted."""
        end_s = time.monotonic() + TIMEOUT_S
        while not is_wanted(self.said):
            assert time.monotonic() < end_s, self.said[-3000:]
            assert self.process.poll() is None, self.said[-3000:]
            time.sleep(0.05)

    def report(self, number=signal.SIGINT):
        """End it; return its exit code and its report."""
        self.process.send_signal(number)
        output, _ = self.process.communicate(timeout=TIMEOUT_S)
        # It may follow a line that the program did not end.
        report = output.splitlines()[-1]
        return self.process.returncode, json.loads(
            report[report.index('{"filtered"') :]
        )


@pytest.fixture
def run(layer, tmp_path):
    """Return how to run a program with the layer."""

    def started(monado, *arguments, **variables):
        own = {LIBRARY_VARIABLE: str(layer)}
        return Run(tmp_path, monado.environment | own | variables, *arguments)

    return started


needs_hello_xr = pytest.mark.skipif(
    shutil.which("hello_xr") is None, reason="no hello_xr here"
)
EYES = ("--left", "myopia", "--right", "emmetropia")
HELLO = ("hello_xr", "-g", "OpenGL")
BELOW = "XR_APILAYER_LUNARG_core_validation:XR_APILAYER_LUNARG_api_dump"


@needs_hello_xr
def test_hello_xr_under_validation(run, display, tmp_path):
    validation, dump = tmp_path / "validation.txt", tmp_path / "dump.txt"
    variables = {
        "DISPLAY": display,
        "XR_ENABLE_API_LAYERS": BELOW,
        "XR_CORE_VALIDATION_EXPORT_TYPE": "text",
        "XR_CORE_VALIDATION_FILE_NAME": str(validation),
        "XR_API_DUMP_EXPORT_TYPE": "text",
        "XR_API_DUMP_FILE_NAME": str(dump),
    }

    def n_ended(_said):
        text = dump.read_text(errors="replace") if dump.exists() else ""
        return text.count("XrResult xrEndFrame")

    pictures = []
    with Monado(tmp_path, screen=True, variables=HALF_SIZE) as monado:
        with run(monado, *EYES, *PATIENT, "--", *HELLO, **variables) as program:
            program.wait_until(lambda said: said.count("eye: ready") == 2)
            before = n_ended("") + N_FRAMES // 10  # until they are shown
            for i in range(3):
                goal = before + (i + 1) * N_FRAMES // 3
                program.wait_until(lambda said, goal=goal: n_ended(said) >= goal)
                pictures.append(monado.screenshot())
            code, report = program.report()
    assert code in (0, 128 + signal.SIGINT)  # the signal, or the end of its input
    print(report)
    assert report["shown_filtered"] >= N_FRAMES
    assert report["fallback"] == 0
    for picture in pictures:
        assert np.mean(picture.max(axis=2) > 20) > 0.9, "black"
    lines = validation.read_text().splitlines()
    assert any("VUID-CoreValidation-Initialize" in line for line in lines)
    wrong = [line for line in lines if "VUID" in line and "Initialize" not in line]
    assert [line for line in wrong if "VALID_DEBUG" not in line] == []
    # The layer's own swapchains and spaces are in the dump, below the layer.
    assert len(re.findall("XrResult xrCreateSwapchain", dump.read_text())) == 4


@needs_hello_xr
def test_hello_xr_with_vulkan(run, tmp_path):
    # Vulkan without the 2 asks for VK_KHR_external_semaphore_fd, which lavapipe has
    # only where there is /dev/udmabuf.
    hello = ("hello_xr", "-g", "Vulkan2")
    variables = {
        "VK_INSTANCE_LAYERS": "VK_LAYER_KHRONOS_validation",
        "VK_KHRONOS_VALIDATION_VALIDATE_SYNC": "1",
    }
    with Monado(tmp_path, screen=True, variables=HALF_SIZE) as monado:
        with run(monado, *EYES, *PATIENT, "--", *hello, **variables) as program:
            program.wait_until(lambda said: said.count("eye: ready") == 2)
            time.sleep(2.0)
            picture = monado.screenshot()
            code, report = program.report()
            said = program.said
    assert code in (0, 128 + signal.SIGINT)
    assert report["shown_filtered"] >= 20
    assert report["fallback"] == 0
    assert np.mean(picture.max(axis=2) > 20) > 0.9, "black"
    assert [line for line in said.splitlines() if VALIDATION.search(line)] == []


@needs_hello_xr
@pytest.mark.parametrize(
    "command",
    [c for c in ways_in()["OpenXR"] if c.is_one_of(["layer run"])],
    ids=lambda command: command.words[-1],
)
def test_the_printed_lines_filter_hello_xr(run, display, tmp_path, command):
    options = command.arguments[2:]
    with Monado(tmp_path, screen=True, variables=HALF_SIZE) as monado:
        with run(monado, *PATIENT, *options, DISPLAY=display) as program:
            program.wait_until(lambda said: said.count("eye: ready") == 2)
            time.sleep(2.0)
            code, report = program.report()
    assert code in (0, 128 + signal.SIGINT)
    assert report["shown_filtered"] >= 10
    assert report["fallback"] == 0


@needs_hello_xr
def test_profiles_change_while_frames_are_filtered(run, display, tmp_path):
    profile = tmp_path / "eye.json"
    profile.write_text(json.dumps({"kind": "prescription", "sphere_dpt": -1.0}))
    socket = ("--socket", str(tmp_path / "layer.sock"))
    command = (sys.executable, "-m", "ocufilter", "layer")
    with Monado(tmp_path, variables=HALF_SIZE) as monado:
        options = ("--profile", profile, *PATIENT)
        with run(monado, *options, "--", *HELLO, DISPLAY=display) as program:
            program.wait_until(lambda said: said.count("eye: ready") >= 2)
            status = subprocess.run(
                [*command, "status", *socket, "--json"],
                env=os.environ | {LIBRARY_VARIABLE: "none"},
                capture_output=True,
                text=True,
            )
            assert json.loads(status.stdout)["helper"]["program"] == "HelloXR"
            profile.write_text(json.dumps({"kind": "prescription", "sphere_dpt": 2}))
            program.wait_until(lambda said: said.count("eye: ready") >= 4)
            profile.write_text("{")
            program.wait_until(lambda said: "left eye is unchanged" in said)
            subprocess.run([*command, "set", *socket, "--left", "myopia"], check=True)
            program.wait_until(lambda said: "left eye: myopia" in said)
            program.wait_until(lambda said: said.count("eye: ready") >= 5)
            for text, message in (
                ('{"kind":', "profile: not JSON"),
                ("nobody", "'nobody' is not known"),
            ):
                wrong = subprocess.run(
                    [*command, "set", *socket, "--left", text],
                    capture_output=True,
                    text=True,
                )
                assert wrong.returncode == 2
                assert message in wrong.stderr
            _, report = program.report(signal.SIGTERM)
    assert report["filtered"] > 0


def test_the_runtime_is_killed_and_comes_back(run, tmp_path):
    room = str(stripes(tmp_path / "room.glb"))
    viewer = (sys.executable, "-m", "tests.openxr_layer.plain_viewer")
    viewer += ("--scene", room, "--frames", "100000", "--textures", "no")
    with Monado(tmp_path, variables=HALF_SIZE) as monado:
        with run(monado, *EYES, *PATIENT, "--", *viewer) as program:
            program.wait_until(lambda said: "right eye: ready" in said)
            monado.kill()
            program.wait_until(lambda said: "disconnected" in said)
            monado.restart()
            program.wait_until(lambda said: said.count("connected to the helper") == 2)
            filtered = program.said.count("eye: ready")
            time.sleep(2.0)
            code, report = program.report()
    assert filtered >= 2
    assert code in (0, 130)
    assert report["fallback"] <= 2
    assert report["shown_filtered"] > 20


def test_gaze_of_an_eye_tracker(run, tmp_path):
    script = tmp_path / "gaze.json"
    script.write_text(json.dumps({"h_deg": 5.0}))
    room = str(stripes(tmp_path / "room.glb"))
    tracked = (sys.executable, "-m", "tests.headset.gaze_layer", str(script))
    tracked += ("tests.openxr_layer.plain_viewer", "--scene", room)
    tracked += ("--frames", "100000", "--textures", "no")
    with Monado(tmp_path, variables=HALF_SIZE) as monado:
        with run(monado, *EYES, *PATIENT, "--", *tracked) as program:
            program.wait_until(lambda said: "right eye: ready" in said)
            _, report = program.report()
            said = program.said
    assert "eyes are tracked" in said
    assert report["filtered"] > 0
