"""Textures that a client shares with the service: as exact as arrays, and bounded."""

import logging
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from clients.filter_client import FilterClient, RgbdView, ViewState
from clients.service_process import CHECKOUT, ServiceProcess
from filter_service.errors import BadMessage, RenderFailed
from filter_service.messages import (
    Camera,
    Hello,
    ShareTexture,
    UnshareTexture,
    ViewTextures,
    encode,
    tangents_from_fov,
)
from filter_service.rendering.frame import white_level
from filter_service.rendering.media_effects import linear_from_srgb
from tests.end_to_end.conftest import make_view
from tests.end_to_end.exported_textures import (
    export,
    exporting_context,
    size_of,
)
from tests.end_to_end.test_lifecycle import wait_until
from tests.numerical.synthetic import assert_same_frame, is_same_frame

pytestmark = pytest.mark.gl

WIDTH, HEIGHT = SIZE_PX = 150, 101
CAMERA = Camera(WIDTH, HEIGHT, tangents_from_fov(20.0, WIDTH, HEIGHT))
SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 6.5, "bright_pixels": False}
"""Frames in arrays otherwise contain the light beyond kernels."""
MAX_IMAGE_MB = 8
LOST = "the render worker exited"
LONG = pytest.mark.long("a service builds an eye, and frames by a software renderer")
MAX_BOUND = 3
"""Textures of a frame.  Mesa 25 frees them when another frame binds others."""


