"""One image through the command, a batch, `EyeFilter` and the service: the same pixels.

Each with its defaults; the widest ranges hold what the image asks for.
"""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from clients.commands.program import app
from clients.filter_client import FilterClient
from clients.service_process import SERVE_COMMAND
from filter_service import Camera, EyeFilter, FilterSettings, RgbdView
from filter_service.filter_protocol import Filter
from tests.batch_kills import start

FOV_DEG = 50.0
SEE = {"pupil_diameter_mm": 4.3, "focus_dpt": 0.7}
WIDTH, HEIGHT = 96, 54
CAMERA = Camera.from_fov(FOV_DEG, width_px=WIDTH, height_px=HEIGHT)


@pytest.fixture(scope="module")
def image():
    rng = np.random.default_rng(11)
    color = rng.integers(0, 256, (HEIGHT // 3, WIDTH // 4, 3)).astype(np.uint8)
    color = color.repeat(3, axis=0).repeat(4, axis=1)
    depth_m = np.full((HEIGHT, WIDTH), 2.5, np.float32)
    depth_m[12:36, 18:54] = 0.5
    return color, depth_m


@pytest.fixture(scope="module")
def in_process(image):
    with EyeFilter("keratoconus", CAMERA, engine="native") as eye_filter:
        return eye_filter.filter(*image, **SEE, output="linear").color


@pytest.fixture
def files(image, tmp_path):
    color, depth_m = tmp_path / "color.npy", tmp_path / "depth.npy"
    for path, array in zip((color, depth_m), image, strict=True):
        np.save(path, array)
    return color, depth_m


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.long("an eye is traced and computed")
def test_the_command_gives_the_same(in_process, files, tmp_path):
    color, depth = files
    printed = run(
        *("filter", "--color", color, "--depth", depth, "--fov-deg", FOV_DEG),
        *("--profile", "keratoconus", "--pupil-mm", SEE["pupil_diameter_mm"]),
        *("--focus-dpt", SEE["focus_dpt"], "--engine", "native"),
        *("-o", tmp_path / "seen.npy", "--json"),
    )
    np.testing.assert_array_equal(np.load(tmp_path / "seen.npy"), in_process)
    settings = json.loads(printed)["settings"]
    assert FilterSettings(**settings) == FilterSettings()  # those that it went by


def seen_by(chosen: Filter, image):
    """Show an image through a filter, wherever it is."""
    view = RgbdView(*image, CAMERA.tangents)
    with chosen:
        chosen.set_profile("keratoconus", views=view)
        seen = chosen.filter(view, **SEE, output="linear")
        begun = chosen.begin(*image, **SEE, output="linear")
        assert begun
        np.testing.assert_array_equal(begun().color, seen.color)
        return seen


@pytest.mark.long("a service traces and computes an eye")
def test_the_service_gives_the_same(in_process, image, use_service):
    service = use_service(command=SERVE_COMMAND, engine="native")
    own = seen_by(EyeFilter(camera=CAMERA, engine="native"), image)
    seen = seen_by(FilterClient(service.endpoint, timeout_s=60.0), image)
    np.testing.assert_array_equal(own.color, in_process)
    np.testing.assert_array_equal(seen.color, in_process)
    for name in ("pupil_diameter_mm", "focus_dpt", "generation", "notes"):
        assert getattr(seen, name) == getattr(own, name)
    assert "splat_ms" in seen.stage_times_ms.keys() & own.stage_times_ms.keys()


@pytest.mark.clients
def test_a_batch_gives_the_same(in_process, files, tmp_path):
    room = tmp_path / "room"
    (room / "color").mkdir(parents=True)
    (room / "depth").mkdir()
    for path, name in zip(files, ("color", "depth"), strict=True):
        path.rename(room / name / "0001.npy")
    process = start(
        *(room, "-p", "keratoconus", "--fov-deg", FOV_DEG),
        *("--pupil-mm", SEE["pupil_diameter_mm"], "--focus-dpt", SEE["focus_dpt"]),
        *("--engine", "native", "--format", "npy", "--workers", 1),
        *("-o", tmp_path / "seen"),
    )
    _, error = process.communicate(timeout=120)
    assert process.returncode == 0, error
    (seen,) = (tmp_path / "seen").rglob("*.npy")
    np.testing.assert_array_equal(np.load(seen), in_process)
