"""The helper of the OpenXR layer: results, bad input, and programs that come and go."""

import contextlib
import os
import socket
import tempfile
from pathlib import Path

import numpy as np
import pytest

from clients.commands.options import profile_title
from clients.headset.stereo_filter import LocalFilter
from clients.headset.stereo_gaze import StereoGaze
from clients.openxr_layer import program, wire
from clients.openxr_layer.helper import MAX_WAITING, LayerHelper, LayerOptions
from clients.openxr_layer.wire import ask
from filter_service import Camera, EyeFilter, FilterSettings, RgbdView
from filter_service.messages import body_of_eye
from tests.commands import run_command
from tests.end_to_end.layer_double import LayerDouble, RunningHelper

SIZE_PX = (96, 72)
NOBODY = 65534
PUPIL_MM, FOCUS_DPT = 4.0, 1.0
SETTINGS = FilterSettings(
    mode="on-axis",  # quick to prepare: these tests are about messages and memory
    eye_model="wavefront",
    pupil_range_mm=(PUPIL_MM, PUPIL_MM),
    focus_range_dpt=(FOCUS_DPT, FOCUS_DPT),
    object_range_dpt=(0.0, 4.0),
)
PROFILES = {
    "left": {"kind": "prescription", "sphere_dpt": -15.0},
    "right": {"kind": "prescription", "sphere_dpt": 0.0},
}


def running_helper(path, **options):
    return RunningHelper(path, real_eyes, **options)


def real_eyes(say):
    """Return both eyes' filter, and their gaze and focus, which are fixed."""
    seeing = LocalFilter(SETTINGS, say)
    for eye, profile in PROFILES.items():
        seeing.change(eye, profile)
    look = StereoGaze(age_years=30.0, pupil_diameter_mm=PUPIL_MM, focus_dpt=FOCUS_DPT)
    return seeing, look


@pytest.fixture
def path(tmp_path):
    return tmp_path / "layer.sock"


@pytest.fixture
def connect(path):
    """Return how to connect as a layer; connections are closed at the end."""
    with contextlib.ExitStack() as stack:

        def connected(name="program"):
            return stack.enter_context(contextlib.closing(LayerDouble(path, name)))

        yield connected


@pytest.fixture
def helper(path):
    with running_helper(path) as running:
        yield running


