"""Buffers of the native engine take memory as frames use them, and give it back."""

import ctypes

import numpy as np
import pytest

from filter_service.heap import resident_memory_mb
from filter_service.rendering.native.frame_arrays import TRIM_INTERVAL, Arrays

LARGE, SMALL = 12_000_000, 1_000_000


def use(arrays: Arrays, n_bytes: int) -> int:
    """Write to all bytes of an array, as a frame does."""
    address = arrays.address("texels", n_bytes, np.uint8)
    ctypes.memset(address, 7, n_bytes)
    arrays.end_frame()
    return address


def test_an_array_takes_memory_only_where_it_is_written():
    arrays = Arrays()
    before_mb = resident_memory_mb()
    address = arrays.address("fragments", LARGE, np.uint8)
    for start in range(0, LARGE, LARGE // 8):
        ctypes.memset(address + start, 7, 4096)
    assert resident_memory_mb() - before_mb < 0.2 * LARGE / 1e6


@pytest.mark.parametrize("is_dense", [True, False])
def test_memory_that_a_smaller_frame_does_not_need_is_returned(is_dense):
    arrays = Arrays(is_dense=is_dense)
    address = use(arrays, LARGE)
    before_mb = resident_memory_mb()
    arrays.restart()
    for _ in range(TRIM_INTERVAL):
        assert use(arrays, SMALL) == address, "the array was not replaced"
    assert before_mb - resident_memory_mb() > 0.8 * (LARGE - SMALL) / 1e6
    assert arrays.memory_mb == pytest.approx(SMALL / 1e6, rel=0.01)
    assert set(ctypes.string_at(address, SMALL)) == {7}, "the next frame may reuse it"


def test_memory_of_frames_that_differ_is_kept():
    arrays = Arrays()
    for k in range(2 * TRIM_INTERVAL):
        use(arrays, (LARGE, SMALL)[k % 2])
    assert arrays.memory_mb == pytest.approx(LARGE / 1e6, rel=0.01)


def test_an_array_that_does_not_fit_is_an_error_of_memory():
    with pytest.raises(MemoryError, match="MB for a buffer of frames"):
        Arrays().address("texels", 2**60, np.uint8)