def scene(seed=0):
    """Color of small squares, and depth at three distances."""
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (HEIGHT // 5 + 1, WIDTH // 5 + 1, 3), np.uint8)
    color = np.kron(color, np.ones((5, 5, 1), np.uint8))[:HEIGHT, :WIDTH]
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[:, : WIDTH // 3], depth_m[HEIGHT // 2 :] = 0.5, 4.0
    return color, depth_m


def with_alpha(color):
    alpha = np.full(color.shape[:2], 255 if color.dtype == np.uint8 else 1, color.dtype)
    return np.dstack([color, alpha])


@pytest.fixture(scope="module")
def service():
    settings = {"engine": "gl", "max_image_mb": MAX_IMAGE_MB, "max_sessions": 8}
    with ServiceProcess(settings, start_timeout_s=60.0) as service:
        yield service
        assert service.stop(10.0) == 0


def connect(service):
    return FilterClient(service.endpoint, timeout_s=30.0)


@pytest.fixture
def client(service):
    with connect(service) as client:
        client.set_profile("myopia", views=[CAMERA])
        yield client


@pytest.fixture(scope="module")
def gl():
    try:
        with exporting_context() as exporting:
            exporting.new("rgba8", (8, 8))
            yield exporting
    except (BadMessage, RenderFailed) as error:  # a GPU, or another build of Mesa
        pytest.skip(f"memory like that of lavapipe cannot be imported: {error}")


def shared_frame(gl, client, seed=0, **values):
    """Share the textures of a scene; return them, and the frame's textures."""
    color, depth_m = scene(seed)
    exported = [
        gl.new("rgba8", SIZE_PX, with_alpha(color)),
        gl.new("r32f", SIZE_PX, depth_m),
        gl.new("rgba8", SIZE_PX),
    ]
    numbers = [texture.share(client) for texture in exported]
    assert None not in numbers
    return exported, ViewTextures(*numbers, is_top_first=True, **values)


def of_arrays(client, seed=0, **values):
    color, depth_m = scene(seed)
    return client.filter(RgbdView(color, depth_m, CAMERA.tangents), **SEE, **values)


def is_usable(gl, client):
    """Whether frames in textures still have the pixels of arrays."""
    exported, used = shared_frame(gl, client, seed=7)
    client.filter([(CAMERA, used)], **SEE)
    for number in used.numbers:
        client.unshare_texture(number)
    found = gl.read(exported[2])[..., :3]
    return is_same_frame(found, of_arrays(client, seed=7).color)


def leaks(service):
    """Descriptors of front end and worker, and imported memory that is mapped."""
    pids = service.pids()
    maps = Path(f"/proc/{pids['render']}/maps").read_text()
    return (
        *(len(os.listdir(f"/proc/{pids[n]}/fd")) for n in ("front-end", "render")),
        maps.count("memfd:exported"),
    )


def has_no_more(service, before):
    """Whether nothing was added; the service frees unused slots after a while."""
    now = leaks(service)
    return now[0] <= before[0] and now[1] <= before[1] and has_few_maps(service, before)


def has_few_maps(service, before=(0, 0, 0)):
    """Whether at most the memory of textures that Mesa may still bind was added."""
    return leaks(service)[2] <= max(before[2], MAX_BOUND)


# ----- images


@pytest.mark.parametrize("is_top_first", [pytest.param(True, marks=LONG), False])
@pytest.mark.parametrize(
    "kind", [pytest.param("rgba8", marks=pytest.mark.brief), "srgb8_a8", "rgba16f"]
)
def test_images_and_counts_are_those_of_arrays(client, gl, kind, is_top_first):
    color, depth_m = scene()
    output, flip = "srgb8", slice(None, None, 1 if is_top_first else -1)
    if kind == "rgba16f":
        color, output = linear_from_srgb(color).astype(np.float16), "linear16"
    view = RgbdView(color, depth_m, CAMERA.tangents)
    expected = client.filter(view, **SEE, output=output)
    exported = [
        gl.new(kind, SIZE_PX, with_alpha(color)[flip]),
        gl.new("r32f", SIZE_PX, depth_m[flip]),
        gl.new(kind, SIZE_PX),
    ]
    numbers = [texture.share(client) for texture in exported]
    used = ViewTextures(
        *numbers,
        is_top_first=is_top_first,
        white_ratio=white_level(color),  # of arrays, the service finds it
    )
    found = client.filter([(CAMERA, used)], **SEE)
    image = gl.read(exported[2])[flip][..., :3]
    assert_same_frame(image, expected.color)
    ours, theirs = found, expected
    assert (found.colors, ours.in_memory) == ((), True)
    assert ours.views[0].color == theirs.views[0].color
    for name in ("notes", "focus_dpt", "clamped_depth_count", "overflow_count"):
        assert getattr(ours, name) == getattr(theirs, name)
    assert sum(ours.stage_times_ms.values()) == pytest.approx(ours.total_ms, abs=0.01)


@pytest.mark.parametrize("kind", ["d32f", "d24"])
def test_a_depth_buffer_means_the_distances_of_its_projection(client, gl, kind):
    color, depth_m = scene()
    near_m = 0.1
    buffer = (near_m / depth_m).astype(float)
    if kind == "d24":
        buffer = np.round(buffer * (2**32 - 1)).astype(np.uint32)
    exported = [
        gl.new("srgb8_a8", SIZE_PX, with_alpha(color)),
        gl.new(kind, SIZE_PX, buffer),
        gl.new("rgba8", SIZE_PX),
    ]
    numbers = [texture.share(client) for texture in exported]
    used = ViewTextures(*numbers, near_m=near_m, is_reversed=True, is_top_first=True)
    client.filter([(CAMERA, used)], **SEE)
    off = gl.read(exported[2])[..., :3].astype(int) - of_arrays(client).color
    assert np.abs(off).max() <= 1


def test_missing_depth_is_counted_and_noted(client, gl):
    exported, used = shared_frame(gl, client)
    gl.write(exported[1], np.zeros((HEIGHT, WIDTH), np.float32))
    found = client.filter([(CAMERA, used)], **SEE)
    assert found.missing_depth_count == WIDTH * HEIGHT
    assert "no pixel has depth; infinity is assumed" in found.notes


def test_each_view_has_its_eye(client, gl):
    client.set_profile("emmetropia", eye="left", views=[CAMERA])
    left, left_used = shared_frame(gl, client, seed=1)
    right, right_used = shared_frame(gl, client, seed=2)
    states = [ViewState("left", focus_dpt=0.5), ViewState()]
    found = client.filter(
        [(CAMERA, left_used), (CAMERA, right_used)], states=states, **SEE
    )
    assert [view.eye for view in found.views] == ["left", "both"]
    views = [RgbdView(*scene(seed), CAMERA.tangents) for seed in (1, 2)]
    expected = client.filter(views, states=states, **SEE)
    for exported, color in zip((left, right), expected.colors, strict=True):
        assert_same_frame(gl.read(exported[2])[..., :3], color)


def test_two_clients_have_only_their_own_textures(service, client, gl):
    exported, used = shared_frame(gl, client, seed=1)
    with connect(service) as other:
        other.set_profile("myopia", views=[CAMERA])
        with pytest.raises(BadMessage, match="a texture of this session"):
            other.filter([(CAMERA, used)], **SEE)
        others, others_used = shared_frame(gl, other, seed=2)
        assert others_used.numbers == used.numbers, "each client counts its own"
        for one, own in ((client, used), (other, others_used)):
            one.submit([(CAMERA, own)], **SEE)
        for one in (client, other):
            wait_until(lambda one=one: one.poll(0.1))
        for one, textures, seed in ((client, exported, 1), (other, others, 2)):
            found = gl.read(textures[2])[..., :3]
            assert_same_frame(found, of_arrays(one, seed).color)


# ----- textures and sessions that end


def test_a_killed_client_leaves_nothing(service, client, gl):
    assert is_usable(gl, client)
    time.sleep(0.1)
    before = leaks(service)
    for _ in range(2):
        command = [sys.executable, "-m", "tests.end_to_end.killed_texture_client"]
        worker = service.pids()["render"]
        with subprocess.Popen(
            [*command, service.endpoint],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=CHECKOUT,
        ) as process:
            assert process.stdout.readline() == "shared\n"
            assert 3 <= leaks(service)[2] <= 3 + MAX_BOUND
            os.kill(worker, signal.SIGSTOP)  # the frame is in flight when it continues
            try:
                process.stdin.write("\n")
                process.stdin.flush()
                assert process.stdout.readline() == "sent\n"
                time.sleep(0.1)
                process.kill()
                process.wait()
            finally:
                os.kill(worker, signal.SIGCONT)
        wait_until(lambda: has_no_more(service, before))
    assert service.pids()["render"] == worker
    assert is_usable(gl, client)


def test_textures_outlive_the_descriptor_and_end_when_taken_back(service, client, gl):
    before = leaks(service)
    for _ in range(MAX_BOUND + 1):  # one texture left behind by each would be too many
        descriptor = export(size_of("rgba8", SIZE_PX))
        number = client.share_texture(
            descriptor,
            width_px=WIDTH,
            height_px=HEIGHT,
            format="rgba8",
            size_bytes=size_of("rgba8", SIZE_PX),
        )
        os.close(descriptor)
        _, used = shared_frame(gl, client)
        used = ViewTextures(used.color, used.depth, number)
        client.filter([(CAMERA, used)], **SEE)
        for texture in range(number, number + 4):
            client.unshare_texture(texture)
        with pytest.raises(BadMessage, match="a texture of this session"):
            client.filter([(CAMERA, used)], **SEE)
    wait_until(lambda: has_no_more(service, before))


@pytest.mark.parametrize("name", ["render", "front-end"])
def test_textures_are_shared_again_after_a_process_was_killed(
    service, client, gl, name
):
    _, used = shared_frame(gl, client)
    pid = service.pids()[name]
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: service.pids().get(name, pid) != pid)
    of_arrays(client)  # waits for the new process
    if name == "render":
        assert client._link.textures.reply_about(used.color).reason == LOST
    with pytest.raises(BadMessage, match="a texture of this session"):
        client.filter([(CAMERA, used)], **SEE)
    assert is_usable(gl, client)
    assert has_few_maps(service)


# ----- what is refused

SIZE_BYTES = size_of("rgba8", SIZE_PX)
TEXTURE = {"width_px": WIDTH, "height_px": HEIGHT, "format": "rgba8"}


def opened(path):
    return os.open(path, os.O_RDWR)


@pytest.mark.parametrize(
    ("make", "size_bytes", "reason"),
    [
        (lambda: os.pipe()[0], SIZE_BYTES, "cannot be read"),
        (lambda: opened("/dev/null"), SIZE_BYTES, "cannot be read"),
        (lambda: export(SIZE_BYTES, seals=0), SIZE_BYTES, "not sealed"),
        (lambda: export(SIZE_BYTES, driver=bytes(16)), SIZE_BYTES, "cannot use it as"),
        (lambda: export(SIZE_BYTES, start=2**40), SIZE_BYTES, "header is wrong"),
        (lambda: export(SIZE_BYTES, stated=2**40), SIZE_BYTES, "header is wrong"),
        (lambda: export(SIZE_BYTES - 64), SIZE_BYTES, "size_bytes is"),
        (lambda: export(SIZE_BYTES + 2**20), SIZE_BYTES, "size_bytes is"),
        (lambda: export(4 * WIDTH * HEIGHT), 4 * WIDTH * HEIGHT, "cannot use it as"),
    ],
)
def test_wrong_memory_is_refused(service, client, gl, caplog, make, size_bytes, reason):
    before = leaks(service)
    descriptor = make()
    with caplog.at_level(logging.WARNING, "ocufilter"):
        found = client.share_texture(descriptor, size_bytes=size_bytes, **TEXTURE)
    os.close(descriptor)
    assert found is None
    (line,) = [entry.getMessage() for entry in caplog.records]
    assert line.startswith("cannot share textures; sending images instead")
    assert reason in line
    assert is_usable(gl, client)
    wait_until(lambda: has_few_maps(service, before))


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"width_px": 0}, "width_px"),
        ({"width_px": 5000}, "width_px"),
        ({"height_px": 2**40}, "height_px"),
        ({"format": "rgb10"}, "format"),
        ({"size_bytes": 100}, "size_bytes"),
    ],
)
def test_wrong_sizes_and_formats_are_refused(client, gl, changes, field):
    """Both by the client library, and by the service if a client sends them."""
    exported = gl.new("rgba8", SIZE_PX)
    with pytest.raises(BadMessage) as raised:
        exported.share(client, **changes)
    assert raised.value.field == field
    values = {"size_bytes": SIZE_BYTES, **TEXTURE, **changes}
    request = ShareTexture(client.welcome.session_key, 99, **values)
    assert client._link.textures.send(request, exported.descriptor) == ""
    wait_until(lambda: client._link.pump(0.1) or client._link.has_events)
    (error,) = client.poll()
    assert (error.code, error.field) == ("bad_message", field)