def stripes(seed, dtype=np.uint8):
    """Colors and alpha, and depth as OpenGL's buffer has it; the top row first."""
    random = np.random.default_rng(seed)
    width_px, height_px = SIZE_PX
    color = random.integers(0, 256, (height_px // 4, width_px // 4, 4))
    color = np.kron(color, np.ones((4, 4, 1))).astype(np.uint8)
    depth_m = np.full((height_px, width_px), 4.0, np.float32)
    depth_m[20:50, 20:60] = 0.5
    values = (1.0 / 0.1 - 1.0 / depth_m) / (1.0 / 0.1 - 1.0 / 100.0)
    if dtype == np.float16:
        color = (color / 128.0).astype(np.float16)
    return color, depth_m, values.astype(np.float32)


def truth(eye, color, depth_m, tangents, output):
    """Return what EyeFilter gives."""
    width_px, height_px = SIZE_PX
    camera = Camera(width_px, height_px, tangents)
    body = body_of_eye(PROFILES[eye], eye)  # a left eye is mirrored
    with EyeFilter(body, camera, SETTINGS) as eye_filter:
        view = RgbdView(np.ascontiguousarray(color[..., :3]), depth_m, tangents)
        seen = eye_filter.filter(
            view,
            pupil_diameter_mm=PUPIL_MM,
            focus_dpt=FOCUS_DPT,
            whole=True,
            output=output,
        )
        return seen.views[0].color


def upward(image):
    """Return an image with the bottom row first."""
    return np.ascontiguousarray(image[::-1])


def filtered(layer, make_frame):
    """Send frames until one is filtered; return it."""
    for _ in range(10_000):
        frame = make_frame()
        layer.send(frame)
        result = layer.result()
        assert result is not None
        assert result.frame_id == frame.frame_id
        if result.is_filtered:
            return frame
    raise AssertionError("no frame was filtered")


def tangents_of(frame, index):
    return frame.views[index].tangents


@pytest.mark.parametrize(
    ("color_format", "dtype", "output"),
    [
        pytest.param(
            *(wire.SRGB8, np.uint8, "srgb8"),
            marks=pytest.mark.long("two eyes are computed twice"),
        ),
        pytest.param(
            *(wire.LINEAR16F, np.float16, "linear16"), marks=pytest.mark.clients
        ),
    ],
)
def test_frames_are_those_of_the_eye_filter(
    helper, path, connect, color_format, dtype, output
):
    layer = connect()
    assert layer.welcome().max_age_ms == 150
    images = [stripes(seed, dtype) for seed in (1, 2)]
    colors = [upward(color) for color, _, _ in images]
    depths = [upward(values) for _, _, values in images]
    frame = filtered(
        layer, lambda: layer.frame(colors, depths, color_format=color_format)
    )
    for index, eye in enumerate(("left", "right")):
        color, depth_m, _ = images[index]
        expected = truth(eye, color, depth_m, tangents_of(frame, index), output)
        found = upward(layer.color(frame, index))
        # Depth goes through the buffer's float32.
        tolerance = 1.0 if dtype == np.uint8 else 2e-3
        error = np.abs(found[..., :3].astype(float) - expected.astype(float))
        assert error.max() <= tolerance
        assert (found[..., 3] == (255 if dtype == np.uint8 else 1.0)).all()
    difference = layer.color(frame, 0)[..., :3] - colors[0][..., :3].astype(float)
    assert np.abs(difference).mean() > 0.005 * (255 if dtype == np.uint8 else 1.0)
    layer.close()


@pytest.mark.clients
def test_linear_bytes(helper, path, connect):
    layer = connect()
    layer.welcome()
    color, depth_m, values = stripes(3)
    frame = filtered(
        layer,
        lambda: layer.frame(
            [upward(color)] * 2, [upward(values)] * 2, color_format=wire.LINEAR8
        ),
    )
    light = (color / 255.0).astype(np.float32)
    expected = truth("left", light, depth_m, tangents_of(frame, 0), "linear")
    found = upward(layer.color(frame, 0))[..., :3] / 255.0
    assert np.abs(found - expected).max() <= 1.0 / 255.0
    layer.close()


@pytest.mark.clients
def test_blended_layers_keep_their_alpha(helper, path, connect):
    layer = connect()
    layer.welcome()
    color, _, values = stripes(4)
    frame = filtered(
        layer,
        lambda: layer.frame(
            [upward(color)] * 2, [upward(values)] * 2, flags=wire.IS_BLENDED
        ),
    )
    np.testing.assert_array_equal(upward(layer.color(frame, 1))[..., 3], color[..., 3])
    layer.close()


@pytest.mark.clients
def test_views_that_are_upside_down(helper, path, connect):
    layer = connect()
    layer.welcome()
    color, depth_m, values = stripes(5)

    def upside_down():
        frame = layer.frame([color.copy()] * 2, [values.copy()] * 2)
        for view in frame.views:
            left, right, up, down = view.fov_rad
            view.fov_rad[:] = left, right, down, up
        return frame

    frame = filtered(layer, upside_down)
    left, right, down, up = tangents_of(frame, 0)
    expected = truth("left", color, depth_m, (left, right, up, down), "srgb8")
    found = layer.color(frame, 0)[..., :3]
    assert np.abs(found.astype(float) - expected).max() <= 1.0
    layer.close()


@pytest.mark.clients
def test_without_depth_everything_is_at_the_flat_distance(path, connect):
    with running_helper(path, flat_dpt=2.0, split=True) as helper:
        layer = connect()
        layer.welcome()
        color, depth_m, _ = stripes(6)
        frame = filtered(layer, lambda: layer.frame([upward(color)] * 2))
        flat_m = np.full_like(depth_m, 0.5)
        expected = truth("left", color, flat_m, tangents_of(frame, 0), "srgb8")
        found = upward(layer.color(frame, 0))[..., :3].astype(float)
        middle = SIZE_PX[0] // 2
        assert np.abs(found[:, middle:] - expected[:, middle:]).max() <= 1.0
        np.testing.assert_array_equal(found[:, :middle], color[:, :middle, :3])
        assert sum("everything is 0.5 m away" in line for line in helper.lines) == 1
        layer.close()


def test_a_second_program_waits_for_the_first_one_to_end(helper, path, connect):
    first, second = LayerDouble(path, "first"), None
    assert first.welcome() is not None
    second = LayerDouble(path, "second")
    assert second.welcome() is None
    second.close()
    first.close()
    third = LayerDouble(path, "third")
    assert third.welcome() is not None
    third.close()


def spoiled(change):
    def make(layer):
        color, _, values = stripes(7)
        frame = layer.frame([upward(color)] * 2, [upward(values)] * 2)
        change(frame)
        return bytes(frame)

    return make


def set_pose(frame):
    frame.views[0].position_m[0] = np.nan


def set_start(frame):
    frame.views[1].depth.start = 2**63


def set_size(frame):
    frame.views[0].color.width_px = 16384


def set_fov(frame):
    frame.views[0].fov_rad[1] = 1.6


def set_quad(frame):
    quad = frame.quads[0]
    quad.color, quad.color_format = wire.Image(0, 8, 8), wire.SRGB8
    quad.orientation[3] = quad.size_m[0] = 1.0  # and no height


BAD = {
    "nothing known": lambda layer: b"\x09\0\0\0",
    "too short": lambda layer: bytes(wire.Frame(wire.FRAME))[:-1],
    "too long": lambda layer: bytes(wire.Frame(wire.FRAME)) + b"\0",
    "no memory": lambda layer: bytes(wire.Frame(wire.FRAME, 0, 1)),
    "hello again": lambda layer: bytes(wire.Hello(wire.HELLO, wire.MAGIC)),
    "memory without a descriptor": lambda layer: bytes(
        wire.Memory(wire.MEMORY, 0, 4096)
    ),
    "format": spoiled(lambda frame: setattr(frame, "color_format", 9)),
    "pose": spoiled(set_pose),
    "start": spoiled(set_start),
    "size": spoiled(set_size),
    "field of view": spoiled(set_fov),
    "quad": spoiled(set_quad),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_messages_end_the_connection_and_nothing_else(helper, path, connect, name):
    layer = connect()
    layer.welcome()
    layer.connection.send(BAD[name](layer))
    assert layer.result() is None
    layer.close()
    assert any("disconnected, because it sent" in line for line in helper.lines)
    other = LayerDouble(path)
    assert other.welcome() is not None
    other.close()


@pytest.mark.parametrize(
    "options",
    [{"seals": 0}, {"says_bytes": 8192}, {"says_bytes": 2**40}],
    ids=["not sealed", "smaller", "huge"],
)
def test_bad_memory_ends_the_connection(helper, path, connect, options):
    layer = connect()
    layer.welcome()
    layer.share(4096, **options)
    assert layer.result() is None
    layer.close()
    assert shared_descriptors() == []


def shared_descriptors():
    """Return the open descriptors of a layer's memory."""
    found = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found += [
                name for name in [os.readlink(descriptor)] if "memfd:layer" in name
            ]
    return [name for name in found if "memfd:layer" in name]


def test_profiles_are_changed_and_errors_told(helper, path, connect):
    found = ask(path, {"left": "myopia"})
    assert found["program"] is None
    assert helper.changed == [("left", "myopia")]
    with pytest.raises(ValueError, match="no eye 'nobody'"):
        ask(path, {"right": "nobody"})
    with pytest.raises(ValueError, match="allowed: 100000"):
        ask(path, {"right": "x" * 200_000})


@pytest.mark.parametrize(
    "text", [b"[" * 90_000, b"5", b'"left"', b'["left"]', b'{"left": 1e999}', b"\xff"]
)
def test_requests_that_are_none_are_refused(helper, path, text):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(20.0)
        connection.connect(str(path))
        connection.send(wire.CONTROL.to_bytes(4, "little") + text)
        assert b"error" in connection.recv(10_000)
    assert ask(path, {})["program"] is None
    assert helper.changed == []


def test_names_are_printed_without_control_characters(helper, path, connect):
    connect("\x1b[2J").welcome()
    assert helper.lines == ["\\x1b[2J: connected"]


def test_a_profile_s_name_cannot_forge_lines(capsys):
    profile = {"name": "eye\nlayer: forged\x1b[2J\u202e" + "x" * 9000}
    program.say(f"left eye: {profile_title(profile)}")
    program.say("a\rb")
    (first, second) = capsys.readouterr().err.splitlines()
    assert first.startswith("layer: left eye: eye\\nlayer: forged\\x1b[2J\\u202exxx")
    assert len(first) < 200
    assert second == "layer: a\\rb"


def test_notes_on_depth_are_not_repeated_for_other_numbers(helper, path, connect):
    layer = connect()
    layer.welcome()
    color, _, values = stripes(8)
    for near_m in (-1.0, -2.0, -3.0):
        frame = layer.frame([upward(color)] * 2, [upward(values)] * 2)
        frame.views[0].near_m = near_m
        layer.send(frame)
        layer.result()
    assert sum("planes are at" in line for line in helper.lines) == 1


def test_one_helper_per_socket(helper, path, connect):
    with pytest.raises(OSError, match="another helper listens"):
        LayerHelper(None, None, print, LayerOptions(), print, path)
    assert ask(path, {})["filtered"] == 0


def test_a_socket_that_was_left_behind_is_replaced(path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:
        left.bind(str(path))
    with running_helper(path):
        assert ask(path, {})["program"] is None
    assert not path.exists()


def test_silent_connections_are_bounded_and_keep_nobody_out(helper, path, connect):
    with contextlib.ExitStack() as stack:
        silent = []
        for _ in range(MAX_WAITING + 4):
            made = stack.enter_context(
                socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            )
            made.settimeout(20.0)
            made.connect(str(path))
            silent.append(made)
        assert silent[0].recv(10) == b"", "the oldest one is still open"
        assert ask(path, {"left": "myopia"})["program"] is None
        assert helper.changed == [("left", "myopia")]
        assert connect().welcome().max_age_ms == 150


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")
def test_a_profile_is_not_sent_to_another_user_s_process():
    """A socket in a folder that everybody may write to."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o777)
        path = Path(folder) / "layer.sock"
        told, tell = os.pipe()
        child = os.fork()
        if child == 0:  # few calls, as other threads of the test may hold locks
            code = 1
            try:
                os.setuid(NOBODY)
                made = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                made.settimeout(20.0)
                made.bind(str(path))
                made.listen()
                os.write(tell, b".")
                connection, _ = made.accept()
                code = 0 if connection.recv(100_000) == b"" else 2
            finally:
                os._exit(code)
        os.close(tell)
        is_listening = os.read(told, 1) == b"."
        os.close(told)
        try:
            assert is_listening
            with pytest.raises(PermissionError, match="another user's process"):
                ask(path, {"left": "myopia"})
        finally:
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status == 0, "it received the profile"


# The command


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["run", "--flat-dpt", "-1", "--", "x"],
            "--flat-dpt is -1; allowed: 0 to 20 dpt",
        ),
        (["serve", "--wait-ms", "-5"], "--wait-ms is -5; allowed: 0 to 600000 ms"),
        (["serve", "--max-age-ms", "0"], "--max-age-ms is 0; allowed: 1 to 600000 ms"),
        (["serve", "--focus-dpt", "99"], "focus_dpt is 99.0; allowed: 0 to 20"),
        (["serve", "--left", "{}x"], "--left {}x: profile: not JSON"),
        (["run"], "there is no program; put it after --"),
        (["set"], "there is no profile; use --profile, --left or --right"),
        (["set", "--left", "miopia"], "'miopia' is not known (did you mean 'myopia'?)"),
        (["set", "--left", '{"kind": "preset", "name": "x"}'], "--left: profile field"),
        (
            ["serve", "--left", "nobody"],
            "--left nobody: profile: 'nobody' is not known",
        ),
    ],
)
def test_options_are_checked(arguments, message, tmp_path):
    socket_option = ["--socket", str(tmp_path / "s")]
    at = arguments.index("--") if "--" in arguments else len(arguments)
    words = ("layer", *arguments[:at], *socket_option, *arguments[at:])
    ended = run_command(*words)
    assert ended.returncode == 2
    assert message in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_status_and_install_without_the_library(monkeypatch, tmp_path):
    monkeypatch.setenv("OCUFILTER_LAYER_LIBRARY", str(tmp_path / "none.so"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    ended = run_command("layer", "status", "--socket", tmp_path / "s")
    assert ended.returncode == 1
    assert "the layer was not built" in ended.stdout
    ended = run_command("layer", "install")
    assert ended.returncode == 1
    assert "libopenxr-dev" in ended.stderr
    assert run_command("layer", "remove").returncode == 0
