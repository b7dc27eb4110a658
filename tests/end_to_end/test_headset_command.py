"""`ocufilter headset` from the command line."""

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from clients.headset.options import EyeOptions, Eyes, settings_of
from clients.headset.runtime import (
    Happening,
    SimulatedRuntime,
)
from clients.headset.stereo_gaze import StereoGaze
from clients.service_process import CHECKOUT
from tests.commands import run_command
from tests.end_to_end.headset_doubles import Inverting


def run_program(*arguments, **options):
    return run_command("headset", *arguments, **options)


@pytest.mark.long("two eyes are estimated and traced")
def test_the_command_shows_a_scene_in_a_simulated_headset(tmp_path):
    finished = run_program(
        *("--simulated", "--size", "96x108", "--scene", "primitives", "--frames", "5"),
        *("--left", "emmetropia", "--right", "myopia", "--json"),
        *("--settings", json.dumps({"tolerance": "loose", "mode": "on-axis"})),
        *("--out", str(tmp_path), "--seconds", "90"),
    )
    assert finished.returncode == 0, finished.stderr
    report = json.loads(finished.stdout)
    assert report["filtered"] == 5
    assert report["stages_ms"]["age_ms"]["p50"] > 0
    assert {path.name for path in tmp_path.iterdir()} == {"left.png", "right.png"}


@pytest.mark.clients
def test_a_counted_run_ends_where_no_service_answers():
    finished = run_program(
        *("--simulated", "--size", "96x108", "--scene", "primitives", "--seconds", "2"),
        *("--service", "tcp://127.0.0.1:1"),
    )
    assert finished.returncode == 1
    assert "tcp://127.0.0.1:1" in finished.stderr


OWN_SCENERY = """
import numpy as np
from clients.headset.stereo_gaze import RgbdPicture

class Gray:
    def pictures(self, views, size_px):
        with open("rendered", "a") as file:
            file.write(".")
        width, height = size_px
        color = np.full((height, width, 3), 99, np.uint8)
        depth_m = np.full((height, width), 2.0, np.float32)
        return tuple(RgbdPicture(view, color, depth_m) for view in views)

def make(context):
    assert context.version_code >= 430
    return Gray()
"""


@pytest.mark.clients
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_ends_it_with_its_report_and_its_pictures(tmp_path, name):
    command = (
        *(sys.executable, "-m", "ocufilter", "headset", "--simulated", "--json"),
        *("--size", "48x54", "--scene", "own_scenery:make", "--out", "pictures"),
        *("--settings", json.dumps({"tolerance": "loose", "mode": "on-axis"})),
    )
    (tmp_path / "own_scenery.py").write_text(OWN_SCENERY)
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests run in the background, SIGINT is ignored, and so it would be.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as running:
        try:
            n_ready = 0
            while n_ready < 2:
                n_ready += "ready after" in running.stderr.readline()
            rendered = tmp_path / "rendered"
            n_before = rendered.stat().st_size
            end_s = time.monotonic() + 30.0
            while rendered.stat().st_size < n_before + 4:  # so frames were seen
                assert time.monotonic() < end_s
                time.sleep(0.01)
            running.send_signal(getattr(signal, name))
            printed, complaints = running.communicate(timeout=30.0)
        finally:
            running.kill()
    assert running.returncode == 0, complaints
    assert json.loads(printed)["filtered"] > 0
    assert (tmp_path / "pictures" / "left.png").is_file()


@pytest.mark.clients
def test_a_program_of_ones_own_renders(tmp_path):
    (tmp_path / "own_scenery.py").write_text(OWN_SCENERY)
    finished = run_program(
        *("--simulated", "--scene", "own_scenery:make", "--size", "48x54"),
        *("--settings", json.dumps({"tolerance": "loose", "mode": "on-axis"})),
        *("--frames", "2", "--out", "pictures", "--seconds", "60"),
        cwd=tmp_path,
    )
    assert finished.returncode == 0, finished.stderr
    from PIL import Image

    seen = np.asarray(Image.open(tmp_path / "pictures" / "left.png"))
    assert seen.shape == (54, 48, 3)
    assert np.abs(seen.astype(int) - 99).max() <= 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scene", "nowhere"), "nowhere"),
        (("--scene", "missing.glb"), "missing.glb"),
        (("--scene", "no_such_module:make"), "no_such_module"),
        (("--size", "5x5"), "WIDTHxHEIGHT"),
        (("--age", "200"), "3 to 120"),
        (("--pupil-mm", "30"), "0.5 to 9"),
        (("--gaze-range", "a,b"), "H,V"),
        (("--settings", '{"nonsense": 1}'), "nonsense"),
        (("--scale", "0.5"), "--scale requires a headset"),
        (("--white-cd-m2", "-1"), "white_cd_m2"),
        (("--profile", "{broken"), "not JSON"),
        (("--left", "{broken"), "--left"),
        (("--right", "missing.json"), "--right missing.json"),
        (("--frames", "0"), "--frames is 0"),
        (("--scene", "math:sqrt"), "math:sqrt: TypeError"),
    ],
)
def test_a_wrong_argument_is_named(arguments, words):
    finished = run_program("--simulated", "--seconds", "1", *arguments)
    assert finished.returncode == 2, finished.stderr
    assert words in finished.stderr
    assert "Traceback" not in finished.stderr


def test_the_help_teaches():
    finished = run_program("--help")
    assert finished.returncode == 0
    for words in ("--left", "--service", "Keys ", "ocufilter headset --simulated"):
        assert words in finished.stdout


def test_how_far_eyes_turn_follows_from_the_tracker_unless_it_is_told():
    with_tracker = SimulatedRuntime(happening=Happening(gaze_deg=(0.0, 0.0)))
    without = SimulatedRuntime()
    for given, runtime, expected in (
        ({}, with_tracker, (15.0, 10.0)),
        ({}, without, (0.0, 0.0)),
        ({"gaze_range": "3,2"}, with_tracker, (3.0, 2.0)),
        ({"gaze_range": "0,0"}, with_tracker, (0.0, 0.0)),
        ({"settings": '{"gaze_range_deg": [5, 4]}'}, without, (5.0, 4.0)),
    ):
        options, seeing = EyeOptions(**given), Inverting()
        look = StereoGaze(age_years=30.0)
        eyes = Eyes(options, settings_of(options), seeing, look, lambda line: None)
        eyes.begin(tracks_eyes=runtime.tracks_eyes)
        assert look.gaze_range_deg == seeing.settings.gaze_range_deg == expected
        assert [eye for eye, _ in seeing.changes] == ["left", "right"]
        eyes.begin(tracks_eyes=runtime.tracks_eyes)
        assert len(seeing.changes) == 2, "the same range needs no other eye"


@pytest.mark.slow
def test_the_benchmark_runs_and_is_right():
    finished = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks", "headset", "--quick", "--json"],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        timeout=200.0,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    rows = json.loads(finished.stdout)["rows"]
    assert {row["error_name"] for row in rows} == {"psnr_db"}
    assert min(row["error"] for row in rows) > 45.0
