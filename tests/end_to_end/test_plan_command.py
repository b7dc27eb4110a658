"""`ocufilter filter --plan`: what would be computed, said before anything is."""

import json

import numpy as np
import pytest

from tests.commands import run_command as run

WIDTH_PX, HEIGHT_PX = 64, 48


@pytest.fixture
def arguments(tmp_path, rng):
    np.save(tmp_path / "color.npy", rng.random((HEIGHT_PX, WIDTH_PX, 3), np.float32))
    near_m = np.linspace(0.5, 4.0, WIDTH_PX, dtype=np.float32)
    np.save(tmp_path / "depth.npy", np.tile(near_m, (HEIGHT_PX, 1)))
    files = {name: str(tmp_path / f"{name}.npy") for name in ("color", "depth", "out")}
    return [
        *("filter", "--color", files["color"], "--depth", files["depth"]),
        *("--fov-deg", "50", "--profile", "emmetropia", "--out", files["out"]),
        *("--eye-model", "traced", "--pupil-mm", "5"),
    ]


@pytest.mark.long("a plan of a traced eye")
def test_the_plan_is_said_and_nothing_is_written(arguments, tmp_path):
    finished = run(*arguments, "--mode", "dynamic", "--plan")
    assert finished.returncode == 0, finished.stderr
    assert "azimuths: -" in finished.stdout
    assert "interpolation at" in finished.stdout
    assert not (tmp_path / "out.npy").exists()


@pytest.mark.long("two plans of a traced eye")
def test_the_plan_as_json_follows_mode_tolerance_and_gaze(arguments):
    plans = [
        run(*arguments, "--mode", "quality", "--plan", "--json", *more)
        for more in (
            ["--tolerance", "loose"],
            ["--gaze-h-deg", "10"],
        )
    ]
    loose, normal = (json.loads(p.stdout) for p in plans)
    assert normal["psf_count"] > loose["psf_count"] > 0
    assert normal["interpolation_db"] > loose["interpolation_db"] + 2.0
    assert loose["h_deg"][0] == pytest.approx(-loose["h_deg"][-1])
    assert normal["h_deg"][-1] < loose["h_deg"][-1] - 5.0
    axes = {"h", "v", "pupil", "accommodation", "defocus"}
    assert set(normal["error_db_by_axis"]) == axes


def test_a_gaze_out_of_range_is_refused(arguments):
    finished = run(*arguments, "--gaze-v-deg", "75", "--plan")
    assert finished.returncode == 2
    assert "--gaze-v-deg" in finished.stderr
    assert finished.stderr.count("\n") == 1
