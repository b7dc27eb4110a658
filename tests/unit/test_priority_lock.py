"""The lock of calls and of the thread that prepares eyes: calls come first."""

import select
import threading
import time

import pytest

from filter_service.filtering.priority_lock import PriorityLock, Signal

LIMIT_S = 20.0


class Working:
    """A thread that works whenever it may."""

    def __init__(self):
        self.lock, self.n_pieces, self.has_ended = PriorityLock(), 0, False
        self.thread = threading.Thread(target=self.run)

    def run(self):
        while not self.has_ended:
            with self.lock.background() as may_work:
                self.n_pieces += may_work
                time.sleep(0.001)

    def await_piece(self):
        """Wait until a whole piece has been done."""
        before, end_s = self.n_pieces, time.monotonic() + LIMIT_S
        while self.n_pieces < before + 2:
            assert time.monotonic() < end_s, "the thread did not work"
            time.sleep(0.001)


@pytest.fixture
def working():
    working = Working()
    working.thread.start()
    yield working
    working.has_ended = True
    working.thread.join(LIMIT_S)


def test_no_piece_is_done_during_a_call(working):
    working.await_piece()
    with working.lock.foreground():
        before = working.n_pieces
        with working.lock.foreground():
            time.sleep(0.01)
        time.sleep(0.01)
        assert working.n_pieces == before
    working.await_piece()


def test_a_call_that_pauses_lets_the_thread_work(working):
    working.await_piece()
    with working.lock.foreground():
        end_s = time.monotonic() + LIMIT_S
        before = working.n_pieces
        while working.n_pieces == before and time.monotonic() < end_s:
            working.lock.pause(0.01)
        assert working.n_pieces > before
        before = working.n_pieces
        time.sleep(0.01)
        assert working.n_pieces == before


def test_calls_without_a_pause_leave_the_thread_a_step_each(working):
    end_s = time.monotonic() + LIMIT_S
    before, n_calls = working.n_pieces, 0
    while working.n_pieces < before + 5 and time.monotonic() < end_s:
        working.lock.let_thread_step(LIMIT_S)
        with working.lock.foreground():
            n_calls += 1
    assert n_calls <= 5 * 20


def test_a_call_within_another_does_not_wait_for_the_thread(working):
    working.await_piece()
    with working.lock.foreground():
        started_s = time.monotonic()
        working.lock.let_thread_step(LIMIT_S)
        assert time.monotonic() < started_s + LIMIT_S / 2


def test_a_signal_can_be_read_while_it_is_set():
    signal = Signal()

    def is_set():
        return bool(select.select([signal], [], [], 0.0)[0])

    assert not is_set()
    for _ in range(2):
        signal.set()
    assert is_set()
    signal.clear()
    assert not is_set()
    signal.close()
    signal.set()  # nothing: no descriptor of another owner is written to
