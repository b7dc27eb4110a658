"""The demo from the command line: its files, its report, and how it fails."""

import functools
import json
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import clients.batch
from clients import demo, pyrender_stream, sheet
from clients.batch import video_writing
from clients.batch.video_reading import VideoReader
from clients.commands.options import read_profile, read_size_px
from clients.demo import EYES
from clients.frame_log import FrameLog, percentiles
from clients.pyrender_stream import path_settings
from clients.scenes.catalog import build_scene
from clients.service_process import CHECKOUT, ServiceProcess
from estimator.profiles.files import profile_body
from filter_service.command_line import app_of, exit_code
from filter_service.messages import State
from filter_service.progress import INTERVAL_S
from tests.commands import run_command

pytestmark = pytest.mark.clients

N_FRAMES = 4
SIZE_PX = (160, 90)


@pytest.fixture(scope="module")
def demo_run(tmp_path_factory):
    """One small demo in a process of its own: its folder and what it printed."""
    folder = tmp_path_factory.mktemp("demo")
    command = [sys.executable, "-m", "ocufilter", "demo", "--out", str(folder)]
    command += ["--frames", str(N_FRAMES), "--size", "160x90"]
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=CHECKOUT, **output) as process:
        lines = [(line, time.monotonic()) for line in process.stderr]
        said = process.stdout.read()
    assert process.returncode == 0, "".join(line for line, _ in lines)
    assert "contact_sheet.png" in said
    report = json.loads((folder / "latency.json").read_text())
    return folder, report, [*lines, ("", time.monotonic())]


@pytest.mark.clock
def test_demo_says_into_a_pipe_what_it_does(demo_run):
    *_, lines = demo_run
    text = "".join(line for line, _ in lines)
    stages = ["Rendering the scenes", *(eye.title for eye in EYES), "the video"]
    places = [text.index(stage) for stage in stages]
    assert places == sorted(places)
    assert f"{N_FRAMES}/{N_FRAMES} frames" in text
    silences_s = [after - before for (_, before), (_, after) in pairwise(lines)]
    assert max(silences_s) < 2 * INTERVAL_S


def test_demo_streams_every_frame_through_every_eye(demo_run):
    _, report, _ = demo_run
    assert list(report["eyes"]) == [eye.preset for eye in EYES]
    for eye in report["eyes"].values():
        assert eye["frames"] == N_FRAMES
        assert eye["drops"] == {}
        ages = eye["frame_age_ms"]
        assert 0 < ages["p50"] <= ages["p95"] <= ages["p99"]
        assert "splat_ms" in eye["stages_ms"]  # of either engine


def test_demo_changes_eyes_while_frames_go_on_through_the_old_one(demo_run):
    _, report, _ = demo_run
    changes = [eye["eye_change"] for eye in report["eyes"].values()]
    for before, after in pairwise(changes):
        assert after["generation"] > before["generation"]
        assert after["frames_through_previous_eye"] >= 1
        assert after["previous_generation"] == before["generation"]


