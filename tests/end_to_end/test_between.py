"""What happens to others while one client's frame takes long."""

import time

import numpy as np
import pytest

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from filter_service.camera import tangents_from_fov
from filter_service.messages import Accepted, Ready

pytestmark = pytest.mark.clock

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
NARROW = {"pupil_range_mm": (3.9, 4.1), "object_range_dpt": (0, 2)}
MYOPIA = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -12}
LONG = (3200, 2400)
SHORT = (320, 180)


def noise_view(rng, width_px, height_px):
    """Every pixel of another color, nothing to merge; a ramp of distances."""
    color = rng.integers(0, 256, (height_px, width_px, 3), dtype=np.uint8)
    ramp_m = np.linspace(1.0, 6.0, width_px, dtype=np.float32)
    depth_m = np.tile(ramp_m, (height_px, 1))
    return RgbdView(color, depth_m, tangents_from_fov(40.0, width_px, height_px))


@pytest.fixture
def prepared(real_service, rng):
    """Two clients, each with its view, its frame alone and the time it took, in s."""
    clients = [FilterClient(real_service.endpoint, timeout_s=60.0) for _ in range(2)]
    with clients[0], clients[1]:
        found = []
        for client, size in zip(clients, (LONG, SHORT), strict=True):
            view = noise_view(rng, *size)
            client.set_profile(MYOPIA, settings=NARROW, views=[view])
            client.filter(view, **SEE)  # the first frame waits for its PSFs
            start_s = time.monotonic()
            alone = client.filter(view, **SEE).color.copy()
            found.append((client, view, alone, time.monotonic() - start_s))
        yield found


def begin(client, view, duration_s):
    """Submit a frame and wait until the service works on it."""
    frame_id = client.submit(view, **SEE)
    time.sleep(0.2 * duration_s)
    return frame_id


def answer_to(client, frame_id):
    """Wait for a frame without taking what else happens."""
    while True:
        for event in client.poll(10.0):
            if getattr(event, "frame_id", None) == frame_id:
                assert isinstance(event, FilteredFrame), event
                return event


def test_small_frames_come_between_the_parts_of_a_large_one(prepared):
    (slow, large, large_alone, duration_s), (quick, small, small_alone, _) = prepared
    frame_id = begin(slow, large, duration_s)
    n_between = 0
    answers = []
    while not answers:
        assert quick.filter(small, **SEE).color.tobytes() == small_alone.tobytes()
        answers = [e for e in slow.poll(0.0) if isinstance(e, FilteredFrame)]
        n_between += not answers
    assert n_between >= 2  # one may have been first; another came between two parts
    (answer,) = answers
    assert answer.frame_id == frame_id
    assert answer.color.tobytes() == large_alone.tobytes()
    stages_ms = answer.stage_times_ms
    assert sum(stages_ms.values()) == pytest.approx(answer.total_ms, rel=0.02)


def test_another_eye_is_accepted_and_made_ready_meanwhile(prepared):
    (slow, large, large_alone, duration_s), (quick, small, small_alone, _) = prepared
    frame_id = begin(slow, large, duration_s)
    accepted = quick.set_profile(
        {**MYOPIA, "sphere_dpt": -3}, settings=NARROW, views=[small], wait=False
    )
    assert isinstance(accepted, Accepted)
    slow.poll(0.0)
    assert slow.n_unanswered, "the large frame was not in the way"
    assert answer_to(slow, frame_id).color.tobytes() == large_alone.tobytes()
    while not any(isinstance(event, Ready) for event in quick.poll(10.0)):
        pass
    assert quick.filter(small, **SEE).color.tobytes() != small_alone.tobytes()


def test_a_client_may_leave_in_the_middle_of_its_frame(real_service, prepared):
    (slow, large, _, duration_s), (quick, small, small_alone, _) = prepared
    begin(slow, large, duration_s)
    slow.close()
    for _ in range(3):
        assert quick.filter(small, **SEE).color.tobytes() == small_alone.tobytes()
    while quick.ping()[1].is_filtering:
        time.sleep(0.05)
    assert quick.ping()[1].n_sessions == 1
    assert quick.filter(small, **SEE).color.tobytes() == small_alone.tobytes()
    assert real_service.process.poll() is None


def test_the_service_stops_in_the_middle_of_a_frame(real_service, rng):
    with FilterClient(real_service.endpoint, timeout_s=60.0) as client:
        view = noise_view(rng, *LONG)
        client.set_profile(MYOPIA, settings=NARROW, views=[view])
        client.filter(view, **SEE)
        start_s = time.monotonic()
        client.filter(view, **SEE)
        begin(client, view, time.monotonic() - start_s)
        assert real_service.stop(4.0) == 0
