"""The published pipeline in every door, beside stored pictures of `ocufilter paper`.

The pictures and their errors are those of `tests.benchmarks.bench_published`.
"""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from clients.commands.program import app
from clients.filter_client import FilterClient
from clients.service_process import SERVE_COMMAND
from filter_service import Camera, EyeFilter, RgbdView
from filter_service.errors import BadMessage, BuildFailed
from filter_service.messages import Ready
from tests.batch_kills import start
from tests.benchmarks import bench_published as bench
from tests.benchmarks.harness import RESULTS

LIMIT_S = 600.0
SAME_ERROR_DB = 0.1
SAME_PICTURE_DB = 60.0

WIDTH, HEIGHT, FOV_DEG = 48, 27, 10.0
CAMERA = Camera.from_fov(FOV_DEG, width_px=WIDTH, height_px=HEIGHT)
SETTINGS = {"pipeline": "published", "mode": "on-axis"}
NARROW = SETTINGS | {
    "pupil_range_mm": (3.0, 3.0),
    "focus_range_dpt": (0.0, 0.0),
    "object_range_dpt": (0.25, 0.25),
}
"""Of few PSFs: those of `SEE` and the image."""

SEE = {"pupil_diameter_mm": 3.0, "focus_dpt": 0.0}


@pytest.fixture(scope="module")
def image():
    color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    color[:, WIDTH // 2 :] = (255, 200, 90)
    return color, np.full((HEIGHT, WIDTH), 4.0, np.float32)


@pytest.fixture(scope="module")
def eye_filter():
    with EyeFilter("myopia", CAMERA, NARROW, engine="native") as eye_filter:
        yield eye_filter


@pytest.fixture(scope="module")
def in_process(eye_filter, image):
    seen = eye_filter.filter(*image, **SEE, whole=True, output="linear")
    return seen.color, eye_filter.ready.notes


def test_stored_pictures_have_the_errors_of_the_results():
    content = json.loads((RESULTS / "published.json").read_text(encoding="utf-8"))
    stored = bench.stored_pictures()
    rows = [row for row in content["rows"] if row["method"] == "published"]
    assert [row["case"] for row in rows] == list(bench.CONDITIONS)
    for row in rows:
        shown, exact = (stored[kind][row["case"]] for kind in ("published", "exact"))
        measured = bench.measures(*(bench.linear_from_srgb(a) for a in (shown, exact)))
        assert measured.psnr_srgb8_db == pytest.approx(row["psnr_srgb8_db"], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("case", bench.CONDITIONS)
def test_the_service_gives_the_stored_pictures(real_service, case):
    view, stored = bench.picture_view(), bench.stored_pictures()
    with FilterClient(real_service.endpoint, timeout_s=LIMIT_S) as client:
        client.set_profile(
            bench.profile_body(case),
            settings={"pipeline": "published"},
            views=[view],
            timeout_s=LIMIT_S,
        )
        seen = client.filter(
            view,
            pupil_diameter_mm=bench.STATE.pupil_mm,
            focus_dpt=bench.STATE.focus_dpt,
            output="linear",
            timeout_s=LIMIT_S,
        )
    shown, exact = stored["published"][case], stored["exact"][case]
    color = bench.srgb_from_linear(seen.color)
    own_db = bench.error_db(color, exact)
    assert own_db == pytest.approx(bench.error_db(shown, exact), abs=SAME_ERROR_DB)
    assert bench.error_db(color, shown) > SAME_PICTURE_DB


@pytest.mark.clients
def test_the_service_prepares_with_progress_and_notes(in_process, image, use_service):
    service, reported = use_service(command=SERVE_COMMAND, engine="native"), []
    color, notes = in_process
    with FilterClient(service.endpoint, timeout_s=LIMIT_S) as client:
        ready = client.set_profile(
            "myopia", settings=NARROW, views=[CAMERA], on_progress=reported.append
        )
        seen = client.filter(RgbdView(*image, CAMERA.tangents), **SEE, output="linear")
    np.testing.assert_array_equal(seen.color, color)
    assert {"eye", "psfs"} <= {progress.stage for progress in reported}
    codes = [detail.code for detail in ready.note_details]
    assert codes == [note.code for note in notes]
    for code in ("eye_by_network", "aberrations_by_network", "enz_series"):
        assert code in codes


@pytest.mark.clients
def test_other_clients_get_frames_while_it_prepares(image, use_service):
    """PSFs are computed in small parts, between the frames of others."""
    service = use_service(command=SERVE_COMMAND, engine="native")
    view, state = bench.picture_view(), {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
    with (
        FilterClient(service.endpoint, timeout_s=LIMIT_S) as other,
        FilterClient(service.endpoint, timeout_s=LIMIT_S) as client,
    ):
        other.set_profile("emmetropia", views=[view])
        other.filter(view, **state)
        client.set_profile(
            "myopia", settings={"pipeline": "published"}, views=[view], wait=False
        )
        count = 0
        while count < 5 and not any(isinstance(e, Ready) for e in client.poll()):
            other.filter(view, **state)
            count += 1
    assert count > 1


@pytest.mark.clients
def test_frames_have_the_published_accumulation_and_no_light_beyond(
    in_process, eye_filter, image
):
    color, depth_m = image
    for accumulation in ("paper", "coverage"):
        asked = {"output": "linear", "accumulation": accumulation}
        seen = eye_filter.filter(color, depth_m, **SEE, **asked)
        np.testing.assert_array_equal(seen.color, in_process[0])
    lamp = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    lamp[HEIGHT // 2, WIDTH // 2] = 1e4
    lamp[0, 0] = 1.0
    seen = eye_filter.filter(lamp, depth_m, **SEE, output="linear")
    assert "edge_light_ms" not in seen.stage_times_ms
    with EyeFilter("myopia", CAMERA, {"mode": "on-axis"}, engine="native") as exact:
        seen = exact.filter(lamp, depth_m, **SEE, output="linear")
    assert "edge_light_ms" in seen.stage_times_ms


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.clients
def test_commands_give_the_same(image, tmp_path):
    with EyeFilter("myopia", CAMERA, SETTINGS, engine="native") as eye_filter:
        color = eye_filter.filter(*image, **SEE, output="linear").color
    room = tmp_path / "room"
    for name, array in zip(("color", "depth"), image, strict=True):
        (room / name).mkdir(parents=True)
        np.save(room / name / "0001.npy", array)
    options = (
        *("--profile", "myopia", "--fov-deg", FOV_DEG, "--engine", "native"),
        *("--pupil-mm", SEE["pupil_diameter_mm"], "--focus-dpt", SEE["focus_dpt"]),
    )
    printed = run(
        "filter",
        *("--color", room / "color" / "0001.npy"),
        *("--depth", room / "depth" / "0001.npy", *options),
        *("--pipeline", "published", "--mode", "on-axis"),
        *("-o", tmp_path / "seen.npy"),
    )
    assert "pipeline published, mode on-axis, grid paper" in printed
    assert "note: PSFs by the ENZ series to degree 30" in printed
    np.testing.assert_array_equal(np.load(tmp_path / "seen.npy"), color)
    process = start(
        *(room, *options, "--settings", json.dumps(SETTINGS)),
        *("--format", "npy", "--workers", 1, "-o", tmp_path / "batch"),
    )
    _, error = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, error
    (seen,) = (tmp_path / "batch").rglob("*.npy")
    np.testing.assert_array_equal(np.load(seen), color)


def test_what_it_does_not_model_is_refused_by_the_service(use_service):
    service = use_service(command=SERVE_COMMAND, engine="native")
    with FilterClient(service.endpoint, timeout_s=LIMIT_S) as client:
        glasses = {"sphere_dpt": -3, "vertex_mm": 12}
        body = {"kind": "prescription", "sphere_dpt": -3, "correction": glasses}
        with pytest.raises(BuildFailed, match="a correction, such as") as caught:
            client.set_profile(body, settings=SETTINGS, views=[CAMERA])
        assert caught.value.field == "settings.pipeline"
        with pytest.raises(BadMessage, match="with pipeline 'published'"):
            client.set_profile("myopia", settings=SETTINGS | {"diffraction": False})
