"""What the worker prepares ahead of its first build: awaited, said, done without."""

import threading

import pytest

from filter_service.building import background_warm_up
from filter_service.building.background_warm_up import COMPILING_STAGE, BackgroundWarmUp
from filter_service.errors import BuildCancelled


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(background_warm_up, "QUIET_S", 0.02)
    monkeypatch.setattr(background_warm_up, "POLL_S", 0.01)


@pytest.fixture
def release():
    event = threading.Event()
    yield event
    event.set()


def test_a_build_waits_and_says_why(release, caplog):
    caplog.set_level("INFO")
    start, said = BackgroundWarmUp(release.wait), []

    def progress(fraction, stage):
        said.append((fraction, stage))
        release.set()

    start.wait(progress, lambda: False)
    assert said[0] == (0.0, COMPILING_STAGE)
    assert "the result is cached" in caplog.text


def test_what_takes_no_progress_waits_for_nothing(release):
    said = []
    progress = BackgroundWarmUp(release.wait).wrap_progress(
        lambda *of: said.append(of), lambda: 0
    )
    assert not said
    release.set()
    progress(0.5, "eye")
    progress(0.6, "psfs")
    assert said == [(0.5, "eye"), (0.6, "psfs")]


def test_what_is_there_already_is_not_spoken_of(caplog):
    caplog.set_level("INFO")
    said = []
    BackgroundWarmUp(lambda: None).wait(lambda *of: said.append(of), lambda: False)
    assert not said
    assert not caplog.text


def test_a_cancelled_build_does_not_wait(release):
    with pytest.raises(BuildCancelled):
        BackgroundWarmUp(release.wait).wait(lambda *_: None, lambda: True)


def test_a_head_start_that_fails_stops_no_build(caplog):
    def fail():
        raise OSError("disk full")

    BackgroundWarmUp(fail).wait(lambda *_: None, lambda: False)
    assert "the warm-up for builds failed" in caplog.text
    assert "disk full" in caplog.text
