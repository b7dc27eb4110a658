"""How long building PSFs holds a GPU, on one that is counted and not timed."""

import numpy as np
import pytest

from filter_service.psfs.gpu_build_pace import HOLD_S, Pace


class Device:
    """Takes so long for each unit of work, and lets its clock run when waited for."""

    def __init__(self, **seconds_of):
        self.seconds_of = seconds_of
        self.now_s = 0.0
        self.queued_s = 0.0
        self.holds_s = []

    def clock(self):
        return self.now_s

    def queue(self, kind, works):
        self.queued_s += self.seconds_of[kind] * float(np.sum(works))

    def finish(self):
        self.holds_s.append(self.queued_s)
        self.now_s, self.queued_s = self.now_s + self.queued_s, 0.0

    def build(self, pace, kind, works):
        done = []
        for first, count in pace.parts(kind, works, self.finish):
            assert count >= 1
            done += range(first, first + count)
            self.queue(kind, works[first : first + count])
        assert done == list(range(len(works))), "each once, in their order"


def paced(device, **options):
    return Pace(clock=device.clock, **options)


def test_no_batch_is_longer_than_it_may_be():
    device = Device(waves=2e-5, rays=1e-6)
    pace = paced(device)
    rng = np.random.default_rng(0)
    for _ in range(3):
        device.build(pace, "waves", np.ones(1000))
        device.build(pace, "rays", rng.uniform(10.0, 400.0, 1000))
    pace.flush(device.finish)
    assert max(device.holds_s) <= HOLD_S + 1e-9
    assert sum(device.holds_s) == pytest.approx(device.now_s)
    # All but probes and what was cut short are as full as planned.
    assert np.median(device.holds_s) > 0.6 * HOLD_S
    assert pace.n_batches == len(device.holds_s)
    assert len(pace.holds_s) == pace.n_batches - 2, "but the first of each kind"
    assert max(pace.holds_s) <= HOLD_S + 1e-9


def test_small_chunks_of_several_kinds_share_a_batch():
    device = Device(a=1e-5, b=2e-5)
    pace = paced(device)
    for _ in range(100):
        for kind in "ab":
            device.build(pace, kind, np.ones(4))
    pace.flush(device.finish)
    assert device.now_s == pytest.approx(100 * 4 * 3e-5)
    assert len(device.holds_s) < 20 and max(device.holds_s) <= HOLD_S + 1e-9


def test_a_psf_that_takes_longer_is_alone():
    device = Device(waves=1.0)
    pace = paced(device)
    device.build(pace, "waves", np.array([0.001, 0.001, 0.5, 0.001, 0.001]))
    pace.flush(device.finish)
    assert sorted(device.holds_s)[-1] == pytest.approx(0.5)
    assert sorted(device.holds_s)[-2] <= HOLD_S


def test_a_device_that_becomes_slower_is_learnt():
    device = Device(waves=1e-5)
    pace = paced(device)
    device.build(pace, "waves", np.ones(1000))
    device.seconds_of["waves"] = 8e-5
    before = len(device.holds_s)
    device.build(pace, "waves", np.ones(5000))
    assert max(device.holds_s[before + 8 :]) <= HOLD_S


def test_what_took_long_once_is_forgotten():
    """The first batch of a kind compiles its shaders."""
    device = Device(waves=1.0)
    pace = paced(device)
    device.build(pace, "waves", np.ones(1))
    device.seconds_of["waves"] = 1e-5
    device.build(pace, "waves", np.ones(20_000))
    assert np.median(device.holds_s[-20:]) > 0.6 * HOLD_S


def test_a_pace_without_an_end_never_waits():
    device = Device(waves=1.0)
    pace = paced(device, hold_s=1e9)
    device.build(pace, "waves", np.ones(64))
    device.build(pace, "waves", np.ones(64))
    pace.flush(device.finish)
    assert len(device.holds_s) == 2  # to know the kind, and the rest
