"""Turns of calls and of the thread that prepares eyes: calls go first."""

import select
import threading
import time

import pytest

from filter_service.filtering.turns import Signal, Turns

LIMIT_S = 20.0


class Working:
    """A thread that takes every turn that it gets."""

    def __init__(self):
        self.turns, self.n_pieces, self.has_ended = Turns(), 0, False
        self.thread = threading.Thread(target=self.run)

    def run(self):
        while not self.has_ended:
            with self.turns.work() as has_turn:
                self.n_pieces += has_turn
                time.sleep(0.001)

    def await_piece(self):
        """Wait until a whole piece has been done."""
        before, end_s = self.n_pieces, time.monotonic() + LIMIT_S
        while self.n_pieces < before + 2:
            assert time.monotonic() < end_s, "the thread got no turn"
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
    with working.turns.call():
        before = working.n_pieces
        with working.turns.call():
            time.sleep(0.01)
        time.sleep(0.01)
        assert working.n_pieces == before
    working.await_piece()


def test_a_call_that_pauses_lends_its_turn(working):
    working.await_piece()
    with working.turns.call():
        end_s = time.monotonic() + LIMIT_S
        before = working.n_pieces
        while working.n_pieces == before and time.monotonic() < end_s:
            working.turns.lend(0.01)
        assert working.n_pieces > before
        before = working.n_pieces
        time.sleep(0.01)
        assert working.n_pieces == before


def test_calls_that_follow_each_other_wait_for_what_they_owe(working):
    with working.turns.call():
        before = working.n_pieces
        working.turns.owe(0.005)
    working.turns.wait_until_paid(LIMIT_S)
    assert working.n_pieces > before


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
