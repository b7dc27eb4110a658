"""Waits of the Python API: they end where work hangs, never while it advances."""

import io
import os
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import rich.progress  # noqa: F401  (before a test's time counts)

from clients import service_process, streaming
from clients.filter_client import FilterClient, FilteredFrame
from clients.service_process import ServiceProcess
from filter_service import Camera, EyeFilter
from filter_service import progress as progress_module
from filter_service import waiting as waiting_module
from filter_service.building import worker_handle
from filter_service.building.jobs import (
    BuildDone,
    BuildError,
    BuildLimits,
    BuildProgress,
    BuiltStore,
)
from filter_service.building.worker_handle import WorkerHandle
from filter_service.errors import BuildFailed, ServiceTimeout
from filter_service.filtering import eye_filter as eye_filter_module
from filter_service.filtering.builder import Builder
from filter_service.filtering.psf_work import BATCH
from filter_service.messages import Accepted, Dropped, Progress, Ready, ResultView
from filter_service.progress import Progress as ProgressBars
from filter_service.waiting import Wait
from tests.end_to_end.doubles import EngineDouble, ProfileDouble

TIMEOUT_S = 1.0
STEP_S = 0.6
"""Time between two signs of the work, so that two of them exceed the timeout."""

CAMERA = Camera.from_fov(60.0, width_px=16, height_px=8)
FRACTIONS = (0.1, 0.2, 0.3, 0.4, 0.5)


class Clock:
    """Replaces `time` in a module."""

    def __init__(self):
        self.now_s = self.began_s = 100.0

    def monotonic(self):
        return self.now_s

    @property
    def n_steps(self):
        return round((self.now_s - self.began_s) / STEP_S)


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(waiting_module, "time", clock)
    monkeypatch.setattr(eye_filter_module, "WAIT_SLICE_S", 0.0)
    return clock


def test_the_limit_is_the_time_since_the_last_change_of_the_mark(clock):
    with Wait("Digging", TIMEOUT_S) as wait:
        for mark in range(5):
            clock.now_s += STEP_S
            wait.update(mark)
            assert wait.remaining_s == pytest.approx(TIMEOUT_S)
        for _ in range(2):
            clock.now_s += STEP_S
            wait.update(4)
        assert wait.remaining_s == pytest.approx(TIMEOUT_S - 2 * STEP_S)


# In this process


class WorkerDouble:
    """A worker whose events come one at each poll, `STEP_S` after the other."""

    has_process = False
    file_descriptor = None

    def __init__(self, clock, events):
        self.clock, self.events = clock, iter(())
        self.later = events

    def submit(self, job):
        self.events = iter(self.later)
        return 1

    def cancel(self, ticket):
        pass

    def close(self):
        pass

    def poll(self):
        self.clock.now_s += STEP_S
        return [event for event in [next(self.events, None)] if event is not None]


def eye_of(clock, events):
    """Return a filter whose eye is built with these events, without a terminal."""
    builder = Builder(WorkerDouble(clock, events), EngineDouble(0.0), BuildLimits())
    return EyeFilter(ProfileDouble({"mark": 1}), CAMERA, builder=builder)


def frame_of(eye_filter):
    color, depth_m = np.zeros((8, 16, 3), np.uint8), np.ones((8, 16), np.float32)
    state = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
    return eye_filter.filter(color, depth_m, timeout_s=TIMEOUT_S, **state)


CALLS = {
    "wait": lambda eye_filter: eye_filter.wait(TIMEOUT_S),
    "filter": frame_of,
}


@pytest.mark.parametrize("call", CALLS)
def test_a_build_that_advances_never_ends_in_a_timeout(clock, call):
    events = [BuildProgress(1, fraction, "eye") for fraction in FRACTIONS]
    events += [BuildProgress(1, FRACTIONS[-1], stage) for stage in ("plan", "psfs")]
    events += [BuildError(1, BuildFailed("the end"))]
    with eye_of(clock, events) as eye_filter:
        with pytest.raises(BuildFailed, match="the end"):
            CALLS[call](eye_filter)


