"""Running services that one test uses after the other, each as it was started."""

import json
import re
import time
from contextlib import nullcontext

import numpy as np

from clients.filter_client import FilterClient, RgbdView
from clients.service_process import SERVE_COMMAND, ServiceProcess
from filter_service.errors import ServiceTimeout
from filter_service.messages import tangents_from_fov
from filter_service.service.status_query import query_status

MAX_IDLE = 4
"""Services that wait for the next test; each takes 130 MB or more."""

IDLE_LIMIT_S = 2.0
"""Time in which the sessions, builds and frames of a test have to end."""

LOG_LIMIT_S = 0.2
"""Time in which the log has to say so; it omits lines beyond ten of a kind a second."""

INITIAL = {"n_sessions": 0, "is_ready": True, "is_degraded": False}
INITIAL |= {"is_building": False, "is_filtering": False}


def becomes(is_so, limit_s):
    """Wait until something is so; return whether it is."""
    end_s = time.monotonic() + limit_s
    while not (found := is_so()) and time.monotonic() < end_s:
        time.sleep(0.01)
    return found


class PooledService(ServiceProcess):
    """A service whose log begins with the current test."""

    def __init__(self, key, command, settings, timeout_s):
        self.key, self.timeout_s, self.n_before = key, timeout_s, 0
        super().__init__(settings, command=command, start_timeout_s=timeout_s)
        self._as_started = self._processes_and_settings()

    @property
    def log(self):
        return super().log[self.n_before :]

    def _processes_and_settings(self):
        return self.pids(), self.config_file.read_text()

    def _is_idle(self):
        return INITIAL.items() <= query_status(self.endpoint).items()

    def _is_nobody_away(self):
        """Whether all sessions have ended whose clients left without a word."""
        away = re.findall(r"session (\d+): client disconnected", self.log)
        return set(away) <= set(re.findall(r"session (\d+) ended", self.log))

    def is_reset(self):
        """Wait for the initial state; return whether the service reaches it."""
        try:
            return (
                self.process.poll() is None
                and becomes(self._is_idle, IDLE_LIMIT_S)
                and becomes(self._is_nobody_away, LOG_LIMIT_S)
                and self._processes_and_settings() == self._as_started
            )
        except ServiceTimeout:
            return False

    def load(self):
        """Build an eye; its processes start and load code that all eyes use."""
        is_real = tuple(json.loads(self.key)[0]) == SERVE_COMMAND
        light = np.ones((8, 8, 3), np.float32)
        view = RgbdView(light, light[..., 0].copy(), tangents_from_fov(1.0, 8, 8))
        with FilterClient(self.endpoint, timeout_s=self.timeout_s) as client:
            body = "emmetropia" if is_real else {"kind": "double", "mark": 1}
            client.set_profile(body, views=[view])
            if is_real:
                client.filter(view, pupil_diameter_mm=4.0, focus_dpt=0.0)
        assert becomes(self.is_reset, self.timeout_s)
        self.n_before += len(self.log)

    def end(self):
        """Stop the service, which has to exit cleanly unless a test has ended it."""
        is_running = self.process.poll() is None
        assert not is_running or self.stop(self.timeout_s) == 0
        self.kill()  # removes its folder


class ServicePool:
    """Services by command and settings; at most `MAX_IDLE` wait for the next test.

    ``apart`` is the context in which they start, and end for others: their time is not
    that of the test which happens to be the next.
    """

    def __init__(self, timeout_s, apart=nullcontext):
        self.timeout_s, self.apart = timeout_s, apart
        self._idle = []  # the least recently used first

    def lend(self, command, settings):
        """Return a service that no test is using, as it was started."""
        key = json.dumps([command, settings], sort_keys=True)
        for service in self._idle:
            if service.key == key and service.process.poll() is None:
                self._idle.remove(service)
                service.n_before += len(service.log)
                return service
        with self.apart():
            service = PooledService(key, command, settings, self.timeout_s)
            service.load()
            return service

    def take_back(self, service):
        """Keep a service for the next test, or end it if it is not as it was."""
        if not service.is_reset():
            service.end()
            return
        self._idle.append(service)
        if len(self._idle) > MAX_IDLE:
            with self.apart():
                self._idle.pop(0).end()

    def close(self):
        """End all services."""
        while self._idle:
            self._idle.pop().end()
