"""A store's way from the worker to the GPU: shared memory, slices, polite threads."""

import gc
import os
import sys
import threading
import time

import numpy as np
import pytest

from filter_service.building.shared_buffers import map_shared, write_shared
from filter_service.building.worker import _run_nicely
from filter_service.filtering.upload import Upload


class Loaded:
    def __init__(self):
        self.n_released = 0

    def release(self):
        self.n_released += 1


def steps(count, loaded, log, *, slice_s=0.0):
    try:
        for k in range(count):
            time.sleep(slice_s)
            log.append(k)
            yield None
        yield loaded
    except GeneratorExit:
        log.append("freed")
        raise


def test_arrays_arrive_as_they_were_and_outlive_their_file():
    arrays = [
        np.arange(100_001, dtype=np.uint16),
        np.zeros(0),
        np.linspace(0, 1, 7).reshape(7, 1),
    ]
    descriptor = write_shared([memoryview(a).cast("B") for a in arrays if a.size])
    buffers = map_shared(descriptor, [a.nbytes for a in arrays if a.size])
    os.close(descriptor)
    gc.collect()
    np.testing.assert_array_equal(np.frombuffer(buffers[0], np.uint16), arrays[0])
    found = np.frombuffer(buffers[1], np.float64)
    np.testing.assert_array_equal(found.reshape(7, 1), arrays[2])
    assert found.flags.writeable, "numba compiles anew for arrays that are not"
    assert found.ctypes.data % 64 == 0
    assert [len(b) for b in map_shared(write_shared([]), [])] == []


def test_an_upload_keeps_to_its_time_but_always_gets_on():
    log, loaded = [], Loaded()
    upload = Upload(steps(5, loaded, log, slice_s=0.01))
    assert not upload.advance(time.monotonic() - 1.0)
    assert log == [0]
    assert not upload.advance(time.monotonic() + 0.015)
    assert 2 <= len(log) <= 3
    assert upload.advance(time.monotonic() + 10.0)
    assert upload.loaded is loaded
    assert log == [0, 1, 2, 3, 4]


def test_an_upload_that_is_given_up_frees_what_it_has():
    log, loaded = [], Loaded()
    upload = Upload(steps(5, loaded, log))
    upload.advance(time.monotonic() - 1.0)
    upload.give_up()
    assert log == [0, "freed"]
    whole = Upload(steps(1, loaded, log))
    whole.advance(time.monotonic() + 10.0)
    whole.give_up()
    assert loaded.n_released == 1


@pytest.mark.skipif(sys.platform != "linux", reason="niceness of threads is Linux's")
def test_niceness_is_for_the_work_alone_and_its_threads():
    found = []

    def note():
        found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    def work():
        note()
        helper = threading.Thread(target=note)
        helper.start()
        helper.join()

    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    _run_nicely(before + 3, work)
    note()
    assert found == [before + 3, before + 3, before]


def test_what_fails_in_the_nice_thread_is_told():
    def work():
        raise ZeroDivisionError("told")

    with pytest.raises(ZeroDivisionError, match="told"):
        _run_nicely(0, work)
