"""The C++ client against the service, with the renderer double and without."""

import itertools
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq

from clients.filter_client import FilterClient, RgbdView, ViewState
from clients.service_process import CHECKOUT
from filter_service import messages
from filter_service.keys import KeyRing
from filter_service.messages import encode, tangents_from_fov
from filter_service.wire.replies import Result, ResultView
from tests.end_to_end.conftest import QUICK_DOUBLE, TIMEOUT_S
from tests.end_to_end.test_lifecycle import wait_until
from tests.mutated_messages import mutated
from tests.page_commands import WAYS_PAGE
from tests.unit.message_parts import REPLIES, as_bytes

FOLDER = CHECKOUT / "clients" / "cpp"
PROGRAM = Path(__file__).with_name("cpp_client.cpp")
COMPILE = ("g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{FOLDER}")
CHECKED = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
COMPILE_LIMIT_S = 300
WIDTH_PX, HEIGHT_PX = 48, 27
FOV_DEG = 60.0
DOUBLE = '{"kind": "double", "mark": %d}'


def missing_packages():
    """Return what the C++ client lacks on this machine, in words."""
    if shutil.which("g++") is None:
        return "g++ is not installed"
    source = "#include <msgpack.hpp>\n#include <zmq.hpp>\n"
    found = subprocess.run(
        ["g++", "-E", "-x", "c++", "-"], input=source, text=True, capture_output=True
    )
    return (
        ""
        if found.returncode == 0
        else "the headers of cppzmq or msgpack-cxx are missing"
    )


@pytest.fixture(scope="session")
def compile_program(tmp_path_factory):
    """Compile a program with the client; skip the test if that is not possible."""
    missing = missing_packages()
    if missing:
        pytest.skip(f"{missing}: `make test-clients` installs them where it may")

    def compile_program(source, *flags):
        program = tmp_path_factory.mktemp("cpp") / "program"
        words = [*COMPILE, *flags, source, "-o", program, "-lzmq"]
        finished = subprocess.run(
            words, capture_output=True, text=True, timeout=COMPILE_LIMIT_S
        )
        assert finished.returncode == 0, finished.stderr
        return program

    return compile_program


@pytest.fixture(scope="module")
def program(compile_program):
    return compile_program(PROGRAM, *CHECKED)


class CppClient:
    """A client in a process of its own, which reads commands."""

    def __init__(
        self, program, endpoint, *, timeout_s=TIMEOUT_S, max_in_flight=1, key_file=None
    ):
        words = [program, endpoint, timeout_s, max_in_flight]
        words += [key_file] if key_file else []
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen(list(map(str, words)), text=True, **pipes)

    def ask(self, *words):
        """Return the reply to a command."""
        self.process.stdin.write(" ".join(map(str, words)) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        assert line, self.process.stderr.read()
        return json.loads(line)

    def expect_error(self, *words):
        found = self.ask(*words)
        assert isinstance(found, dict), found
        return found

    def set_view(self, file, *, dtype="uint8", encoding="float32", eye="both", pupil=0):
        self.ask("view", WIDTH_PX, HEIGHT_PX, dtype, encoding, file, 0, eye, pupil)

    def events(self, n_expected, *kinds):
        """Poll until there are so many events of the given kinds."""
        found = []

        def are_all_there():
            found.extend(e for e in self.ask("poll", 0.2) if e[0] in kinds)
            return len(found) >= n_expected

        wait_until(are_all_there)
        return found

    def close(self):
        """End it; the sanitizers report on stderr."""
        try:
            _, said = self.process.communicate(timeout=TIMEOUT_S)
        finally:
            self.process.kill()
        assert self.process.returncode == 0, said
        assert not said


@pytest.fixture
def start_client(
    program, use_service
):  # whose services are reset after the clients end
    clients = []

    def start(endpoint, **options):
        clients.append(CppClient(program, endpoint, **options))
        return clients[-1]

    yield start
    for client in clients:
        client.close()


@pytest.fixture
def frame_file(tmp_path):
    """A file of one view's images: 8-bit gray, 2 m away."""
    color = np.full((HEIGHT_PX, WIDTH_PX, 3), 10, np.uint8)
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), 2.0, np.float32)
    path = tmp_path / "frame.raw"
    path.write_bytes(color.tobytes() + depth_m.tobytes())
    return path


def image_of(client, tmp_path):
    """Filter a frame through the double: return its mark and another value."""
    out = tmp_path / "image.raw"
    reply = client.ask("filter", out)
    assert isinstance(reply, list), reply
    image = np.fromfile(out, np.uint8)
    return int(image[0]), int(image[-1])