def test_frames_that_do_not_fit_their_textures_are_refused(client, gl):
    _, used = shared_frame(gl, client)
    small = gl.new("rgba8", (64, 64)).share(client)
    cases = {
        "textures.color": [ViewTextures(small, used.depth, used.result)],
        "textures.depth": [ViewTextures(used.color, used.color, used.result)],
        "textures.result": [ViewTextures(used.color, used.depth, 1234)],
        "textures": [ViewTextures(used.color, used.depth, used.color)],
        "projection": [ViewTextures(*used.numbers, near_m=0.1)],
    }
    for field, textures in cases.items():
        with pytest.raises(BadMessage) as raised:
            client.filter([(CAMERA, textures[0])], **SEE)
        assert raised.value.field == field
    assert is_usable(gl, client)


def test_effects_that_need_arrays_are_refused(client, gl):
    client.set_profile("cataract", views=[CAMERA])
    _, used = shared_frame(gl, client)
    with pytest.raises(BadMessage, match="straylight") as raised:
        client.filter([(CAMERA, used)], **SEE)
    assert raised.value.field == "profile"


def test_textures_are_bounded(service, client, gl, caplog):
    small = [gl.new("rgba8", (8, 8)) for _ in range(17)]
    shared = [texture.share(client) for texture in small]
    assert [number is not None for number in shared] == [True] * 16 + [False]
    assert "16 textures are shared" in caplog.text
    with connect(service) as other:  # a quarter of the memory
        large = gl.new("rgba8", (800, 800))
        assert large.share(other) is None
        assert "allowed: 2000000 in total" in caplog.text


