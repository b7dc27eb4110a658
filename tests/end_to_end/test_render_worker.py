"""The loop that filters, on a link of the test's own: order, and faults."""

import os
import pickle
import socket
import threading
import time

import pytest

from filter_service.building.jobs import BuildLimits
from filter_service.building.worker_handle import WorkerHandle
from filter_service.filtering.builder import Builder
from filter_service.messages import ProfileRequest, SharedPlaces, encode
from filter_service.service import render_worker
from filter_service.service.process_channel import HEAD, Link
from filter_service.service.render_worker import RenderWorker
from filter_service.service.render_worker_process import handle_control
from filter_service.shared_memory import Slot
from tests.end_to_end.conftest import TIMEOUT_S, small_frame
from tests.end_to_end.doubles import EngineDouble, read_profile

PLACES = SharedPlaces(1, (0, 512), 2, (0,))


def header_of(frame_id):
    """Return the header of a frame as the front end received it."""
    return encode(small_frame(frame_id, images=(), memory=PLACES))[0]


class RestingEngine(EngineDouble):
    """Does what a test wants in the middle of its first frame, then rests."""

    def __init__(self):
        super().__init__(0.0)
        self.in_the_middle = None

    def call_between(self, function, interval_s):
        self.between = function
        return True

    def begin(self, request):
        job, self.in_the_middle = self.in_the_middle, None
        if job is not None:
            job()
            time.sleep(0.05)
            self.between()
        return super().begin(request)


class FrontEnd:
    """The front end's end of a link, and what the loop has said."""

    def __init__(self, engine):
        worker = WorkerHandle("tests.end_to_end.doubles:build")
        builder = Builder(worker, engine, BuildLimits())
        loop = RenderWorker(builder, read_profile, max_cameras=4)
        self.link, theirs = Link.pair()
        self.control, control = Link.pair()
        self.theirs = Link(theirs), Link(control)
        loop.connect(self.theirs[0])
        self.said = []
        self.thread = threading.Thread(
            target=loop.run,
            args=(self.theirs[1], lambda *message: handle_control(loop, *message)),
        )
        self.thread.start()
        for number in (1, 2):
            slot = Slot.create(number, 4096)
            self.tell("slot", number, slot.size_bytes, descriptors=[slot.descriptor])

    def tell(self, *message, descriptors=()):
        self.link.send(message, descriptors)

    def await_one(self, is_wanted):
        end_s = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end_s:
            self.said += [message for message, _ in self.link.receive()]
            for message in self.said:
                if is_wanted(message):
                    return message
            time.sleep(0.01)
        raise AssertionError(f"waited in vain among {[m[0] for m in self.said]}")

    def answer_to(self, number):
        return self.await_one(lambda m: m[0] == "frame_reply" and m[1] == number)[2]

    def frame(self, number, key, places=PLACES):
        self.tell("frame", number, key, header_of(number), places, ())

    def tell_at_once(self, *messages):
        """Send messages in one piece, so that the loop reads them together."""
        bodies = [pickle.dumps(message, protocol=5) for message in messages]
        pieces = [HEAD.pack(len(body), 0) + body for body in bodies]
        self.link._socket.sendall(b"".join(pieces))

    def stop(self):
        self.control.send(("stop",))
        self.thread.join(TIMEOUT_S)
        assert not self.thread.is_alive()
        for link in (self.link, self.control, *self.theirs):
            link.close()


@pytest.fixture
def resting():
    return RestingEngine()


@pytest.fixture
def front_end(resting):
    front_end = FrontEnd(resting)
    front_end.tell("open", "a", 1, {})
    camera = small_frame(0).views[0].camera
    body = {"kind": "double", "mark": 3}
    front_end.tell("profile", "a", ProfileRequest(0, body, views=(camera,)))
    front_end.await_one(lambda m: m[0] == "profile_reply" and m[3].type_name == "ready")
    yield front_end
    front_end.stop()


def test_what_comes_in_a_rest_does_not_overtake_what_came_before(front_end, resting):
    """The frame of `b` comes in the rest; `b` was opened before, in the same batch."""
    resting.in_the_middle = lambda: front_end.frame(2, "b")
    frame = ("frame", 1, "a", header_of(1), PLACES, ())
    front_end.tell_at_once(frame, ("open", "b", 2, {}))
    assert front_end.answer_to(2).code == "no_profile", "not no_session: it was open"
    assert front_end.answer_to(1)["frame_id"] == 1, "not an error"


def test_a_front_end_that_comes_in_a_rest_is_heard(front_end, resting, monkeypatch):
    """The link to it has the descriptor of the one to its predecessor."""
    monkeypatch.setattr(render_worker, "IDLE_WAIT_S", 60.0)
    old, (new, theirs) = front_end.link, Link.pair()
    used = [os.dup(0)]
    while used[-1] < front_end.theirs[0].fileno():
        used.append(os.dup(0))

    def replace():
        old._socket.shutdown(socket.SHUT_RDWR)
        resting.between()
        front_end.control.send(("link", 0), [theirs.fileno()])

    resting.in_the_middle = replace
    front_end.frame(1, "a")
    front_end.link = new
    front_end.answer_to(1)
    time.sleep(0.1)  # it waits
    front_end.frame(2, "a")
    assert front_end.answer_to(2).frame_id == 2
    for end in (old, theirs):
        end.close()
    for descriptor in used:
        os.close(descriptor)


def test_a_frame_that_cannot_be_answered_is_answered(front_end):
    """A slot that the door has given up, say: nothing waits for a time limit."""
    front_end.frame(5, "a", SharedPlaces(9, (0, 512), 2, (0,)))
    assert front_end.answer_to(5).code == "render_failed"
    front_end.frame(6, "a")
    assert front_end.answer_to(6)["frame_id"] == 6, "not an error"
