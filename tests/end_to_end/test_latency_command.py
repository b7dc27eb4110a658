"""`ocufilter latency`: counts, the error of what came back, and who is not measured."""

import json

import numpy as np
import pytest

from clients.filter_client import FilterClient
from clients.latency.stream import (
    N_FRAMES,
    StreamSettings,
    make_frames,
    measure_stream,
)
from filter_service import EyeFilter
from filter_service.errors import ConnectionLost
from tests.commands import run_command

SIZE_PX = (64, 36)
N_SENT = 6
QUICK = ("--size", "64x36", "--rate", 20, "--frames", N_SENT)
PLAIN = {"mode": "on-axis", "eye_model": "wavefront"}
OPTIONS = ("--mode", "on-axis", "--eye-model", "wavefront")
PERCENTILES = ["p50", "p90", "p99", "max"]


def one_line(finished, code):
    assert finished.returncode == code, finished.stderr
    assert finished.stdout == ""
    assert finished.stderr.count("\n") == 1, finished.stderr
    return finished.stderr


def rows_of(finished):
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout)["rows"]


def psnr_db(seen, wanted):
    differences = [
        np.subtract(a, b, dtype=float) for a, b in zip(seen, wanted, strict=True)
    ]
    return 20 * np.log10(255 / np.sqrt(np.mean(np.square(differences))))


@pytest.mark.clients
def test_every_case_has_a_row_whose_counts_and_times_add_up(real_service, tmp_path):
    plot = tmp_path / "latency.png"
    ways = ("--transport", "tcp", "--transport", "auto", "--stereo", "--plot", plot)
    finished = run_command(
        "latency", real_service.endpoint, *QUICK, *OPTIONS, *ways, "--json"
    )
    rows = rows_of(finished)
    assert finished.stderr == ""
    assert [row["views"] for row in rows] == [1, 2, 1, 2]
    assert [row["transport"] for row in rows[:2]] == ["tcp", "tcp"]
    assert all("shared memory" in row["transport"] for row in rows[2:])
    for row in rows:
        frames = row["frames"]
        n_dropped = sum(frames["dropped"].values())
        assert frames["filtered"] + n_dropped == frames["scheduled"] == N_SENT
        assert frames["filtered"] > 0
        trips, ages = row["round_trip_ms"], row["age_ms"]
        for times in (trips, ages, row["shown_age_ms"], row["profile_change_ms"]):
            values = [times[name] for name in PERCENTILES]
            assert values[0] > 0 and sorted(values) == values
        assert ages["max"] >= trips["p50"] >= row["stages_ms"]["service_total"]["p50"]
        assert row["stages_ms"]["splat"]["p50"] > 0
        assert row["error"]["psnr_db"] > 35
        assert 0 <= row["error"]["worst_difference"] < 128
    n_bytes = 7 * SIZE_PX[0] * SIZE_PX[1]  # 8-bit color, and depth
    assert rows[0]["frames"]["bytes_sent"] > n_bytes
    assert rows[1]["frames"]["bytes_sent"] > 2 * n_bytes
    assert plot.read_bytes().startswith(b"\x89PNG")


@pytest.mark.clients
def test_the_error_is_that_of_the_filter_against_exact_frames(real_service):
    profile = {"kind": "prescription", "sphere_dpt": -3}
    (row,) = rows_of(
        run_command(
            *("latency", real_service.endpoint, *OPTIONS, "--frames", 6, "--json"),
            *("--size", "160x90", "--profile", json.dumps(profile), "--still"),
        )
    )
    images = make_frames(
        StreamSettings(160, 90, 1, 1.0, 1.0, profile, {}, 4.0, 0.0, "srgb8", 1)
    )
    sent = [images[index % N_FRAMES] for index in row["error"]["frames"]]
    assert sent
    look = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
    exactly = {"render_tolerance": 0.0, "merge": False}
    with (
        EyeFilter(profile, settings=PLAIN) as usual,
        EyeFilter(profile, settings=PLAIN | {"tolerance": "fine"}) as exact,
    ):
        seen = [usual.filter(views, **look).color for views in sent]
        wanted = [exact.filter(views, **look, **exactly).color for views in sent]
    worst = max(
        np.abs(a.astype(int) - b).max() for a, b in zip(seen, wanted, strict=True)
    )
    assert worst > 0, "the exact frame differs"
    assert row["error"]["worst_difference"] == worst
    assert row["error"]["psnr_db"] == pytest.approx(psnr_db(seen, wanted), abs=2e-3)


