"""Freed memory goes back to the system."""

import threading
import time
from multiprocessing import Pipe

import numpy as np
import pytest

from filter_service.building import worker
from filter_service.building.jobs import BuildLimits, BuiltStore
from filter_service.building.worker_handle import InlineWorker
from filter_service.filtering import builder as builder_module
from filter_service.filtering.builder import Builder
from filter_service.heap import resident_memory_mb, trim_heap
from tests.end_to_end.doubles import EngineDouble

CHUNK_BYTES, COUNT = 50_000, 800


def test_trimming_returns_memory_below_a_block_that_is_in_use():
    chunks = [np.ones(CHUNK_BYTES, np.uint8) for _ in range(COUNT)]
    last = chunks.pop()
    chunks.clear()
    before_mb = resident_memory_mb()
    trim_heap()
    freed_mb = before_mb - resident_memory_mb()
    assert freed_mb > 0.5 * COUNT * CHUNK_BYTES / 1e6
    assert last.all()


def test_the_heap_is_trimmed_once_after_stores_were_dropped(monkeypatch):
    trimmed = []
    monkeypatch.setattr(builder_module, "trim_heap", lambda: trimmed.append(1))
    builder = Builder(InlineWorker(), EngineDouble(0.0), BuildLimits())
    now_s = time.monotonic()
    monkeypatch.setattr(builder_module.time, "monotonic", lambda: now_s)
    try:
        builder._released.append(object())
        while builder._drop_released():
            builder._trim_heap()
        assert not trimmed, "frames still use the memory of the new eye"
        now_s += 2.0 * builder_module.TRIM_AFTER_S
        builder._trim_heap()
        builder._trim_heap()
    finally:
        builder.close()
    assert trimmed == [1]


def _build_nothing(job, *, progress, cancelled):
    return BuiltStore(job)


@pytest.fixture
def build_worker(monkeypatch):
    """Yield the end of the pipe to a worker, and an event that trimming sets."""
    trimmed = threading.Event()
    monkeypatch.setattr(worker, "trim_heap", trimmed.set)
    monkeypatch.setattr(worker, "TRIM_AFTER_S", 60.0)
    monkeypatch.setattr(worker, "_import_function", lambda name: _build_nothing)
    monkeypatch.setattr(worker, "configure_logging", lambda name: None)
    monkeypatch.setattr(worker.signal, "signal", lambda *handler: None)
    ours, theirs = Pipe()
    thread = threading.Thread(target=worker.serve_builds, args=(theirs, ""))
    thread.start()
    assert ours.recv() == ("ready",)
    yield ours, trimmed
    ours.close()
    thread.join()


def test_the_build_worker_trims_its_heap_once_it_is_idle(monkeypatch, build_worker):
    ours, trimmed = build_worker
    monkeypatch.setattr(worker, "TRIM_AFTER_S", 0.01)
    ours.send(("build", 1, None))
    assert ours.recv()[:2] == ("result", 1)
    assert trimmed.wait(10.0)


def test_the_build_worker_trims_its_heap_before_it_plans_ahead(
    monkeypatch, build_worker
):
    ours, trimmed = build_worker
    count = worker.URGENT_PARTS + 2
    parts = [("part", 1, k) for k in range(count)]
    monkeypatch.setattr(worker, "_parts_ahead", lambda *built: iter(parts))
    ours.send(("build", 1, None))
    assert ours.recv()[:2] == ("result", 1)
    assert [ours.recv() for _ in parts] == parts
    assert trimmed.is_set()