def begin(client, frame_file, mark=5):
    """Set a profile, and make a frame."""
    client.ask("profile", "both", WIDTH_PX, HEIGHT_PX, DOUBLE % mark)
    client.ask("clear", 4, 0.5, "uint8")
    client.set_view(frame_file)


# The same images as with the Python client

DTYPES = {"uint8": np.uint8, "float16": np.float16, "float32": np.float32}
OUTPUTS = {"srgb8": "uint8", "linear16": "float16", "linear": "float32"}
ENCODED = {
    "float32": lambda m: m,
    "float16": lambda m: m.astype(np.float16),
    "dpt16": lambda m: (1 / m).astype(np.float16),
    "mm16": lambda m: (1000 * m).astype(np.uint16),
}


def scene(dtype, seed=0):
    """Noise in front of other noise."""
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3)).astype(np.uint8)
    if dtype != "uint8":
        color = (color / 255).astype(DTYPES[dtype])
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), 4.0, np.float32)
    depth_m[:, : WIDTH_PX // 2] = 0.5
    return color, depth_m


def real_profile(sphere_dpt):
    return {"kind": "prescription", "sphere_dpt": sphere_dpt}


@pytest.mark.clients
@pytest.mark.parametrize(
    ("dtype", "encoding", "output", "has_hidden", "eyes"),
    [
        ("uint8", "float32", "srgb8", False, ("both",)),
        ("float32", "float16", "linear", False, ("both",)),
        ("float16", "dpt16", "linear16", False, ("both",)),
        ("uint8", "mm16", "srgb8", True, ("both",)),
        ("uint8", "float32", "linear", False, ("left", "right")),
    ],
)
def test_images_are_those_of_the_python_client(
    start_client, real_service, tmp_path, dtype, encoding, output, has_hidden, eyes
):
    client = start_client(real_service.endpoint)
    client.ask("clear", 5, 0.25, OUTPUTS[output])
    views, states = [], []
    for i, eye in enumerate(eyes):
        body = json.dumps(real_profile(-1 - i))
        size_px = (WIDTH_PX, HEIGHT_PX)
        assert client.ask("profile", eye, *size_px, body) == 1
        color, depth_m = scene(dtype, i)
        layers = [color, ENCODED[encoding](depth_m)]
        hidden = scene(dtype, 9) if has_hidden else (None, None)
        if has_hidden:
            layers += [hidden[0], ENCODED[encoding](hidden[1])]
        path = tmp_path / f"{eye}.raw"
        path.write_bytes(b"".join(layer.tobytes() for layer in layers))
        words = (*size_px, dtype, encoding, path, int(has_hidden), eye, 3 + i)
        client.ask("view", *words)
        tangents = tangents_from_fov(FOV_DEG, *size_px)
        views.append(RgbdView(color, depth_m, tangents, "planar", *hidden))
        states.append(ViewState(eye=eye, pupil_diameter_mm=3.0 + i))
    kind, *_, eye = client.ask("filter", tmp_path / "out.raw")
    assert (kind, eye) == ("result", eyes[0])
    with FilterClient(real_service.endpoint, shared_memory=False) as python:
        for i, eye in enumerate(eyes):
            python.set_profile(real_profile(-1 - i), eye=eye, views=views[i])
        seen = python.filter(
            views,
            pupil_diameter_mm=5.0,
            focus_dpt=0.25,
            output=output,
            states=states,
            depth_encoding=encoding,
        )
    expected = b"".join(color.tobytes() for color in seen.colors)
    assert (tmp_path / "out.raw").read_bytes() == expected
    assert not np.array_equal(seen.colors[0], views[0].color)


# Errors


@pytest.mark.clients
def test_errors_name_their_field_and_leave_the_eye_in_use(
    start_client, shared_service, frame_file, tmp_path
):
    client = start_client(shared_service.endpoint)
    begin(client, frame_file, 5)
    size_px = (WIDTH_PX, HEIGHT_PX)
    wrong = client.expect_error("profile", "both", *size_px, '{"kind": "nobody"}')
    assert (wrong["code"], wrong["field"]) == ("profile_invalid", "kind")
    assert "'nobody'" in wrong["message"]
    crash = '{"kind": "double", "mark": 6, "crash": true}'
    crashed = client.expect_error("profile", "both", *size_px, crash)
    assert crashed["code"] == "worker_crashed"
    assert client.expect_error("profile", "middle", *size_px, "{}")["field"] == "eye"
    assert image_of(client, tmp_path) == (5, 245)
    client.ask("clear", 99, 0, "uint8")
    client.set_view(frame_file)
    assert client.expect_error("filter", "x")["field"] == "pupil_diameter_mm"
    frame_file.write_bytes(b"\0" * (3 * WIDTH_PX * HEIGHT_PX))
    client.ask("clear", 4, 0, "uint8")
    client.set_view(frame_file)
    short = client.expect_error("filter", "x")
    assert short["code"] == "invalid_argument"
    assert f"expected {3 * WIDTH_PX * HEIGHT_PX}" in short["message"]
    assert client.ask("unanswered") == 0


@pytest.mark.clients
def test_a_missing_service_is_an_error_after_the_time_limit(start_client):
    client = start_client("tcp://127.0.0.1:1", timeout_s=0.3)
    for words in (["hello"], ["ping"], ["profile", "both", 8, 4, DOUBLE % 1]):
        found = client.expect_error(*words)
        assert found["code"] == "service_timeout"
        assert (
            "a reply to hello; tcp://127.0.0.1:1 is not connected" in found["message"]
        )


@pytest.mark.clients
def test_a_key_is_accepted_and_a_wrong_one_named(
    start_client, start_service, tmp_path, frame_file
):
    ring, other = KeyRing(tmp_path / "keys"), KeyRing(tmp_path / "other")
    ring.add("lab", tmp_path / "lab.toml")
    other.create()
    other.add("stranger", tmp_path / "stranger.toml")
    service = start_service(keys_dir=str(ring.folder))
    client = start_client(service.endpoint, key_file=tmp_path / "lab.toml")
    begin(client, frame_file, 7)
    assert image_of(client, tmp_path)[0] == 7
    stranger = start_client(service.endpoint, key_file=tmp_path / "stranger.toml")
    assert stranger.expect_error("hello")["code"] == "authentication_failed"


# Streams


@pytest.mark.clients
@pytest.mark.parametrize(("max_in_flight", "n_filtered"), [(1, (2,)), (8, (2, 3))])
def test_frames_beyond_the_credit_wait_and_the_newest_replaces_the_others(
    start_client, use_service, frame_file, max_in_flight, n_filtered
):
    """The service has a credit of 2, and takes 0.2 s for a frame.

    It answers further frames with an error.  Of two frames that it has, it may drop the
    older one for a third.
    """
    service = use_service(command=(*QUICK_DOUBLE[:-1], "200"))
    client = start_client(service.endpoint, max_in_flight=max_in_flight)
    begin(client, frame_file)
    ids = [client.ask("submit") for _ in range(6)]
    assert client.ask("unanswered") == min(max_in_flight, 2) + 1
    events = client.events(len(ids), "result", "dropped", "error")
    assert sorted(event[1] for event in events) == ids
    filtered = [event[1] for event in events if event[0] == "result"]
    # The second frame may reach a service that has not begun the first, and replace it.
    assert filtered[0] in ids[: min(max_in_flight, 2)] and filtered[-1] == ids[-1]
    assert len(filtered) in n_filtered
    dropped = [event[3] for event in events if event[0] != "result"]
    assert dropped == ["superseded"] * (len(ids) - len(filtered))
    assert client.ask("unanswered") == 0


@pytest.mark.clients
@pytest.mark.parametrize("process", ["front-end", "service"])
def test_a_restart_resumes_or_begins_a_session(
    start_service, start_client, frame_file, tmp_path, process
):
    service = start_service()
    client = start_client(service.endpoint)
    begin(client, frame_file, 9)
    session = client.ask("hello")
    assert image_of(client, tmp_path) == (9, 245)
    if process == "front-end":
        pid = service.pids()[process]
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: service.pids().get(process, pid) != pid)
    else:
        service.process.kill()
        service.process.wait()
        service = start_service(bind=service.endpoint)
    assert image_of(client, tmp_path) == (9, 245)
    if process == "front-end":
        assert client.ask("hello") == session
    assert client.ask("ping") == 1