@pytest.mark.parametrize("call", CALLS)
def test_a_build_that_repeats_its_progress_ends_in_a_timeout(clock, call):
    events = [BuildProgress(1, 0.1, "eye")] * 100
    with eye_of(clock, events) as eye_filter:
        with pytest.raises(ServiceTimeout):
            CALLS[call](eye_filter)
    assert clock.n_steps < 6


class StoreDouble:
    """A store that computes one batch of five in a slice of time, and may lose it."""

    memory_mb = 0.0
    camera = CAMERA
    is_released = False

    def __init__(self, clock, is_evicted):
        self.clock, self.is_evicted = clock, is_evicted
        self.computed_count = 0

    def missing_psfs(self, use, state=None):
        return np.arange(BATCH * self.computed_count, BATCH * 5)

    def not_computed(self, psfs):
        return psfs

    def computed(self, psfs, *, thread_count):
        self.clock.now_s += STEP_S
        return psfs

    def add(self, found):
        assert found.size == BATCH
        self.computed_count = 1 if self.is_evicted else self.computed_count + 1

    def release(self):
        pass


@pytest.mark.parametrize("is_evicted", [False, True])
def test_psfs_advance_a_wait_unless_they_are_computed_again(
    clock, monkeypatch, is_evicted
):
    monkeypatch.setattr(EngineDouble, "load", lambda self, store: store)
    store = StoreDouble(clock, is_evicted)
    with eye_of(clock, [BuildDone(1, BuiltStore(store))]) as eye_filter:
        if is_evicted:
            with pytest.raises(ServiceTimeout):
                eye_filter.wait(TIMEOUT_S)
        else:
            assert eye_filter.wait(TIMEOUT_S).psf_count == 5


