"""Two engines behind one socket, with real eyes; native ones have a thread each."""

import os
import signal
import time
from contextlib import ExitStack

import numpy as np
import pytest

from clients.filter_client import FilterClient, FilteredFrame
from clients.service_process import ServiceProcess
from tests.end_to_end.test_real_service import MYOPIA, NARROW, PLAIN, SEE, edge_view

SETTINGS = NARROW | {
    "mode": "on-axis",
    "eye_model": "wavefront",
    "focus_range_dpt": (0, 0),
    "prepare": "ranges",  # the same again
}
TIMEOUT_S = 20.0


@pytest.fixture(scope="module")
def two_engines():
    settings = {"devices": ["native:1", "native:1"]}
    with ServiceProcess(settings, start_timeout_s=60.0) as service:
        yield service
        assert service.stop(10.0) == 0


@pytest.fixture
def pair(two_engines):
    """Two clients, a myope's first; each is on a device of its own."""
    view = edge_view()
    clients = []
    for profile in (MYOPIA, PLAIN):
        client = FilterClient(two_engines.endpoint, timeout_s=TIMEOUT_S)
        clients.append(client)
        client.set_profile(profile, settings=SETTINGS, views=[view])
    yield clients
    for client in clients:
        client.close()


@pytest.mark.gl
def test_each_engine_has_one_thread_and_gives_the_same_picture(two_engines, pair):
    view = edge_view()
    for client in pair:
        assert "1 thread" in client.hello().server["renderer"]
        client.set_profile(MYOPIA, settings=SETTINGS, views=[view])
    first, second = (client.filter(view, **SEE).color for client in pair)
    np.testing.assert_array_equal(first, second)
    assert {device_of(two_engines, client) for client in pair} == {0, 1}


def device_of(service, client):
    """Return the index of a client's device, as the log has it."""
    begins = f"session {client.hello().session_id} started"
    line = next(line for line in service.log.splitlines() if begins in line)
    return int(line.rpartition(" ")[2])


@pytest.mark.slow
def test_a_gpu_and_a_processor_filter_side_by_side():
    """The pictures of both engines agree, each from the device that was named."""
    settings = {"devices": ["gl:0", "native:1"]}
    view, seen, renderers = edge_view(), [], []
    with (
        ServiceProcess(settings, start_timeout_s=60.0) as service,
        ExitStack() as all_,
    ):
        for _ in range(2):
            client = all_.enter_context(
                FilterClient(service.endpoint, timeout_s=TIMEOUT_S)
            )
            client.set_profile(MYOPIA, settings=SETTINGS, views=[view])
            renderers.append(client.hello().server["renderer"])
            seen.append(client.filter(view, **SEE).color)
    assert "native" not in renderers[0]
    assert "native" in renderers[1]
    np.testing.assert_allclose(seen[0], seen[1], atol=2e-3)


@pytest.mark.clock
def test_a_killed_engine_s_client_goes_on_and_the_other_loses_no_frame(
    two_engines, pair
):
    view = edge_view()
    struck, other = pair
    wanted = [client.filter(view, **SEE).color for client in pair]
    sessions = [client.hello().session_id for client in pair]
    name = f"render {device_of(two_engines, struck)}"
    before = two_engines.pids()
    os.kill(before[name], signal.SIGKILL)
    n_sent = n_seen = 0
    is_back, end_s = False, time.monotonic() + TIMEOUT_S
    while not is_back and time.monotonic() < end_s:
        if struck.n_unanswered == 0:
            struck.submit(view, **SEE)
        if other.n_unanswered == 0:
            other.submit(view, **SEE)
            n_sent += 1
        for event in struck.poll(0.005):
            if isinstance(event, FilteredFrame) and event.is_complete:
                np.testing.assert_array_equal(event.color, wanted[0])
                is_back = True
        for event in other.poll(0.005):
            assert isinstance(event, FilteredFrame), "the other noticed"
            np.testing.assert_array_equal(event.color, wanted[1])
            n_seen += 1
    assert is_back
    assert n_seen >= n_sent - 1 > 0
    assert [client.hello().session_id for client in pair] == sessions
    after = two_engines.pids()
    assert {child for child in before if after[child] != before[child]} == {name}