@pytest.mark.clients
def test_a_stream_reports_a_frame_that_a_restart_loses(
    start_service, start_client, frame_file, tmp_path
):
    service = start_service(filter_ms=1500)
    client = start_client(service.endpoint)
    begin(client, frame_file, 9)
    lost = client.ask("submit")
    service.process.kill()
    service.process.wait()
    start_service(bind=service.endpoint)
    assert client.events(1, "dropped") == [["dropped", lost, None, "connection_lost"]]
    assert image_of(client, tmp_path) == (9, 245)


@pytest.mark.clients
def test_a_profile_is_requested_without_waiting(
    start_client, shared_service, frame_file, tmp_path
):
    client = start_client(shared_service.endpoint)
    begin(client, frame_file, 1)
    profile = client.ask("request", "both", WIDTH_PX, HEIGHT_PX, DOUBLE % 2)
    events = client.events(2, "accepted", "ready")
    assert [event[2] for event in events] == [profile, profile]
    assert image_of(client, tmp_path)[0] == 2


# A service that sends anything


class Stranger:
    """A ROUTER that accepts a client and then sends whatever a test wants."""

    def __init__(self):
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.ROUTER)
        self.socket.linger = 0
        self.socket.rcvtimeo = int(1000 * TIMEOUT_S)
        port = self.socket.bind_to_random_port("tcp://127.0.0.1")
        self.endpoint = f"tcp://127.0.0.1:{port}"
        self.client = b""

    def serve(self):
        """Answer hello; return the ids of frames that have arrived."""
        frame_ids = []
        while self.socket.poll(0) or not self.client:
            self.client, header, *_ = self.socket.recv_multipart()
            message = msgpack.unpackb(header)
            if message["type"] == "hello":
                limits = messages.Limits()
                server = {"name": "a stranger"}
                self.send(encode(messages.Welcome(1, server, limits, 64, ("tcp",))))
            elif message["type"] == "frame":
                frame_ids.append(message["frame_id"])
        return frame_ids

    def send(self, parts):
        self.socket.send_multipart([self.client, *as_bytes(parts)])

    def close(self):
        self.socket.close()
        self.context.term()


