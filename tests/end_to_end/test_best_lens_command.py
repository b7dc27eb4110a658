"""`ocufilter best-lens` as a person runs it: files, JSON, errors."""

import json

import numpy as np
import pytest
from PIL import Image

from filter_service.color_encoding import srgb8_of
from tests.commands import run_command

pytestmark = pytest.mark.clients

WIDTH_PX, HEIGHT_PX = 48, 32
EYE = '{"kind": "prescription", "sphere_dpt": -1, "age_years": 60}'
PLAIN = ("--mode", "on-axis", "--eye-model", "wavefront", "--no-cylinder")


@pytest.fixture
def arguments(tmp_path):
    """Return the arguments of a run on a chart of bars."""
    bars = (np.arange(WIDTH_PX) // 4 % 2)[None, :, None] * np.ones((HEIGHT_PX, 1, 3))
    Image.fromarray(srgb8_of(bars)).save(tmp_path / "bars.png")
    given = ("--color", tmp_path / "bars.png", "--fov-deg", 1)
    return ("best-lens", *given, "--profile", EYE, "--pupil-mm", 3, *PLAIN)


@pytest.mark.long("a search of 15 lenses in a process")
def test_the_lens_is_one_object_and_the_pictures_are_written(arguments, tmp_path):
    before, after = tmp_path / "before.npy", tmp_path / "after.npy"
    finished = run_command(
        *arguments,
        *("--distance-m", "inf", "--seen-before", before, "--seen-after", after),
        "--json",
    )
    assert (finished.returncode, finished.stderr) == (0, "")
    told = json.loads(finished.stdout)
    assert told["vertex_mm"] == 12.0
    wanted_dpt = -1.0 / (1.0 - 0.012)
    assert np.isclose(told["best"]["sphere_dpt"], wanted_dpt, atol=0.06)
    assert told["rounded"]["sphere_dpt"] == -1.0
    assert told["correction"] == {
        "kind": "spectacles",
        "vertex_mm": 12.0,
        "sphere_dpt": told["best"]["sphere_dpt"],
    }
    assert told["has_converged"]
    errors_db = [trial["error_db"] for trial in told["trials"]]
    assert told["best"]["error_db"] == min(errors_db)
    assert np.isclose(told["gain_db"], told["error_before_db"] - min(errors_db))
    assert told["gain_db"] > 3.0
    bars = np.arange(WIDTH_PX) // 4 % 2
    errors = [np.mean((np.load(path)[..., 1] - bars) ** 2) for path in (before, after)]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_far_and_near_in_words(arguments):
    finished = run_command(
        *arguments,
        *("--distance-m", "inf", "--distance-m", 0.5, "--lens", "progressive"),
        *("--head-gaze-v-deg", 0, "--head-gaze-v-deg", -35, "--pupil-mm", 4),
    )
    assert finished.returncode == 0, finished.stderr
    assert "best lens -0.9" in finished.stdout or "best lens -1.0" in finished.stdout
    assert " add 2.00: error higher by " in finished.stdout
    assert "highest visual Strehl ratio " in finished.stdout
    assert finished.stdout.splitlines()[-1].endswith(" s")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--distance-m 0", "--distance-m is 0; allowed: 0.05 to inf m"),
        ("--depth a.npy --distance-m 1", "--depth and --distance-m: given together"),
        (
            "--distance-m 1 --weight 1 --weight 2",
            "--weight is given 2 times; allowed: 1,",
        ),
        ("--distance-m 1 --weight 0", "--weight is 0; allowed: 1e-06 to 1e+06"),
        ("--distance-m 1 --pupil-mm 99", "--pupil-mm is 99; allowed: 0.5 to 9 mm"),
        ("--distance-m 1 --vertex-mm 99", "--vertex-mm is 99; allowed: 0 to 25 mm"),
        ("--distance-m 1 --max-lenses 3", "--max-lenses is '3'; allowed: 30 or more"),
        ("--distance-m 1 --lens iol", "--lens is 'iol'; allowed: spectacles,"),
        ("--distance-m 1 --seen-after a.gif", "'.gif' is not a kind of output"),
        ("--distance-m 1 --target-eye nobody", "nobody"),
    ],
)
def test_bad_input_is_one_line(arguments, given, said):
    finished = run_command(*arguments, *given.split())
    assert finished.returncode == 2
    assert finished.stdout == ""
    (line,) = finished.stderr.splitlines()
    assert said in line, line
