"""Real service processes on random ports; everything has a limit of 10 s."""

import contextlib
import sys

import moderngl
import numpy as np
import pytest
import zmq

from clients.filter_client import FilterClient, RgbdView
from clients.scenes.scene_view import SceneView
from clients.service_process import SERVE_COMMAND, ServiceProcess
from filter_service.messages import (
    Bye,
    Camera,
    Frame,
    Hello,
    Ping,
    ProfileRequest,
    ViewHeader,
    ViewImages,
    decode_reply,
    encode,
    tangents_from_fov,
)
from tests.end_to_end.service_pool import ServicePool

TIMEOUT_S = 10.0
START_TIMEOUT_S = 60.0
"""Of a service with real engines, which tests of both kinds share."""

DOUBLE = (sys.executable, "-m", "tests.end_to_end.double_service")
QUICK_DOUBLE = (*DOUBLE, "--filter-ms", "2")
USUAL = {"alive_interval_s": 0.1, "max_sessions": 16}


@pytest.fixture
def start_service():
    """Start services with the renderer double; they end with the test, cleanly."""
    services = []

    def start(*, filter_ms=2.0, **settings):
        command = (*DOUBLE, "--filter-ms", str(filter_ms))
        service = ServiceProcess(settings, command=command, start_timeout_s=TIMEOUT_S)
        services.append(service)
        return service

    yield start
    for service in services:
        if service.process.poll() is None:
            assert service.stop(TIMEOUT_S) == 0
        service.kill()  # removes its folder where a test has ended it


@pytest.fixture(scope="session")
def service_pool(pytestconfig):
    """Services that the tests of a worker use one after the other."""
    durations = pytestconfig.pluginmanager.get_plugin("durations")
    apart = contextlib.nullcontext if durations is None else durations.apart
    pool = ServicePool(START_TIMEOUT_S, apart)
    yield pool
    pool.close()


@pytest.fixture
def use_service(service_pool):
    """Use running services, with the double unless a command is given.

    A test that leaves one as it was, without sessions, leaves it to the next test.  One
    whose subject is the start or end of a process starts its own by `start_service`.
    """
    used = []

    def use(*, command=QUICK_DOUBLE, **settings):
        used.append(service_pool.lend(command, settings))
        return used[-1]

    yield use
    for service in used:
        service_pool.take_back(service)


@pytest.fixture
def shared_service(use_service):
    """The service with the double that most tests use."""
    return use_service(**USUAL)


@pytest.fixture
def real_service(use_service):
    """The service with its own engine and defaults."""
    return use_service(command=SERVE_COMMAND)


@pytest.fixture
def brief_service(use_service):
    """The service with the double that soon ends sessions and builds."""
    return use_service(alive_interval_s=0.05, session_keep_s=0.3, cancel_grace_s=0.2)


@pytest.fixture
def small_service(use_service):
    """The service with the double that takes little of everything."""
    limits = {"max_part_mb": 1, "max_profile_kb": 1, "max_image_mb": 10}
    return use_service(max_sessions=2, credit=3, **limits)


@pytest.fixture
def client(shared_service):
    with FilterClient(shared_service.endpoint, timeout_s=TIMEOUT_S) as client:
        yield client


class RawClient:
    """A DEALER that sends whatever a test wants."""

    def __init__(self, endpoint, **options):
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.linger = 0
        self.socket.sndtimeo = self.socket.rcvtimeo = int(1000 * TIMEOUT_S)
        for name, value in options.items():
            setattr(self.socket, name, value)
        self.socket.connect(endpoint)

    def send(self, parts):
        self.socket.send_multipart(parts, copy=False)

    def receive(self):
        while True:
            reply = decode_reply(self.socket.recv_multipart())
            if reply.type_name not in ("alive", "progress"):
                return reply

    def ask(self, message):
        self.send(encode(message))
        return self.receive()

    def begin(self, mark=1, more=None, **frame_size):
        """Say hello, send a profile for `small_frame` and wait until it is ready."""
        welcome = self.ask(Hello("raw"))
        body = {"kind": "double", "mark": mark, **(more or {})}
        camera = small_frame(0, **frame_size).views[0].camera
        accepted = self.ask(ProfileRequest(mark, body, views=(camera,)))
        assert accepted.type_name == "accepted"
        assert self.receive().type_name == "ready"
        return welcome

    def end(self):
        """End the session, if there is one, and close."""
        with contextlib.suppress(zmq.ZMQError):  # it is closed, or nobody answers
            self.socket.sndtimeo = self.socket.rcvtimeo = 100
            self.send(encode(Bye()))
            while self.ask(Ping()).type_name != "pong":
                pass
        self.close()

    def close(self):
        self.socket.close(linger=0)
        self.context.term()


@pytest.fixture
def raw_client(use_service):  # whose services are reset after the clients end
    clients = []

    def connect(service, **options):
        clients.append(RawClient(service.endpoint, **options))
        return clients[-1]

    yield connect
    for client in clients:
        client.end()


def small_frame(frame_id, *, width_px=16, height_px=8, **changes):
    camera = Camera(width_px, height_px, tangents_from_fov(60.0, width_px, height_px))
    color = np.full((height_px, width_px, 3), 10, np.uint8)
    depth_m = np.full((height_px, width_px), 2.0, np.float32)
    fields = {
        "frame_id": frame_id,
        "views": (ViewHeader.of(camera),),
        "pupil_diameter_mm": 4.0,
        "focus_dpt": 0.0,
        "images": (ViewImages(color, depth_m),),
    }
    return Frame(**fields | changes)


def make_view(width_px=64, height_px=36, dtype=np.uint8, seed=0):
    rng = np.random.default_rng(seed)
    color = rng.random((height_px, width_px, 3), dtype=np.float32)
    if dtype == np.uint8:
        color = (255 * color).astype(np.uint8)
    depth_m = np.full((height_px, width_px), 2.0, np.float32)
    return RgbdView(color, depth_m, tangents_from_fov(60.0, width_px, height_px))


@pytest.fixture(scope="module")
def context():
    """An OpenGL context in which a module's tests leave no error."""
    context = moderngl.create_context(standalone=True, require=330, backend="egl")
    yield context
    with context:
        assert context.error == "GL_NO_ERROR"
    context.release()


@pytest.fixture
def show(context):
    """Render a scene once."""

    def render(scene, pose, tangents, size_px, *, supersampling=2):
        with SceneView(context, scene, size_px, supersampling=supersampling) as view:
            return view.render(pose, tangents)

    return render
