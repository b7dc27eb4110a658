"""Freed memory goes back to the system."""

import time

import numpy as np

from filter_service.building.jobs import BuildLimits
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
