"""More frames than can be filtered, and clients that do not read: age and memory."""

import json
import time

import numpy as np
import pytest

from clients.filter_client import FilterClient, FilteredFrame
from filter_service.messages import Ping, encode
from filter_service.wire.replies import Dropped
from tests.benchmarks.bench_abuse import guest, started
from tests.end_to_end.conftest import make_view, small_frame
from tests.end_to_end.test_lifecycle import wait_until

pytestmark = pytest.mark.clock

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}
FILTER_MS = 40.0
DURATION_S = 2.5


def stream_at(client, view, *, period_s, duration_s, look):
    """Submit on a fixed schedule; return the ages, counted from the schedule."""
    start_s = time.monotonic()
    due_s = {}
    ages_ms, n_dropped = [], 0

    def take(wait_s):
        nonlocal n_dropped
        for event in client.poll(wait_s):
            if isinstance(event, FilteredFrame):
                ages_ms.append(1000 * (time.monotonic() - due_s[event.frame_id]))
            n_dropped += isinstance(event, Dropped)

    n = 0
    while n * period_s < duration_s:
        scheduled_s = start_s + n * period_s
        while (wait_s := scheduled_s - time.monotonic()) > 0:
            take(wait_s)
        due_s[client.submit(view, **SEE)] = scheduled_s
        n += 1
        look(scheduled_s - start_s)
    while client.n_unanswered:
        take(10.0)
    take(0.0)
    return np.array(ages_ms), n_dropped, n


# One frame in flight is for live streams.  With two, one waits while the other is
# filtered: 2.33 periods at worst, plus whatever the machine adds.
@pytest.mark.parametrize(("max_in_flight", "percentile"), [(1, 95), (2, 50)])
def test_under_threefold_overload_frames_stay_young_and_memory_flat(
    start_service, max_in_flight, percentile
):
    service = start_service(filter_ms=FILTER_MS)
    view = make_view(1280, 720)
    memory_mb = []

    def look(elapsed_s):
        if elapsed_s > 1.0:
            memory_mb.append(service.memory_mb)

    with FilterClient(service.endpoint, max_in_flight=max_in_flight) as client:
        client.set_profile(EYE, views=[view])
        client.filter(view, **SEE)
        ages_ms, n_dropped, n_sent = stream_at(
            client, view, period_s=FILTER_MS / 3000, duration_s=DURATION_S, look=look
        )
        pong = client.ping()[1]
    # What the double takes in all: its sleep, and inverting the image.
    period_ms = 1000 * DURATION_S / len(ages_ms)
    assert np.percentile(ages_ms, percentile) < 2.5 * period_ms
    assert len(ages_ms) > 20, "too few frames to say anything"
    assert n_dropped > 0.4 * n_sent, "there was no overload"
    assert len(ages_ms) + n_dropped == n_sent, "frames were lost silently"
    assert max(memory_mb) - min(memory_mb) < 25.0  # four 720p frames
    assert pong.n_sessions == 1


def test_a_client_that_does_not_read_costs_bounded_memory_and_loses_no_answer(
    start_service, raw_client
):
    service = start_service(filter_ms=0)
    reader, sleeper = raw_client(service), raw_client(service, rcvhwm=1, rcvbuf=65536)
    size = {"width_px": 1024, "height_px": 512}
    reader.begin(1)
    sleeper.begin(2, **size)
    before_mb = service.memory_mb
    n_frames = 60
    for frame_id in range(n_frames):
        sleeper.send(encode(small_frame(frame_id, **size)))
        reader.ask(Ping())  # the other client is served all the time
        time.sleep(0.02)  # for the frame to be filtered
    grown_mb = service.memory_mb - before_mb
    assert grown_mb < 40.0, f"{n_frames} unread answers cost {grown_mb:.0f} MB"
    answers = [sleeper.receive() for _ in range(n_frames)]
    assert sorted(a.frame_id for a in answers) == list(range(n_frames))
    assert "slow_consumer" in {getattr(a, "reason", "") for a in answers}
    assert reader.ask(small_frame(1)).type_name == "result"


def test_a_client_that_floods_is_held_back_and_costs_bounded_memory(
    start_service, raw_client
):
    service = start_service(filter_ms=150)
    size = {"width_px": 1024, "height_px": 512}
    flooder = raw_client(service, sndhwm=100)
    flooder.begin(1, **size)
    before_mb = service.memory_mb
    n_frames = 60
    for frame_id in range(n_frames):
        flooder.send(encode(small_frame(frame_id, **size)))
    memory_mb = []
    end_s = time.monotonic() + 1.0
    while time.monotonic() < end_s:
        memory_mb.append(service.memory_mb)
        time.sleep(0.01)
    flood_mb = n_frames * 1024 * 512 * 7 / 1e6
    assert max(memory_mb) - before_mb < 60.0 < flood_mb / 3
    answers = [flooder.receive() for _ in range(n_frames)]
    assert sorted(a.frame_id for a in answers) == list(range(n_frames))


@pytest.mark.parametrize(
    "kind",
    [
        *("surfaces", "items"),
        *(pytest.param(k, marks=pytest.mark.slow) for k in ("zernike_set", "text")),
    ],
)
def test_a_flood_of_profiles_takes_no_more_than_a_second_stream(real_service, kind):
    """Rates beside each in turn: the machine may have other work."""
    body = {"kind": "prescription", "sphere_dpt": -2}
    rates_hz = {"stream": [], f"flood_{kind}": []}
    silences_s = []
    before = real_service.pids()
    with guest(real_service.endpoint, body=body) as stream:
        wait_until(stream.filtered, limit_s=60.0)
        for name in [*rates_hz] * 2:
            attack = started(name, real_service.endpoint, 3.0)
            assert attack.stdout.readline() == "begun\n"
            time.sleep(0.5)
            hz, silence_s = stream.watch(2.0)
            rates_hz[name].append(hz)
            counts = json.loads(attack.communicate()[0])
            if name == "stream":
                assert counts["result"] > 0
            else:
                silences_s.append(silence_s)
                assert counts["sent"] > 100
        assert not stream.errors
    beside_stream_hz, beside_flood_hz = map(max, rates_hz.values())
    assert beside_flood_hz > 0.8 * beside_stream_hz
    assert min(silences_s) < 1.0
    assert real_service.pids() == before
