"""The worker process: what it imports, and the progress that it reports."""

import os
import socket
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from filter_service.building import worker_handle
from filter_service.building.jobs import (
    BuildDone,
    BuildError,
    BuildJob,
    BuildProgress,
    BuiltStore,
)
from filter_service.building.worker_handle import WorkerHandle
from filter_service.camera import Camera
from filter_service.settings import FilterSettings
from tests.source_tree import ROOT

JOB = BuildJob(None, FilterSettings(), Camera(8, 8, (-0.1, 0.1, 0.1, -0.1)))


def build(job, *, progress, cancelled):
    """Report three stages twice, each sooner after the other than reports may be."""
    for fraction, stage in [(0.0, "eye"), (0.1, "aberrations"), (0.2, "psfs")]:
        progress(fraction, stage)
        progress(fraction + 0.01, stage)
    return BuiltStore(None)


@contextmanager
def started(**options):
    """Start a worker whose builds report three stages."""
    worker = WorkerHandle(f"{__name__}:build", **options)
    worker.start()
    try:
        yield worker
    finally:
        worker.close()


def until(is_so):
    """Wait until a condition is true."""
    deadline_s = time.monotonic() + 20.0
    while not is_so():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def events_until(worker, is_so):
    """Poll until an event or the worker is as asked; return the events."""
    deadline_s, events = time.monotonic() + 20.0, []
    while not is_so(events):
        assert time.monotonic() < deadline_s
        events += worker.poll()
        time.sleep(0.01)
    return events


def test_a_build_that_ended_after_it_was_canceled_costs_no_process():
    """Nobody polled for longer than the grace: the next build was killed for it."""
    with started() as worker:
        worker.cancel_grace_s = 0.0
        events_until(worker, lambda events: worker._is_ready)
        worker.cancel(worker.submit(JOB))
        while not worker._worker.pipe.poll(0.05):
            pass
        time.sleep(0.05)  # the build has sent all its messages
        done = BuildDone(worker.submit(JOB), BuiltStore(None))
        events = events_until(worker, lambda events: done in events)
        assert not [event for event in events if isinstance(event, BuildError)]
        assert worker.n_restarts == 0


def reports_of_build(worker):
    """Run one build; return the progress that it reports."""
    done = BuildDone(worker.submit(JOB), BuiltStore(None))
    events = events_until(worker, lambda events: done in events)
    assert not [event for event in events if isinstance(event, BuildError)]
    progress = [event for event in events if isinstance(event, BuildProgress)]
    return [(event.fraction, event.stage) for event in progress]


def built(*, pause_s=0.0):
    """Run two builds in one worker; return the progress that each reports."""
    with started() as worker:
        reports = [reports_of_build(worker)]
        time.sleep(pause_s)
        reports.append(reports_of_build(worker))
        time.sleep(pause_s)
        assert worker.n_restarts == 0
    return reports


def test_the_worker_imports_from_the_path_and_not_from_the_current_folder(
    tmp_path, monkeypatch
):
    """Entries of the path that are not text are skipped, as imports skip them."""
    (tmp_path / "estimator.py").write_text("raise SystemExit('not ours')\n")
    monkeypatch.chdir(tmp_path)
    elsewhere = [entry for entry in sys.path if entry]
    path = [str(ROOT), *elsewhere, Path("anywhere")]
    monkeypatch.setattr(sys, "path", path)
    assert built()


def test_every_stage_is_reported_once_however_short_it_is():
    expected = [(0.0, "eye"), (0.1, "aberrations"), (0.2, "psfs")]
    assert built() == [expected, expected]


def test_a_default_timeout_of_sockets_does_not_end_the_worker():
    """Such as PsychoPy sets: sockets are then not blocking, on both ends of a pair."""
    socket.setdefaulttimeout(5.0)
    try:
        assert built(pause_s=0.1)
    finally:
        socket.setdefaulttimeout(None)


@pytest.mark.long("a process starts twice")
def test_the_pipe_to_a_new_process_has_another_descriptor():
    """Under the number of the old one, a selector did not notice it."""
    with started() as worker:
        reports_of_build(worker)
        before = worker.file_descriptor
        with socket.socket(fileno=os.dup(before)) as pipe:
            pipe.shutdown(socket.SHUT_RDWR)  # the process exits
        events_until(worker, lambda _: worker.n_restarts)
        assert worker.file_descriptor not in (None, before)
        assert reports_of_build(worker)


@pytest.mark.long("processes start")
def test_the_process_of_a_closed_handle_is_kept_for_the_next_one(monkeypatch):
    def pid_of(keep_s):
        with started(keep_s=keep_s) as worker:
            assert reports_of_build(worker)
            assert worker.n_restarts == 0
            return worker._worker.process.pid

    first = pid_of(60.0)
    assert pid_of(60.0) == first  # and reports of its second build
    assert pid_of(0.0) != first
    kept = worker_handle._kept._worker.process
    assert (kept.pid, kept.poll()) == (first, None)
    monkeypatch.setenv("OCUFILTER_CACHE_DIR", "/another")
    assert pid_of(0.01) != first  # for another environment
    assert kept.poll() is not None
    until(lambda: worker_handle._kept._worker is None)  # its time is over


@pytest.mark.long("a process starts")
def test_a_process_that_is_busy_or_was_killed_is_not_kept():
    with started(keep_s=60.0) as worker:
        events_until(worker, lambda events: worker._is_ready)
        worker.submit(JOB)  # it has not ended when the handle closes
        process = worker._worker.process
    assert process.poll() is not None
    with started(keep_s=60.0) as worker:
        events_until(worker, lambda events: worker._is_ready)
        process = worker._worker.process
    process.kill()
    process.wait()
    with started(keep_s=60.0) as worker:
        assert worker._worker.process is not process
        assert reports_of_build(worker)
    worker_handle._kept.end()
