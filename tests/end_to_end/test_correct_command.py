"""`ocufilter correct` as a person runs it: files, JSON, errors."""

import json

import numpy as np
import pytest
from PIL import Image

from filter_service.color_encoding import srgb8_of
from tests.commands import run_command

pytestmark = pytest.mark.clients

WIDTH_PX, HEIGHT_PX = 48, 32
VIEWER = '{"kind": "prescription", "sphere_dpt": -1}'
WORSE = '{"kind": "prescription", "sphere_dpt": -2}'
PLAIN = ("--mode", "on-axis", "--eye-model", "wavefront", "--no-chromatic")


@pytest.fixture
def arguments(tmp_path):
    """Return the arguments of a run on a chart of bars."""
    bars = (np.arange(WIDTH_PX) // 4 % 2)[None, :, None] * np.ones((HEIGHT_PX, 1, 3))
    Image.fromarray(srgb8_of(bars)).save(tmp_path / "bars.png")
    given = ("--color", tmp_path / "bars.png", "--distance-m", "inf", "--fov-deg", 1)
    return ("correct", *given, "--viewer", VIEWER, "--pupil-mm", 3, *PLAIN)


def test_the_picture_and_what_the_viewer_sees_are_written(arguments, tmp_path):
    names = ("a.png", "before.npy", "after.exr")
    out, before, after = (tmp_path / name for name in names)
    finished = run_command(
        *arguments,
        *("-o", out, "--seen-before", before, "--seen-after", after),
        *("--contrast", 0.5, "--brightness", 0.4, "--json"),
    )
    assert (finished.returncode, finished.stderr) == (0, "")
    told = json.loads(finished.stdout)
    with Image.open(out) as picture:
        assert picture.size == (WIDTH_PX, HEIGHT_PX)
    assert after.exists()
    wanted = np.where(np.load(before) > 0.4, 0.65, 0.15)
    psnr_db = -10.0 * np.log10(np.mean((np.load(before) - wanted) ** 2))
    assert np.isclose(psnr_db, told["psnr_before_db"], atol=0.01)
    assert told["psnr_after_db"] > told["psnr_before_db"] + 1.0
    assert told["contrast_given_up_ratio"] == 0.5
    assert told["has_converged"]
    assert len(told["errors"]) == told["iteration_count"] + 1
    assert told["errors"][-1] < 0.8 * told["errors"][0]
    assert told["solve_s"] > 0.0


def test_an_eye_is_shown_to_another_in_words(arguments, tmp_path):
    finished = run_command(
        *arguments, "--target-eye", WORSE, "--viewer", VIEWER, "-o", tmp_path / "a.npy"
    )
    assert finished.returncode == 0, finished.stderr
    assert "PSNR on the retina " in finished.stdout
    assert "contrast given up in the target: 0 %" in finished.stdout
    assert "note: target's eye: " in finished.stdout
    picture = np.load(tmp_path / "a.npy")
    assert picture.dtype == np.float32
    assert 0.0 <= picture.min() < picture.max() <= 1.0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--contrast 0", "--contrast is 0; allowed: 0.01 to 1"),
        ("--brightness 2", "--brightness is 2; allowed: 0 to 1"),
        ("--pupil-range-mm 2.8", "--pupil-range-mm is 2.8; allowed: 0 to 2 mm"),
        (
            "--pupil-mm 8 --pupil-range-mm 2",
            "--pupil-mm with --pupil-range-mm is 10;",
        ),
        ("--focus-range-dpt nan", "--focus-range-dpt is nan; allowed: 0 to 2 dpt"),
        ("--solve-tolerance 2", "--solve-tolerance is 2; allowed: 0 to 1"),
        ("--display-distance-m 0", "--display-distance-m is 0; allowed: 0.05 to inf m"),
        ("--depth a.npy", "--depth and --distance-m: given together; allowed: one of"),
        ("--focal-px 100", "--fov-deg and --focal-px: given together; allowed: one of"),
        ("--viewer myopia --viewer myopia", "--viewer is given 3 times; allowed: 1 or"),
        ("--max-iterations 0", "--max-iterations is '0'; allowed: 1 or more"),
        ("--metric l1", "--metric is 'l1'; allowed: retina, sensitivity"),
        ("--seen-after a.gif", "--seen-after 'a.gif': '.gif' is not a kind of output"),
        ("--target-eye nobody", "nobody"),
    ],
)
def test_bad_input_is_one_line(arguments, tmp_path, given, said):
    finished = run_command(*arguments, "-o", tmp_path / "a.png", *given.split())
    assert finished.returncode == 2
    assert finished.stdout == ""
    (line,) = finished.stderr.splitlines()
    assert said in line, line