def test_a_device_that_the_service_does_not_use_is_not_tried(client, gl, caplog):
    exported = gl.new("rgba8", (8, 8))
    assert exported.share(client, device_uuid="ab" * 16) is None
    assert "memory of device abab" in caplog.text
    assert exported.share(client, device_uuid=gl.device_uuid) is not None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_another_user_is_ignored(service, client, gl):
    values = {"size_bytes": SIZE_BYTES, **TEXTURE}
    request = ShareTexture(client.welcome.session_key, 60, **values)
    exported = gl.new("rgba8", SIZE_PX)
    child = os.fork()
    if not child:
        os.setuid(65534)
        os._exit(bool(client._link.textures.send(request, exported.descriptor)))
    assert os.waitpid(child, 0)[1] == 0
    client.ping()
    assert client._link.textures.reply_about(60) is None
    assert client._link.textures.send(request, exported.descriptor) == ""
    wait_until(lambda: client._link.pump(0.1) or client._link.textures.reply_about(60))
    assert client._link.textures.reply_about(60).reason == ""


def test_datagrams_of_strangers_are_ignored(service, client, gl):
    before = leaks(service)
    address = f"\0{client.welcome.textures.socket}"
    values = {"size_bytes": SIZE_BYTES, **TEXTURE}
    good = ShareTexture(client.welcome.session_key, 50, **values)
    descriptor = export(SIZE_BYTES)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.connect(address)
        for data in (
            *(b"", b"\xff" * 100, bytes(5000)),
            encode(ShareTexture("0" * 32, 50, **values))[0],
            encode(Hello("stranger", client.welcome.session_key))[0],
        ):
            socket.send_fds(stranger, [data], [descriptor])
        stranger.send(encode(good)[0])
        textures = client._link.textures
        wait_until(lambda: client._link.pump(0.1) or textures.reply_about(50))
        assert textures.reply_about(50).reason.startswith("0 descriptors")
        socket.send_fds(stranger, encode(good), [descriptor] * 3)
    os.close(descriptor)
    client.ping()
    assert has_no_more(service, before)
    assert is_usable(gl, client)


def test_without_a_descriptor_the_message_is_refused(service, raw_client):
    raw = raw_client(service)
    key = raw.ask(Hello("raw")).session_key
    answer = raw.ask(ShareTexture(key, 1, size_bytes=SIZE_BYTES, **TEXTURE))
    assert (answer.code, answer.field) == ("bad_message", "type")
    answer = raw.ask(UnshareTexture(1))
    assert (answer.code, answer.field) == ("bad_message", "texture")


def test_an_engine_without_textures_offers_none(shared_service, caplog):
    with FilterClient(shared_service.endpoint, timeout_s=10.0) as client:
        assert client.welcome.textures is None
        descriptor = export(SIZE_BYTES)
        for _ in range(2):
            shared = client.share_texture(descriptor, size_bytes=SIZE_BYTES, **TEXTURE)
            assert shared is None
        os.close(descriptor)
        (line,) = [entry.getMessage() for entry in caplog.records]
        assert "does not offer them" in line
        view = make_view()
        client.set_profile({"kind": "double", "mark": 5}, views=[view])
        assert client.filter(view, **SEE).colors