@pytest.mark.clients
def test_the_text_has_a_table_for_each_case_and_tells_the_rules(real_service):
    with FilterClient(real_service.endpoint):
        finished = run_command(
            *("latency", real_service.endpoint, *QUICK, *OPTIONS, "--frames", 2),
            *("--rate", 30, "--transport", "tcp"),
        )
    assert finished.returncode == 0, finished.stderr
    said = finished.stdout
    assert "warm-up: 8 frames before the clock starts" in said
    assert "change in every frame" in said
    for case in ("tcp, 64x36, 20 Hz", "tcp, 64x36, 30 Hz"):
        assert f"\n{case}\n" in said
        assert f"\n  {case} " in said  # in the table of all cases
    for name in ("round trip", "profile change to first frame", "splat"):
        assert said.count(f" {name}") == 2
    assert said.count("other sessions of the service: 1;") == 2
    assert said.count("of 2 frames filtered") == said.count("dB PSNR") == 2


def test_without_a_service_one_line_says_how_to_start_one():
    endpoint = "tcp://127.0.0.1:1"
    finished = run_command("latency", endpoint, "--timeout", 0.1)
    assert f"ocufilter serve --bind {endpoint}" in one_line(finished, 1)


def test_a_service_without_a_free_session_is_told_in_one_line(small_service):
    endpoint = small_service.endpoint
    with FilterClient(endpoint), FilterClient(endpoint):
        finished = run_command("latency", endpoint)
        assert "sessions" in one_line(finished, 1)


def test_a_service_that_ends_during_a_stream_ends_the_measurement(start_service):
    service = start_service()

    def end_before_the_first_frame():
        service.stop()
        return 0.0

    settings = StreamSettings(
        *(*SIZE_PX, 1, 20.0, 60.0, {"kind": "double", "mark": 1}, {}),
        *(4.0, 0.0, "srgb8", 1),
    )
    with (
        FilterClient(service.endpoint) as client,
        pytest.raises(ConnectionLost, match="closed the connection"),
    ):
        measure_stream(client, settings, end_before_the_first_frame)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--size", "12"), "--size is '12'"),
        (("--rate", 0), "--rate-hz is 0"),
        (("--rate-hz", "nan"), "--rate-hz is nan"),
        (("--transport", "pigeon"), "--transport is 'pigeon'; allowed: auto, tcp"),
        (("--frames", 0), "--frames"),
        (("--profile", "nobody"), "--profile"),
        (("--plot", "latency.pdf"), "latency.pdf"),
        (("--plot", "nowhere/latency.png"), "its folder does not exist"),
        (tuple(101 * ["--rate", 30])[:202], "101 combinations"),
    ],
)
def test_wrong_options_are_refused_before_a_connection_is_made(options, named):
    assert named in one_line(run_command("latency", "tcp://127.0.0.1:1", *options), 2)


def test_a_size_beyond_the_limits_of_the_service_is_refused(shared_service):
    finished = run_command("latency", shared_service.endpoint, "--size", "99999x99999")
    assert "--size is 99999x99999; allowed by tcp://" in one_line(finished, 2)


def test_a_profile_that_the_service_refuses_is_told_in_one_line(real_service):
    body = json.dumps({"kind": "prescription", "sphere_dpt": "weak"})
    finished = run_command("latency", real_service.endpoint, "--profile", body)
    assert "sphere_dpt: 'weak' is not a number" in one_line(finished, 2)