@pytest.fixture
def stranger():
    stranger = Stranger()
    yield stranger
    stranger.close()


def result_parts(frame_id, value=3, size_px=(WIDTH_PX, HEIGHT_PX)):
    color = np.full((size_px[1], size_px[0], 3), value, np.uint8)
    view = ResultView(*size_px, eye="both", profile_id=0, generation=1)
    times_ms = {"filter_ms": 1.0}
    return encode(
        Result(
            *(frame_id, 0, 1, (view,), 4.0, 0.5, 0, 0, 1.0, times_ms),
            notes=("a note",),
            colors=(color,),
        )
    )


def strange_replies():
    """Replies that are cut, changed, or random; results are about the newest frame."""
    rng = random.Random(7)
    number = itertools.count()
    for make in [*(lambda _, r=r: encode(r) for r in REPLIES), result_parts]:
        for end in range(0, len(as_bytes(make(0))[0]), 5):
            header, *rest = as_bytes(make(next(number)))
            yield [header[:end], *rest]
        for _ in range(30):
            yield mutated(rng, as_bytes(make(next(number)))) or [b""]
    yield [result_parts(next(number))[0], *[b""] * 100]
    large = {"type": "dropped", "frame_id": next(number), "reason": "x" * 5000}
    yield [msgpack.packb(large)]
    pixels = bytes(3 * WIDTH_PX * HEIGHT_PX)
    for size_px in ((2**30, 2**30), (-WIDTH_PX, -HEIGHT_PX), (0, 0), (1, 1)):
        for part in (pixels, b""):
            view = {"width_px": size_px[0], "height_px": size_px[1]}
            view["color"] = {"dtype": "uint24" if size_px == (1, 1) else "uint8"}
            result = {"type": "result", "frame_id": next(number), "views": [view]}
            yield [msgpack.packb(result), part]


@pytest.mark.clients
def test_malformed_replies_are_errors(stranger, start_client, frame_file, tmp_path):
    client = start_client(stranger.endpoint, max_in_flight=64)
    wait_until(lambda: client.ask("poll", 0.1) or stranger.socket.poll(0))
    stranger.serve()
    assert client.ask("hello") == 1
    client.ask("clear", 4, 0, "uint8")
    client.set_view(frame_file)
    refused, n_sent = [], 0
    marker = encode(messages.Progress(77, 1, "marker", 0.5))
    for parts in strange_replies():
        assert client.ask("submit") == n_sent
        stranger.serve()
        stranger.send(parts)
        stranger.send(encode(messages.Dropped(n_sent, "superseded")))
        stranger.send(marker)
        n_sent += 1
        found = client.ask("poll", TIMEOUT_S)
        while not isinstance(found, list) or not any(e[3] == "marker" for e in found):
            if isinstance(found, dict):
                assert found["code"] == "bad_reply"
                refused.append(found["message"])
            found = client.ask("poll", TIMEOUT_S)
        stranger.serve()
    assert n_sent > 700
    assert len(refused) > n_sent / 2
    for reason in (
        *("is not msgpack", "lacks its field", "has a wrong type", "is not a map"),
        *("pixels has", "1 views has 15 images", "unknown type", "a header has"),
    ):
        assert any(reason in message for message in refused), reason
    last = client.ask("submit")
    wait_until(lambda: client.ask("poll", 0.01) == [] and last in stranger.serve())
    stranger.send(result_parts(last))
    assert client.events(1, "result")[-1][1] == last