def test_a_worker_kills_a_build_that_has_not_advanced_only(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(worker_handle, "time", clock)
    killed = []
    worker = SimpleNamespace(
        process=SimpleNamespace(pid=os.getpid()), kill=lambda: killed.append(True)
    )
    handle = WorkerHandle(build_limit_s=TIMEOUT_S)
    handle._running, handle._advanced_s = 1, clock.now_s
    for fraction in (*FRACTIONS, FRACTIONS[-1], FRACTIONS[-1]):
        assert not killed
        clock.now_s += STEP_S
        pipe = SimpleNamespace(recv=lambda f=fraction: ("progress", 1, f, "eye"))
        handle._receive(pipe, [])
        handle._watch(worker, clock.now_s)
    assert killed


# With a service


class Connected:
    """A client whose service sends one message at each pump, `STEP_S` after another."""

    def __init__(self, clock, messages):
        self.clock, self.messages = clock, iter(messages)
        self.client = FilterClient("tcp://127.0.0.1:9")
        self.link = self.client._link
        self.link.welcome = SimpleNamespace(limits=None)
        self.link.pump = self.pump

    def pump(self, timeout_s):
        if not self.link.profiles:
            return
        self.clock.now_s += STEP_S
        message = next(self.messages, None)
        if message is not None:
            self.link._handle(message)

    def set_profile(self):
        return self.client.set_profile("myopia", views=[CAMERA], timeout_s=TIMEOUT_S)

    def filter(self):
        self.link.profiles["both"] = SimpleNamespace(profile_id=0)
        return self.client._link.await_filtered(7, lambda: 7, TIMEOUT_S)


@pytest.fixture
def connected(clock):
    made = []

    def connect(*messages):
        made.append(Connected(clock, messages))
        return made[-1]

    yield connect
    for each in made:
        each.link.welcome = None
        each.client.close()


ACCEPTED = Accepted(0, 1, is_building=True, n_cameras=1)
READY = Ready(0, 1, build_ms=1.0, psf_count=1, memory_mb=1.0, pixel_pitch_mrad=1.0)
PROGRESS = [Progress(0, 1, "eye", fraction) for fraction in FRACTIONS]
FRAME = FilteredFrame(
    frame_id=7,
    profile_id=0,
    generation=1,
    views=(ResultView(16, 8),),
    pupil_diameter_mm=4.0,
    focus_dpt=0.0,
    missing_depth_count=0,
    clamped_depth_count=0,
    total_ms=1.0,
    stage_times_ms={},
)


def test_a_client_waits_for_an_eye_while_it_advances(connected):
    assert connected(ACCEPTED, *PROGRESS, READY).set_profile() is READY


def test_a_client_does_not_wait_for_an_eye_that_hangs(connected, clock):
    with pytest.raises(ServiceTimeout, match="profile 0 to become ready"):
        connected(ACCEPTED, *PROGRESS[:1] * 100).set_profile()
    assert clock.n_steps < 8


def test_a_service_that_restarts_again_and_again_ends_in_a_timeout(connected, clock):
    with pytest.raises(ServiceTimeout):
        connected(*[ACCEPTED, *PROGRESS[:2]] * 100).set_profile()
    assert clock.n_steps < 8


def test_a_frame_waits_for_its_eye_while_that_advances(connected):
    preparing, dropped = Dropped(7, "preparing"), Dropped(7, "extending")
    service = connected(*PROGRESS, READY)
    service.link._events = [preparing]
    sent = iter([[], [dropped], [dropped], [dropped], [FRAME]])

    def submit():
        service.link._events += next(sent)
        return 7

    service.link.profiles["both"] = SimpleNamespace(profile_id=0)
    assert service.client._link.await_filtered(submit(), submit, TIMEOUT_S) is FRAME


@pytest.mark.parametrize(
    "drops",
    [
        pytest.param([Dropped(7, "superseded")], id="that only drops it"),
        pytest.param(
            [Dropped(7, "extending"), Dropped(7, "connection_lost")],
            id="that ends after each",
        ),
    ],
)
def test_a_frame_does_not_wait_for_a_service(connected, clock, drops):
    service = connected()
    answers = iter(drops * 100)

    def submit():
        clock.now_s += STEP_S
        service.link._events.append(next(answers))
        return 7

    with pytest.raises(ServiceTimeout, match="the service dropped it"):
        service.client._link.await_filtered(submit(), submit, TIMEOUT_S)
    assert clock.n_steps < 6


def test_a_message_that_came_while_the_program_slept_is_read(connected, clock):
    service = connected(FRAME)
    service.link._handle = lambda message: service.link._events.append(message)
    service.link.profiles["both"] = SimpleNamespace(profile_id=0)

    def submit():
        clock.now_s += 10.0 * TIMEOUT_S
        return 7

    assert service.client._link.await_filtered(submit(), submit, TIMEOUT_S) is FRAME


@pytest.mark.parametrize("hangs", [False, True])
def test_a_stream_waits_for_a_new_eye_while_it_advances(monkeypatch, hangs):
    clock = Clock()
    monkeypatch.setattr(streaming, "time", clock)
    monkeypatch.setattr(streaming, "_BUILD_LIMIT_S", TIMEOUT_S)
    messages = iter([*(PROGRESS[:1] * 5 if hangs else PROGRESS), READY])

    def poll(timeout_s):
        clock.now_s += STEP_S
        return [next(messages)]

    client = SimpleNamespace(
        set_profile=lambda *args, **values: ACCEPTED,
        poll=poll,
        n_unanswered=0,
        timeout_s=1.0,
        welcome=True,
    )
    frames = [SimpleNamespace(view=None)]
    arguments = {"settings": {}, "frames": frames, "has_eye": False}
    if hangs:
        with pytest.raises(ServiceTimeout, match="has not advanced for 1 s"):
            streaming.change_eye(client, {}, **arguments)
    else:
        assert streaming.change_eye(client, {}, **arguments)["generation"] == 1


@pytest.mark.parametrize("hangs", [False, True])
def test_a_service_may_take_long_to_start_while_it_writes(monkeypatch, clock, hangs):
    command = [sys.executable, "-S", "-c", "import time; time.sleep(60)"]
    service = ServiceProcess(command=command, wait=False)
    steps = iter(range(5))

    def sleep(seconds):
        clock.now_s += STEP_S
        if hangs:
            return
        with service._log_file.open("a") as log:
            log.write("compiling\n")
        if next(steps, None) is None:
            service._ready_file.write_text("tcp://127.0.0.1:9\n")

    monkeypatch.setattr(service_process, "time", SimpleNamespace(sleep=sleep))
    try:
        if hangs:
            with pytest.raises(RuntimeError, match="wrote nothing for 1 s"):
                service.await_ready(TIMEOUT_S)
        else:
            service.await_ready(TIMEOUT_S)
            assert service.endpoint == "tcp://127.0.0.1:9"
    finally:
        service.kill()


# The bar


class Terminal(io.StringIO):
    """A stream that is a terminal, and tells when something has been written."""

    def __init__(self):
        super().__init__()
        self.is_written = threading.Event()

    def isatty(self):
        self.tell()  # raises if it is closed, as a file does
        return True

    def write(self, text):
        written = super().write(text)
        if "Digging" in text:
            self.is_written.set()
        return written


@pytest.fixture
def terminal(monkeypatch):
    terminal = Terminal()
    for module in (waiting_module, progress_module):
        monkeypatch.setattr(module, "sys", SimpleNamespace(stderr=terminal))
    monkeypatch.setattr(waiting_module, "_watcher", waiting_module._Watcher())
    monkeypatch.setattr(waiting_module, "SHOWN_AFTER_S", 0.01)
    monkeypatch.setattr(waiting_module, "WATCH_S", 0.01)
    monkeypatch.delenv(waiting_module.PROGRESS_VARIABLE, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    return terminal


def test_a_long_wait_on_a_terminal_shows_a_bar_and_removes_it(terminal):
    with Wait("Digging") as wait:
        assert terminal.is_written.wait(20.0)
        terminal.is_written.clear()
        wait.update(1, 0.4, "psfs")
        assert terminal.is_written.wait(20.0)
    text = terminal.getvalue()
    assert "Digging: PSFs" in text
    assert "40 %" in text
    assert text.rsplit("Digging", 1)[1].count("\x1b[2K") >= 1, "the line stays"
    assert not text.endswith("\n")


def is_shown(**options):
    """Return whether a wait that takes long shows a bar."""
    with Wait("Digging", **options) as wait:
        while wait in waiting_module._watcher.waits:
            time.sleep(0.005)
        return wait._bar is not None


def test_only_a_wait_that_nobody_else_reports_shows_a_bar(terminal, monkeypatch):
    assert is_shown()
    assert not is_shown(is_shown=False)
    with ProgressBars(quiet=True):
        assert not is_shown()
    with Wait("Outer") as outer:
        while outer._bar is None:
            time.sleep(0.005)
        assert not is_shown()
    assert is_shown()
    with monkeypatch.context() as context:
        context.setenv("OCUFILTER_PROGRESS", "0")
        assert not is_shown()
    terminal.isatty = lambda: False
    assert not is_shown()
    del terminal.isatty
    terminal.close()
    assert not is_shown()
    monkeypatch.setattr(waiting_module, "sys", SimpleNamespace(stderr=None))
    assert not is_shown()


def test_a_short_wait_writes_nothing(terminal, monkeypatch):
    monkeypatch.setattr(waiting_module, "SHOWN_AFTER_S", 60.0)
    with Wait("Digging") as wait:
        wait.update(1, 0.5, "psfs")
    assert not waiting_module._watcher.waits
    assert terminal.getvalue() == ""


def test_a_callback_of_the_caller_replaces_the_bar(terminal, clock, monkeypatch):
    shown = []
    made = Wait.__init__

    def record(self, title, *args, is_shown=True):
        shown.append(is_shown)
        made(self, title, *args, is_shown=False)

    monkeypatch.setattr(Wait, "__init__", record)
    builder = Builder(WorkerDouble(clock, []), EngineDouble(0.0), BuildLimits())
    for on_event in (None, lambda event: None):
        profile = ProfileDouble({"mark": 1})
        with EyeFilter(profile, CAMERA, builder=builder, on_event=on_event) as made_eye:
            with pytest.raises(ServiceTimeout):
                made_eye.wait(TIMEOUT_S)
    assert shown == [True, False]


def test_a_wait_without_a_terminal_starts_no_thread(terminal):
    terminal.isatty = lambda: False
    with Wait("Digging"):
        assert waiting_module._watcher._thread is None
