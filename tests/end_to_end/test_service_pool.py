"""Tests share running services: each test finds one as it was started."""

import os
import signal
from types import SimpleNamespace

import pytest

from clients.filter_client import FilterClient
from filter_service.errors import BuildFailed, TooManySessions, UnknownProfile
from filter_service.messages import Hello
from filter_service.service.status_query import query_status
from tests.end_to_end import service_pool as pool_module
from tests.end_to_end.conftest import (
    DOUBLE,
    QUICK_DOUBLE,
    TIMEOUT_S,
    USUAL,
    RawClient,
    make_view,
    small_frame,
)
from tests.end_to_end.service_pool import INITIAL
from tests.end_to_end.test_lifecycle import wait_until
from tests.end_to_end.test_operations import hang_up

EYE = {"kind": "double", "mark": 5}


@pytest.fixture
def lend(service_pool):
    """Lend the service that most tests use, after taking back the one before."""
    lent = []

    def lend():
        if lent:
            service_pool.take_back(lent.pop())
        lent.append(service_pool.lend(QUICK_DOUBLE, USUAL))
        return lent[-1]

    yield lend
    service_pool.take_back(lent.pop())


def assert_serves_as_started(service):
    """Nobody is there, a client has no eye before it sends one, and gets its own."""
    assert "session" not in service.log
    assert INITIAL.items() <= query_status(service.endpoint).items()
    raw = RawClient(service.endpoint)
    welcome = raw.ask(Hello("next"))
    assert (welcome.is_resumed, welcome.profile_ids) == (False, {})
    assert raw.ask(small_frame(1)).code == "no_profile"
    raw.begin(mark=8)
    assert raw.ask(small_frame(2)).colors[0][0, 0, 0] == 8
    raw.end()


@pytest.mark.parametrize(
    "name",
    [
        "supervisor",
        pytest.param("render", marks=pytest.mark.tools),
    ],
)
def test_after_a_crash_the_next_test_has_another_service(lend, name):
    crashed = lend()
    pid = crashed.pids()[name]
    os.kill(pid, signal.SIGKILL)
    if name == "render":  # the service goes on, but its restarts count
        wait_until(lambda: crashed.pids().get(name, pid) != pid)
    else:
        crashed.process.wait(TIMEOUT_S)
    after = lend()
    assert after is not crashed
    assert crashed.process.poll() is not None
    assert_serves_as_started(after)


def test_of_a_refused_profile_the_next_test_sees_nothing(lend):
    first = lend()
    with FilterClient(first.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[make_view()])
        with pytest.raises(UnknownProfile):
            client.set_profile(EYE | {"mark": 900})
        with pytest.raises(BuildFailed):
            client.set_profile(EYE | {"fail": True})
        client.set_profile(EYE | {"build_s": 60.0}, wait=False)
    after = lend()
    assert after is first
    assert_serves_as_started(after)


@pytest.mark.tools
def test_after_a_changed_setting_the_next_test_has_the_initial_ones(lend):
    changed = lend()
    hang_up(changed, "max_sessions = 16", "max_sessions = 1", "max_sessions is now 1")
    with (
        FilterClient(changed.endpoint, timeout_s=TIMEOUT_S),
        pytest.raises(TooManySessions),
        FilterClient(changed.endpoint, timeout_s=TIMEOUT_S),
    ):
        pass
    after = lend()
    assert "max_sessions = 16" in after.config_file.read_text()
    assert_serves_as_started(after)
    with (
        FilterClient(after.endpoint, timeout_s=TIMEOUT_S) as first,
        FilterClient(after.endpoint, timeout_s=TIMEOUT_S) as second,
    ):
        assert first.hello().session_id != second.hello().session_id


@pytest.mark.tools
def test_a_session_that_could_be_resumed_is_left_to_nobody(lend):
    service = lend()
    raw = RawClient(service.endpoint)
    raw.begin()
    raw.close()  # without a word
    wait_until(lambda: "client disconnected" in service.log)
    assert lend() is not service


class ServiceDouble:
    """A service that is always as it was started."""

    def __init__(self, key, *_):
        self.key, self.log, self.n_before = key, "", 0
        self.process = SimpleNamespace(poll=lambda: None)
        self.has_ended = False

    def load(self):
        pass

    def is_reset(self):
        return True

    def end(self):
        self.has_ended = True


def test_the_service_used_longest_ago_is_ended(monkeypatch):
    monkeypatch.setattr(pool_module, "PooledService", ServiceDouble)
    pool, numbers = pool_module.ServicePool(TIMEOUT_S), range(pool_module.MAX_IDLE)
    services = [pool.lend(DOUBLE, {"credit": number}) for number in numbers]
    for service in services:
        pool.take_back(service)
    assert pool.lend(DOUBLE, {"credit": 0}) is services[0]
    pool.take_back(services[0])
    pool.take_back(pool.lend(DOUBLE, {"threads": 1}))
    assert [service.has_ended for service in services] == [
        number == 1 for number in numbers
    ]
