"""What goes to the GPU and comes from it through mapped memory, byte for byte."""

from contextlib import contextmanager

import numpy as np
import pytest

from filter_service.gl import staging
from filter_service.gl.staging import INITIAL_BYTES, copy_bytes, has_buffer_storage
from tests.numerical.synthetic import Bench, depth_scene, texture

SIZE = {"width_px": 150, "height_px": 101, "vertical_fov_deg": 8.0}


@contextmanager
def using_staging(gpu, wanted):
    """Choose how a context transfers, and then as it does without a choice."""
    try:
        with gpu.context:
            gpu.use_staging(wanted)
        yield
    finally:
        with gpu.context:
            gpu.use_staging(not gpu.is_software)


@pytest.fixture(params=[True, False], ids=["staged", "plain"])
def staged(gpu, request):
    if request.param and not has_buffer_storage(gpu.context):
        pytest.skip("the driver has no buffer storage")
    with using_staging(gpu, request.param):
        yield gpu


@pytest.mark.parametrize("count", [1, 3, 1000, INITIAL_BYTES // 4 + 5])
def test_arrays_come_back_as_they_went(staged, rng, count):
    sent = rng.random((2, count)).astype(np.float32)
    with staged.context:
        buffer = staged.upload("staging test", *sent)
        whole = staged.read(buffer, (2, count), np.float32)
        first, last = np.empty(1, np.float32), np.empty(count, np.float32)
        staged.read_into((buffer, 0, first), (buffer, 4 * count, last))
    assert np.array_equal(whole, sent)
    assert first[0] == sent[0, 0]
    assert np.array_equal(last, sent[1])


@pytest.mark.parametrize("size", [0, 1, 1999, 2000, 4001, 12_345])
@pytest.mark.parametrize("cores", [1, 4, 16])
def test_threads_copy_every_byte_once(monkeypatch, rng, size, cores):
    monkeypatch.setattr(staging, "MIN_PART_BYTES", 1000)
    monkeypatch.setattr(staging, "thread_count", lambda: cores)
    sent = rng.integers(0, 256, size, np.uint8)
    room = np.full(size + 2, 77, np.uint8)
    copy_bytes(room[1:-1], sent)
    assert np.array_equal(room[1:-1], sent)
    assert room[0] == room[-1] == 77


def test_a_copy_that_fails_says_so(monkeypatch):
    monkeypatch.setattr(staging, "MIN_PART_BYTES", 10)
    monkeypatch.setattr(staging, "thread_count", lambda: 4)
    locked = np.zeros(100, np.uint8)
    locked.setflags(write=False)
    with pytest.raises(ValueError, match="read-only"):
        copy_bytes(locked, np.ones(100, np.uint8))


def test_a_full_block_starts_anew_without_losing_what_was_sent(staged, rng):
    sent = [rng.integers(0, 2**32, INITIAL_BYTES // 12, np.uint32) for _ in range(9)]
    with staged.context:
        buffers = [
            staged.upload(f"staging test {n}", words) for n, words in enumerate(sent)
        ]
        for buffer, words in zip(buffers, sent, strict=True):
            assert np.array_equal(staged.read(buffer, words.shape, np.uint32), words)


def test_a_part_of_a_buffer_is_overwritten_and_no_more(staged):
    with staged.context:
        buffer = staged.upload("staging test", np.arange(10, dtype=np.uint32))
        staged.write(buffer, np.array([77, 78], np.uint32), offset=12)
        found = staged.read(buffer, (10,), np.uint32)
    assert found.tolist() == [0, 1, 2, 77, 78, 5, 6, 7, 8, 9]


def test_frames_are_the_same_either_way(gl_engine, rng):
    bench = Bench(gl_engine, {"kind": "preset", "name": "myopia"}, **SIZE)
    view = bench.view(texture(rng, 101, 150), depth_scene())
    pictures = []
    for wanted in (True, False):
        with using_staging(bench.gpu, wanted):
            pictures += [
                bench.render(view, output=output, focus_dpt=0.1).color.tobytes()
                for output in ("linear", "linear16", "srgb8")
            ]
    assert pictures[:3] == pictures[3:]