# Pages


def printed_line():
    """Return the command that compiles the example, in the file and on the page."""
    source = (FOLDER / "example.cpp").read_text(encoding="utf-8")
    (line,) = re.findall(r"^// {5}(g\+\+ .*)$", source, re.MULTILINE)
    for page in (FOLDER / "README.md", CHECKOUT / WAYS_PAGE):
        assert line in page.read_text(encoding="utf-8")
    return line


@pytest.mark.clients
def test_the_example_runs_as_its_comment_says(compile_program, real_service, tmp_path):
    line = printed_line()
    shutil.copytree(FOLDER, tmp_path / "cpp")
    built = subprocess.run(
        shlex.split(line.replace("-O2", "-O0")),
        cwd=tmp_path / "cpp",
        timeout=COMPILE_LIMIT_S,
    )
    assert built.returncode == 0
    color, depth_m = scene("uint8")
    (tmp_path / "color.raw").write_bytes(color.tobytes())
    (tmp_path / "depth.raw").write_bytes(depth_m.tobytes())
    profile = json.dumps(real_profile(-2))
    size = (str(WIDTH_PX), str(HEIGHT_PX))

    def run(*words):
        program = tmp_path / "cpp" / "example"
        return subprocess.run(
            [program, real_service.endpoint, *words],
            cwd=tmp_path,
            capture_output=True,
            timeout=3 * TIMEOUT_S,
        )

    of_files = run(profile, *size, "color.raw", "depth.raw")
    assert of_files.returncode == 0, of_files.stderr
    with FilterClient(real_service.endpoint) as python:
        view = RgbdView(color, depth_m, tangents_from_fov(30.0, WIDTH_PX, HEIGHT_PX))
        python.set_profile(real_profile(-2), views=view)
        seen = python.filter(view, pupil_diameter_mm=4.0, focus_dpt=0.25)
    header = f"P6\n{WIDTH_PX} {HEIGHT_PX}\n255\n".encode()
    assert of_files.stdout == header + seen.color.tobytes()
    assert of_files.stderr.decode().splitlines() == list(seen.notes)
    nowhere = subprocess.run(
        [tmp_path / "cpp" / "example", "here"], capture_output=True
    )
    assert (nowhere.returncode, nowhere.stdout) == (1, b"")
    assert nowhere.stderr.startswith(b"example: endpoint is 'here' (")
    wrong = run('{"kind": "nobody"}')
    assert (wrong.returncode, wrong.stdout) == (1, b"")
    assert wrong.stderr.startswith(b"example: kind: ")


def fenced(page):
    (block,) = re.findall(r"```cpp\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    return block


@pytest.mark.clients
def test_the_lines_of_the_pages_run(compile_program, real_service, tmp_path):
    include, _, readme = fenced(FOLDER / "README.md").partition("\n\n")
    way_in = fenced(CHECKOUT / WAYS_PAGE)
    text = f"""{include}
        #include <cstdio>
        int main() {{
          const std::vector<std::uint8_t> color(480 * 270 * 3, 128);
          const std::vector<float> depth_m(480 * 270, 2.0f);
          {readme}
          std::printf("%d ", pixels[3 * 480 * 135 + 3 * 240]);
          {{
            {way_in}
            std::printf("%zu", seen.images[0].size_bytes());
          }}
        }}"""
    source = tmp_path / "pages.cpp"
    source.write_text(text.replace("tcp://127.0.0.1:5577", real_service.endpoint))
    program = compile_program(source, "-O0")
    finished = subprocess.run([program], capture_output=True, timeout=3 * TIMEOUT_S)
    assert finished.returncode == 0, finished.stderr
    value, size_bytes = map(int, finished.stdout.split())
    assert abs(value - 128) <= 1  # gray stays gray
    assert size_bytes == 3 * 480 * 270
