"""`ocufilter batch`: the same bytes whoever makes them, in any order, after kills."""

import fcntl
import hashlib
import json
import os
import random
import re
import shutil
import signal
import time
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clients.batch.layouts import list_frames
from clients.batch.manifest import Manifest
from clients.batch.source import FieldOfView, States
from clients.batch.work import Job, Unit, UnitRunner, batch_settings
from clients.commands.program import app
from filter_service import Camera, EyeFilter, RgbdView
from filter_service.command_line import exit_code
from filter_service.image_files import read_color
from tests.batch_kills import (
    MARK,
    kill,
    line_count,
    pictures,
    start,
    wait_for_orphans,
    workers_of,
)
from tests.commands import run_command
from tests.numerical.synthetic import psnr_db

TIMEOUT_S = 120
WIDTH_PX, HEIGHT_PX = 64, 48
COUNT = 40
PROFILES = ("-p", "myopia", "-p", "normal=emmetropia")
MODE = ("--settings", '{"mode": "on-axis", "eye_model": "wavefront"}')
"""Quick to prepare: these tests are about files and processes."""


def run(*arguments, code=0):
    finished = run_command("batch", *arguments)
    assert finished.returncode == code, finished.stderr
    return finished.stdout, finished.stderr


def write_frame(folder, name, rng):
    color = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    depth_mm = rng.integers(400, 3000, (HEIGHT_PX // 8, WIDTH_PX // 8))
    depth_mm = np.kron(depth_mm, np.ones((8, 8))).astype(np.uint16)
    depth_mm[:2, :3] = 0
    Image.fromarray(color).save(folder / f"color/{name}.png")
    Image.fromarray(depth_mm).save(folder / f"depth/{name}.png")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder of frames."""
    folder = tmp_path_factory.mktemp("room")
    for name in ("color", "depth"):
        (folder / name).mkdir()
    rng = np.random.default_rng(5)
    for number in range(COUNT):
        write_frame(folder, f"{number:03d}", rng)
    return folder


@pytest.fixture
def long_room(room, tmp_path):
    """The same frames ten times."""
    folder = tmp_path / "room"
    for path in room.glob("*/*.png"):
        (folder / path.parent.name).mkdir(parents=True, exist_ok=True)
        for k in range(10):
            (folder / path.parent.name / f"{k}{path.name}").hardlink_to(path)
    return folder


@pytest.fixture(scope="module")
def usual(room, tmp_path_factory):
    """What one worker makes of it, undisturbed."""
    out = tmp_path_factory.mktemp("usual") / "out"
    told = run(room, *PROFILES, *MODE, "--fov-deg", 20, "-o", out, "--workers", 1)
    assert "80 of 80 images" in told[0]
    return out


@pytest.mark.long("an eye is built over all pupils")
def test_one_worker_makes_what_the_filter_makes(room, usual):
    states = States(4.0, 0.0)
    mode = json.loads(MODE[1])
    job = Job(
        {"myopia": {"kind": "preset", "name": "myopia"}},
        batch_settings(mode, states),
        states,
    )
    camera = Camera.from_fov(20.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    color = read_color(room / "color/007.png")
    depth_m = 0.001 * np.asarray(Image.open(room / "depth/007.png")).astype(np.float64)
    view = RgbdView(color, depth_m.astype(np.float32), camera.tangents)
    with EyeFilter("myopia", camera, job.settings, engine="native") as eye_filter:
        eye_filter.wait()
        seen = eye_filter.filter(view, pupil_diameter_mm=4.0, focus_dpt=0.0)
    np.testing.assert_array_equal(read_color(usual / "myopia/007.png"), seen.color)
    assert not np.array_equal(seen.color, color)


def test_the_manifest_tells_of_every_frame(room, usual):
    lines = (usual / "manifest.jsonl").read_text().splitlines()
    job, *frames = map(json.loads, lines)
    assert job["profiles"]["normal"] == {"kind": "preset", "name": "emmetropia"}
    assert job["settings"]["pupil_range_mm"] == [2.0, 7.0]
    assert len(frames) == 2 * COUNT
    first = next(r for r in frames if (r["profile"], r["frame"]) == ("myopia", "000"))
    assert first["missing_depth_count"] == 6
    path = usual / first["file"]
    assert first["bytes"] == path.stat().st_size
    names = [(told["name"], told["bytes"]) for told in first["inputs"]]
    files = [room / part / "000.png" for part in ("color", "depth")]
    assert names == [(path.name, path.stat().st_size) for path in files]
    summary = json.loads((usual / "manifest.json").read_text())
    assert summary["frames_done"] == {"myopia": COUNT, "normal": COUNT}
    assert summary["missing_depth_count"] == 6 * 2 * COUNT
    assert "far point" in summary["notes"][0]["example"]


@pytest.mark.clients
def test_two_workers_of_two_threads_make_the_same_bytes(room, usual, tmp_path):
    common = (room, *PROFILES, *MODE, "--fov-deg", 20, "-o", tmp_path / "out")
    run(*common, "--workers", 2, "--threads", 2)
    assert pictures(tmp_path / "out") == pictures(usual)


@pytest.mark.clients
def test_the_other_engine_makes_the_same_pictures_and_says_so(room, usual, tmp_path):
    out = tmp_path / "out"
    run(room, *PROFILES, *MODE, "--fov-deg", 20, "-o", out, "--engine", "gl")
    job = json.loads((out / "manifest.jsonl").read_text().splitlines()[0])
    assert job["engine"] == "gl"
    for name in sorted(path.relative_to(usual) for path in usual.glob("*/*.png")):
        found, native = (read_color(folder / name) for folder in (out, usual))
        # Whether some pixels merge may hang on the last bit of a number.
        assert psnr_db(found / 255.0, native / 255.0) >= 50.0, name


def finish_after_kills(room, out, n_kills):
    arguments = (room, *PROFILES, *MODE, "--fov-deg", 20, "--workers", 2)
    chance, n_lines = random.Random(n_kills), []
    for _ in range(n_kills):
        assert kill(arguments, out, chance)
        n_lines.append(line_count(out))
    assert n_lines == sorted(n_lines)  # no line was lost
    run(*arguments, "-o", out)
    wait_for_orphans(out)
    run(*arguments, "-o", out)  # clears what those left
    assert not list(out.rglob(".ocufilter-*"))


@pytest.mark.clients
def test_killed_at_random_moments_and_finished_nothing_is_lost(room, usual, tmp_path):
    out = tmp_path / "out"
    finish_after_kills(room, out, 1)
    assert pictures(out) == pictures(usual)


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced(long_room, tmp_path, usual):
    out = tmp_path / "out"
    arguments = (long_room, *PROFILES, *MODE, "--fov-deg", 20, "--workers", 2)
    process = start(*arguments, "-o", out, **{MARK: str(out)})
    for n_lines in (5, 50):
        while line_count(out) < n_lines:
            assert process.poll() is None
            time.sleep(0.01)
        os.kill(workers_of(out)[0], signal.SIGKILL)
    _, error = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, error
    assert pictures(out) == ten_times(pictures(usual))


@pytest.mark.slow
def test_a_batch_that_is_interrupted_says_how_to_go_on(long_room, tmp_path):
    out = tmp_path / "out"
    process = start(long_room, *PROFILES, *MODE, "--fov-deg", 20, "-o", out)
    while line_count(out) < 9:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=20)
    assert process.returncode == 130
    assert error.endswith("batch: stopped; run the same command again to continue\n")
    assert "Traceback" not in error


def ten_times(expected):
    """Return what `long_room` gives, from what `room` gives."""
    return {
        name.replace("/", f"/{k}"): content
        for name, content in expected.items()
        for k in range(10)
    }


@pytest.mark.slow
def test_killed_twenty_times_and_finished_nothing_is_lost(long_room, usual, tmp_path):
    out = tmp_path / "out"
    finish_after_kills(long_room, out, 20)
    assert pictures(out) == ten_times(pictures(usual))


@pytest.mark.clients
def test_a_rerun_does_only_what_is_missing(room, usual, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(usual, out)
    arguments = (room, *PROFILES, *MODE, "--fov-deg", 20, "-o", out, "--workers", 1)
    told, _ = run(*arguments)
    assert "0 of them in this run" in told
    (out / "myopia/003.png").unlink()
    (out / "normal/004.png").write_bytes(b"cut short")
    with (out / "manifest.jsonl").open("ab") as file:
        file.write(b'{"kind": "frame", "profile": "myo')  # a power cut
    zeros = out / "normal/006.png"  # whose size is right
    zeros.write_bytes(bytes(zeros.stat().st_size))
    half = out / f"myopia/.ocufilter-{'0f' * 16}.part.png"
    half.write_bytes(b"half")
    of_the_user = {
        out / name: b"of the user"
        for name in (".mine.part.txt", "myopia/.005.abc.part.png", "myopia/.part")
    }
    for path, content in of_the_user.items():
        path.write_bytes(content)
    told, _ = run(*arguments)
    assert "80 of 80 images, 3 of them in this run" in told
    assert {path: path.read_bytes() for path in of_the_user} == of_the_user
    for path in of_the_user:
        path.unlink()
    assert pictures(out) == pictures(usual)


def refusal(capsys, *arguments):
    """Return the one line that the program, run here, refuses its arguments with."""
    words = ["batch", *map(str, arguments)]
    assert exit_code(app, words, "ocufilter") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_another_job_in_the_same_folder_is_refused(room, usual, tmp_path, capsys):
    arguments = (room, *PROFILES, *MODE, "--fov-deg", 20)
    error = refusal(capsys, *arguments, "-o", usual, "--pupil-mm", 5)
    assert "states.pupil_mm is 5.0, but was 4.0" in error
    assert "--overwrite" in error
    fewer = refusal(capsys, room, *PROFILES[:2], *MODE, "--fov-deg", 20, "-o", usual)
    assert "is not given, but was" in fewer
    (tmp_path / "thesis.pdf").touch()
    error = refusal(capsys, *arguments, "-o", tmp_path)
    assert "contains 'thesis.pdf' and no manifest.jsonl" in error


def test_overwrite_beside_a_running_batch_removes_nothing(
    room, usual, tmp_path, capsys
):
    out = tmp_path / "out"
    shutil.copytree(usual, out)
    arguments = (room, *PROFILES, *MODE, "--fov-deg", 20, "-o", out, "--overwrite")
    with (out / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        error = refusal(capsys, *arguments)
    assert "another batch is running there" in error
    for name in ("manifest.jsonl", "manifest.json"):
        assert (out / name).read_bytes() == (usual / name).read_bytes()
    assert pictures(out) == pictures(usual)


@pytest.mark.parametrize("name", ["myopia", ".segments"])
def test_a_folder_of_results_that_is_a_link_is_refused(room, tmp_path, name, capsys):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()
    common = (room, *PROFILES, *MODE, "--fov-deg", 20, "-o", out)
    with Manifest(out_folder(out), {}):
        (out / name).symlink_to(elsewhere)
    assert f"{name}' leads outside" in refusal(capsys, *common, "--overwrite")
    assert not list(elsewhere.iterdir())


def out_folder(out):
    out.mkdir()
    return out


@pytest.mark.clients
def test_a_worker_does_not_follow_a_link_to_elsewhere(room, tmp_path):
    """The link appears while the batch runs."""
    (tmp_path / "out").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out/myopia").symlink_to(tmp_path / "elsewhere")
    (record,) = run_unit(room, tmp_path / "out", States(4.0, 0.0))
    assert "leads outside" in record["error"]
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.slow
def test_overwrite_begins_anew(room, tmp_path):
    common = (room, "-p", "myopia", *MODE, "--fov-deg", 20, "-o", tmp_path / "out")
    run(*common, "--limit", 2, "--format", "npy")
    told, _ = run(*common, "--limit", 1, "--format", "exr", "--half", "--overwrite")
    assert "1 of 1 images" in told
    names = {path.name for path in (tmp_path / "out/myopia").iterdir()}
    assert names == {"000.exr"}
    assert read_color(tmp_path / "out/myopia/000.exr").max() < 1.2


def run_unit(room, out, states):
    """Filter the first frame of a room as a worker does; return its record."""
    optics = FieldOfView(20.0)
    _, frames = list_frames(room, "pairs", optics=optics)
    settings = batch_settings(json.loads(MODE[1]), states)
    job = Job({"myopia": {"kind": "preset", "name": "myopia"}}, settings, states)
    with closing(UnitRunner(job, out)) as runner:
        return list(runner.run(Unit(0, "myopia", tuple(frames[:1]))))


@pytest.mark.long("prepares an eye in its own process")
def test_the_bytes_that_are_decoded_are_hashed(room, usual, tmp_path, rng):
    """A file changes after it has been read, when the state of its frame is asked."""
    copy = tmp_path / "room"
    shutil.copytree(room, copy)

    class Replacing(States):
        def of(self, name, depth_m):
            write_frame(copy, name, rng)
            return super().of(name, depth_m)

    (record,) = run_unit(copy, tmp_path / "out", Replacing(4.0, 0.0))
    files = [room / part / "000.png" for part in ("color", "depth")]
    assert [one["sha256"] for one in record["inputs"]] == [
        hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    ]
    seen = (tmp_path / "out/myopia/000.png").read_bytes()
    assert seen == (usual / "myopia/000.png").read_bytes()


@pytest.mark.clients
def test_names_of_any_bytes_are_resumed(tmp_path, rng):
    """Also of folders, and of two names that look alike."""
    names = [b"caf\xe9", rb"caf\xe9", b"two\nlines", "\u4e2d".encode() * 83]
    room = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xe9 room"))
    for part in ("color", "depth"):
        (room / part).mkdir(parents=True)
    for name in names:
        write_frame(room, os.fsdecode(name), rng)
    (room / "depth" / os.fsdecode(b"no color \xe9\n.png")).write_bytes(b"")
    out = room / "out"
    common = (room, "-p", "myopia", *MODE, "--fov-deg", 20, "-o", out, "--workers", 1)
    told, error = run(*common, "--json", code=1)
    assert json.loads(told)["frames_done"] == {"myopia": 4}
    assert error.count("\n") == 2  # the frame and the number of them
    found = {os.fsencode(path.name) for path in (out / "myopia").iterdir()}
    assert found == {name + b".png" for name in names}
    lines = (out / "manifest.jsonl").read_text(encoding="ascii").splitlines()
    for line in (*lines, (out / "manifest.json").read_text(encoding="ascii")):
        json.dumps(json.loads(line), ensure_ascii=False).encode()  # valid Unicode
    (out / "myopia" / os.fsdecode(names[1] + b".png")).unlink()
    told, _ = run(*common, code=1)
    assert "4 of 5 images, 1 of them in this run" in told


@pytest.mark.clients
def test_frames_of_another_camera_are_filtered_again(room, tmp_path):
    common = (room, "-p", "myopia", *MODE, "-o", tmp_path / "out", "--limit", 2)
    run(*common, "--fov-deg", 20, "--workers", 1)
    before = pictures(tmp_path / "out")
    told, _ = run(*common, "--fov-deg", 30, "--workers", 1)
    assert "2 of 2 images, 2 of them in this run" in told
    now = pictures(tmp_path / "out")
    assert all(now[name] != before[name] for name in before)


@pytest.mark.clients
def test_a_video_of_zeros_is_joined_again(room, tmp_path):
    out = tmp_path / "out"
    common = (room, "-p", "myopia", *VIDEO, "ffv1", "-o", out, "--limit", 3)
    run(*common, "--workers", 1)
    video = out / "myopia.mkv"
    before = video.read_bytes()
    video.write_bytes(bytes(len(before)))
    told, _ = run(*common, "--workers", 1)
    assert "0 of them in this run" in told
    assert video.read_bytes() == before


@pytest.mark.long("two runs, each with a process that builds an eye")
def test_bad_files_are_named_and_the_rest_goes_on(tmp_path, rng):
    room = tmp_path / "room"
    for name in ("color", "depth"):
        (room / name).mkdir(parents=True)
    for number in range(4):
        write_frame(room, f"{number}", rng)
    (room / "color/1.png").write_bytes(b"no picture")
    (room / "depth/2.png").unlink()
    Image.new("I;16", (5, 5)).save(room / "depth/3.png")
    out = tmp_path / "out"
    common = (room, "-p", "myopia", *MODE, "--fov-deg", 20, "-o", out, "--workers", 1)
    told, error = run(*common, code=1)
    assert "1 of 4 images, 1 of them in this run" in told
    assert "1.png': cannot be read" in error
    assert "no depth with the name '2'" in error
    assert "5x5 px; allowed: the size of" in error
    assert "3 images failed" in error
    summary = json.loads((out / "manifest.json").read_text())
    assert [one["frame"] for one in summary["failures"]] == ["1", "2", "3"]
    for number in (1, 2, 3):  # mended
        write_frame(room, f"{number}", rng)
    told, _ = run(*common)
    assert "4 of 4 images, 3 of them in this run" in told


def decoded(path):
    import av

    with av.open(str(path)) as container:
        frames = [
            frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)
        ]
        return frames, float(container.streams.video[0].average_rate)


@pytest.mark.clients
@pytest.mark.parametrize("fps", [None, 5])
def test_a_turned_video_of_variable_rate_keeps_its_times(tmp_path, fps):
    """As a phone writes it: sideways, with a flag, and slower in the dark."""
    import av

    ticks = [0, 100, 200, 800, 1500]
    with av.open(str(tmp_path / "a.mov"), "w") as container:
        stream = container.add_stream("png", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH_PX, HEIGHT_PX, "rgb24"
        stream.set_display_rotation(90)
        stream.codec_context.time_base = Fraction(1, 1000)
        for k, ticks_ms in enumerate(ticks):
            image = np.full((HEIGHT_PX, WIDTH_PX, 3), 40 * k, np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = ticks_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    (tmp_path / "depth").mkdir()
    for k in range(len(ticks)):
        depth_m = np.full((WIDTH_PX, HEIGHT_PX), 2.0, np.float32)  # upright
        np.save(tmp_path / f"depth/{k}.npy", depth_m)
    out = tmp_path / "out"
    arguments = (tmp_path / "a.mov", "--depth", tmp_path / "depth", *MODE)
    given = () if fps is None else ("--fps", fps)
    run(
        *arguments,
        "-p",
        "myopia",
        "--fov-deg",
        20,
        "--format",
        "ffv1",
        *given,
        "-o",
        out,
    )
    with av.open(str(out / "myopia.mkv")) as container:
        found = list(container.decode(video=0))
    times_s = np.array(ticks) / 1000.0 if fps is None else np.arange(5) / fps
    np.testing.assert_allclose([frame.time for frame in found], times_s, atol=1e-3)
    assert (found[0].width, found[0].height) == (HEIGHT_PX, WIDTH_PX)
    means = [frame.to_ndarray(format="rgb24").mean() for frame in found]
    np.testing.assert_allclose(means, 40 * np.arange(5), atol=1.0)


VIDEO = (*MODE, "--fov-deg", 20, "--fps", 24, "--format")


@pytest.mark.slow
def test_a_video_without_loss_holds_the_pictures(room, usual, tmp_path):
    out = tmp_path / "out"
    run(room, "-p", "myopia", *VIDEO, "ffv1", "-o", out, "--workers", 1)
    frames, rate_hz = decoded(out / "myopia.mkv")
    assert (len(frames), rate_hz) == (COUNT, 24.0)
    for number, frame in enumerate(frames):
        expected = read_color(usual / f"myopia/{number:03d}.png")
        np.testing.assert_array_equal(frame, expected)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ffv1", "h264"])
def test_videos_are_the_same_bytes_by_two_workers_and_after_a_kill(
    long_room, tmp_path, kind
):
    arguments = (long_room, "-p", "myopia", *VIDEO, kind, "--workers")
    run(*arguments, 1, "-o", tmp_path / "one")
    out = tmp_path / "two"
    for _ in range(2):
        assert kill((*arguments, 2), out, random.Random(kind))
    run(*arguments, 2, "-o", out)
    assert pictures(out) == pictures(tmp_path / "one")
    frames, rate_hz = decoded(next(out.glob("myopia.*")))
    assert (len(frames), rate_hz) == (10 * COUNT, 24.0)


@pytest.mark.clients
def test_a_dry_run_measures_and_writes_nothing(room, tmp_path):
    out = tmp_path / "out"
    common = (room, "-p", "myopia", *MODE, "--fov-deg", 20, "-o", out, "--dry-run")
    told, _ = run(*common, "--json", "--workers", 2, "--price-per-core-hour", 0.5)
    report = json.loads(told)
    assert not out.exists()
    assert (report["frames"], report["pictures_missing"]) == (COUNT, COUNT)
    assert report["cores"] == 2
    (one,) = report["profiles"]
    assert report["seconds"] >= round(one["build_s"], 1) > 0.0  # PSFs are counted
    ms = report["ms_per_picture_and_core"]
    assert report["core_hours_per_million"] == pytest.approx(ms / 3.6, rel=0.01)
    assert report["price_per_million"] == pytest.approx(ms / 7.2, rel=0.02)


def test_a_dry_run_of_frames_that_cannot_be_read_fails_with_each_error_once(tmp_path):
    for name in ("color", "depth"):
        (tmp_path / name).mkdir()
        for number in range(3):
            (tmp_path / name / f"{number}.png").write_bytes(b"no picture")
    out, _ = run(
        *(tmp_path, "-p", "myopia", *MODE, "--fov-deg", 20, "--dry-run"),
        *("-o", tmp_path / "out"),
        code=1,
    )
    assert out.count("error: ") == 3  # each names its file


@pytest.mark.clients
def test_a_dry_run_groups_notes_as_a_run_does(room, tmp_path):
    """Frames of the measured eye, each with a focus of its own beyond reach."""
    lines = [f"{n:03d},4,{0.1 * n:.2f}" for n in range(COUNT)]
    states = tmp_path / "states.csv"
    states.write_text("\n".join(["frame,pupil_mm,focus_dpt", *lines]))
    common = (room, "-p", "myopia", *MODE, "--fov-deg", 20, "-o", tmp_path / "out")
    told, _ = run(*common, "--states", states, "--dry-run")
    notes = [line for line in told.splitlines() if "note:" in line]
    assert len([note for note in notes if "far point" in note]) == 1, told
    assert re.search(r"\d+ frames: blurred: .* focus 0 to", notes[0])


@pytest.mark.clients
def test_profiles_may_be_json_and_photographs_are_turned_upright(tmp_path, rng):
    room = tmp_path / "room"
    for name in ("color", "depth"):
        (room / name).mkdir(parents=True)
    write_frame(room, "a", rng)
    stored = np.asarray(Image.open(room / "color/a.png"))
    turned = Image.Exif()
    turned[0x0112] = 3  # upside down
    Image.fromarray(stored).save(room / "color/a.png", exif=turned)
    body = '{"kind": "prescription", "sphere_dpt": 0, "name": "plano"}'
    out = tmp_path / "out"
    run(room, "-p", body, *MODE, "--fov-deg", 20, "-o", out, "--workers", 1)
    seen = read_color(out / "plano/a.png").astype(int)
    upright = stored[::-1, ::-1]
    assert np.abs(seen - upright).mean() < 0.5 * np.abs(seen - stored).mean()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere", "-p", "myopia"), "'nowhere': no such file"),
        (("{room}", "-p", "hawk"), "'hawk' is not known"),
        (
            ("{room}", "-p", "myopia", "-p", "myopia"),
            "'myopia' is empty or already used",
        ),
        (("{room}", "-p", "myopia", "--focus-dpt", "near"), "--focus-dpt is 'near'"),
        (("{room}", "-p", "myopia", "--workers", "0"), "--workers is 0; allowed: 1"),
        (("{room}", "-p", "myopia", "--half"), "--half: allowed with --format npy"),
    ],
)
def test_bad_input_is_refused_in_a_line(room, tmp_path, arguments, words, capsys):
    filled = [text.replace("{room}", str(room)) for text in arguments]
    out = tmp_path / "out"
    assert words in refusal(capsys, *filled, "--fov-deg", 20, "-o", out)
    assert not out.exists()


@pytest.fixture(autouse=True)
def signals():
    """The program handles one in its own way; here it runs in the tests' process."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)