def test_demo_writes_a_video_of_all_frames_and_a_contact_sheet(demo_run):
    folder, report, _ = demo_run
    assert json.loads((folder / "latency.json").read_text()) == report
    # Four pictures across, four rows of them.
    with Image.open(folder / "contact_sheet.png") as sheet_image:
        assert sheet_image.width > 4 * sheet.MIN_CELL_WIDTH_PX
        assert sheet_image.height > 4 * sheet.MIN_CELL_WIDTH_PX * 90 / 160
    cell_w, cell_h = sheet.cell_size_px(SIZE_PX)
    # Four cells of one width with gaps of 10 px; two rows below a title of 42 px, with
    # captions of 34 px.
    frames = _decoded(report["video"], 4 * cell_w + 50, 42 + 2 * (cell_h + 44))
    assert len(frames) == N_FRAMES
    first, last = frames[0], frames[-1]
    assert np.abs(first.astype(int) - last).mean() > 2
    # Input, top left, and -6 D, third in its row, where the pupil is widest.
    top, gap = 60, 10
    widest = frames[1]
    sharp = widest[top : top + cell_h // 2, gap : gap + cell_w]
    left = gap + 2 * (cell_w + gap)
    myopic = widest[top : top + cell_h // 2, left : left + cell_w]
    assert _detail(sharp) > 1.5 * _detail(myopic)


def _decoded(path, width, height):
    """All frames (n, h, w, 3) of a video of that size."""
    with VideoReader(Path(path)) as reader:
        frames = np.stack([reader.color(k).pixels for k in range(reader.count)])
    assert frames.shape[1:] == (height, width, 3)
    return frames


def _detail(image):
    """Mean step between neighbors in a row."""
    return np.abs(np.diff(image.astype(int).mean(axis=-1), axis=1)).mean()


def primitives_only(name):
    """The scene that takes the least time to build."""
    return build_scene("primitives")


def test_demo_reports_a_service_that_does_not_start(monkeypatch, tmp_path):
    command = (sys.executable, "-c", "print('no GL here'); raise SystemExit(3)")
    broken = functools.partial(ServiceProcess, command=command)
    monkeypatch.setattr(demo, "ServiceProcess", broken)
    monkeypatch.setattr(demo, "build_scene", primitives_only)
    arguments = ["--out", str(tmp_path), "--frames", "1", "--size", "64x36"]
    ended = run_command("demo", *arguments)
    assert ended.returncode == 1
    (line,) = [x for x in ended.stderr.splitlines() if x.startswith("ocufilter: ")]
    assert "code 3" in line
    assert "no GL here" in line


def test_demo_reports_a_service_that_dies_on_the_way(monkeypatch, tmp_path):
    change_eye, services = demo.change_eye, []

    def recorded(**options):
        services.append(ServiceProcess(**options))
        return services[0]

    def change_then_kill(client, *args, **settings):
        change = change_eye(client, *args, **settings)
        services[0].process.kill()
        client.timeout_s = 3.0  # for a frame that is sent after the connection ended
        return change

    monkeypatch.setattr(demo, "build_scene", primitives_only)
    monkeypatch.setattr(demo, "ServiceProcess", recorded)
    monkeypatch.setattr(demo, "change_eye", change_then_kill)
    arguments = ["--out", str(tmp_path), "--frames", "1", "--size", "64x36"]
    ended = run_command("demo", *arguments, "--json")
    assert ended.returncode == 1
    assert ended.stdout == ""
    *told, line = ended.stderr.splitlines()
    assert "connection" in line
    assert any(f"serving on {services[0].endpoint}" in x for x in told)
    assert all(x.startswith("service: ") for x in told)


@pytest.mark.parametrize(
    "broken", [{"codec": "no_such_encoder"}, {"options": (("preset", "none"),)}, None]
)
def test_gif_stands_in_where_the_encoder_fails_or_lacks(broken, monkeypatch, tmp_path):
    if broken is None:
        monkeypatch.setitem(sys.modules, "clients.batch.video_writing", None)
        monkeypatch.delattr(clients.batch, "video_writing")
    else:
        kind = replace(video_writing.VIDEO_KINDS["h264"], **broken)
        monkeypatch.setitem(video_writing.VIDEO_KINDS, "h264", kind)
    shades = [np.full((20, 40, 3), shade, np.uint8) for shade in (0, 120, 250)]
    written = sheet.write_video(tmp_path / "film", lambda: iter(shades), 10)
    assert written == tmp_path / "film.gif"
    assert list(tmp_path.iterdir()) == [written]
    with Image.open(written) as gif:
        assert gif.n_frames == 3
        assert gif.size == (40, 20)
        gif.seek(2)
        assert np.asarray(gif.convert("RGB")).mean() == pytest.approx(250, abs=3)


def test_mp4_keeps_colors_and_order(tmp_path):
    colors = ((200, 30, 30), (30, 200, 30), (30, 30, 200))
    images = [np.full((64, 96, 3), color, np.uint8) for color in colors]
    written = sheet.write_video(tmp_path / "film", lambda: iter(images), 10)
    assert written == tmp_path / "film.mp4"
    assert list(tmp_path.iterdir()) == [written]
    means = _decoded(written, 96, 64).mean(axis=(1, 2))
    # Chroma at half resolution and video levels cost a few steps on flat colors.
    assert means == pytest.approx(np.array(colors, float), abs=8)


def test_odd_sizes_become_even_cells():
    assert sheet.cell_size_px((481, 271)) == (480, 270)
    assert sheet.cell_size_px((95, 53)) == (320, 178)
    assert sheet.cell_size_px((1280, 720)) == (480, 270)


@pytest.mark.parametrize(
    ("focus_dpt", "text"), [(0.0, "far away"), (0.25, "4.0 m"), (2.5, "40 cm")]
)
def test_focus_is_said_as_a_distance(focus_dpt, text):
    assert sheet.EyeState("Courtyard", State(4.0, focus_dpt)).distance() == text


def test_percentiles_of_a_known_series():
    assert percentiles([float(i) for i in range(101)]) == {
        "p50": 50.0,
        "p95": 95.0,
        "p99": 99.0,
    }
    assert percentiles([]) == {"p50": None, "p95": None, "p99": None}
    assert FrameLog().summary()["frames"] == 0


def test_settings_cover_the_whole_path():
    settings = path_settings("courtyard", "primitives")
    low, high = settings["pupil_range_mm"]
    assert low <= 3.0
    assert high >= 4.95
    low, high = settings["focus_range_dpt"]
    assert low <= 1 / 14
    assert high >= 4.0


def test_the_gaze_goes_round_the_image_as_far_as_was_asked(
    shared_service, monkeypatch, capsys
):
    asked = []

    def submit(client, views, **state):
        asked.append(state["gaze_deg"])
        return original(client, views, **state)

    original = pyrender_stream.FilterClient.submit
    monkeypatch.setattr(pyrender_stream.FilterClient, "submit", submit)
    monkeypatch.setattr(
        pyrender_stream, "read_profile", lambda name: {"kind": "double", "mark": 1}
    )
    endpoint = shared_service.endpoint
    arguments = ["--endpoint", endpoint, "--size", "64x36", "--frames", "4"]
    arguments += ["--scene", "primitives"]
    app = app_of(pyrender_stream.pyrender_stream)
    assert exit_code(app, [*arguments, "--look-around", "20"], "stream") == 0
    assert exit_code(app, [*arguments, "--look-around", "31"], "stream") == 2
    assert asked[0] == (0.0, 10.0)
    assert len(asked) == 4
    assert all(np.hypot(h, 2 * v) == pytest.approx(20) for h, v in asked)
    assert "0 to 30" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["480", "480x", "8x8", "axb", "480x270x3"])
def test_bad_size_is_refused_with_what_is_allowed(text):
    with pytest.raises(ValueError, match=r"size is '.*'; allowed: WIDTHxHEIGHT"):
        read_size_px(text)


ABP = "Ap = 5.0\nWa = 555\nZ[2, 0] = 1.5  # um\n"


def test_profile_is_a_preset_json_or_a_file(tmp_path):
    assert read_profile("myopia") == {"kind": "preset", "name": "myopia"}
    assert read_profile('{"kind": "double"}') == {"kind": "double"}
    path = tmp_path / "eye.json"
    path.write_text('{"kind": "prescription", "sphere_dpt": -2}')
    assert read_profile(str(path)) == {"kind": "prescription", "sphere_dpt": -2}
    path.with_suffix(".ABP").write_text(ABP)
    found = read_profile(str(path.with_suffix(".ABP")))
    assert (found["pupil_diameter_mm"], found["zernike_um"]) == (5.0, {"2,0": 1.5})


def test_inline_json_is_read_as_a_file_is(tmp_path):
    frozen = Path(__file__).parents[1] / "data" / "optiland_files.json"
    optic = json.loads(frozen.read_text())["files"]["toroid"]["json"]
    surface = {"radius_mm": 7.8, "z_mm": 0, "medium_after": "cornea"}
    eye = {"surfaces": [surface], "stop_z_mm": 3, "retina": {"radius_mm": -12}}
    path = tmp_path / "profile.json"
    for content in (optic, eye):
        text = json.dumps(content)
        path.write_text(text)
        found = read_profile(text)
        assert found["kind"] == "surfaces"
        assert found == read_profile(str(path)) == profile_body(text)
    broken = json.dumps({**optic, "surface_group": 3})
    with pytest.raises(ValueError, match=r"--left .*surface_group': 3 is not"):
        read_profile(broken, "--left")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (
            "eye.json",
            "[1, 2]",
            r"--left .*eye.json': \[1, 2\] is not an object; allowed: one JSON",
        ),
        ("eye.json", "{", "--left .*not JSON"),
        ("eye.abp", "Q = 1", "--left .*eye.abp': line 1: cannot read 'Q = 1'; allowed"),
        ("eye.png", "{}", "--left .*eye.png.* allowed: a preset"),
    ],
)
def test_a_profile_that_is_none_is_named_with_its_option(tmp_path, name, text, words):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        read_profile(str(path), "--left")
    path.unlink()
    said = "is not known" if path.suffix == ".png" else "does not exist"
    with pytest.raises(ValueError, match=rf"--left .*{said}"):
        read_profile(str(path), "--left")
