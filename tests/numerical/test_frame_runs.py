"""Frames of a changing state: no two alike, made anew, and the last to be judged."""

import numpy as np
import pytest

from tests.benchmarks.frame_runs import CHANGE, states_towards, timed_frames
from tests.numerical.synthetic import Bench, texture

pytestmark = pytest.mark.tools

SIZE = {"width_px": 64, "height_px": 40, "vertical_fov_deg": 30.0}
WIDE = {"pupil_range_mm": (3.0, 5.0), "focus_range_dpt": (0.0, 2.0)}
POINT = {"pupil_range_mm": (5.0, 5.0), "focus_range_dpt": (0.5, 0.5)}
STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}
OBJECTS = {"object_range_dpt": (0.0, 2.0)}


def bench_of(engine, **spec):
    profile = {"kind": "preset", "name": "myopia"}
    return Bench(engine, profile, **SIZE, **spec, **OBJECTS)


def test_states_come_nearer_within_the_range_and_none_comes_twice(engine):
    spec = bench_of(engine, **WIDE).spec
    for pupil_mm, focus_dpt in ((5.0, 0.5), (3.0, 2.0), (4.2, 0.0)):
        states = states_towards(spec, pupil_mm, focus_dpt, 5)
        pupils, foci = (
            np.array([state[name] for state in states])
            for name in ("pupil_diameter_mm", "focus_dpt")
        )
        assert (pupils[-1], foci[-1]) == (pupil_mm, focus_dpt)
        for values, (low, high) in zip((pupils, foci), WIDE.values(), strict=True):
            assert low <= values.min()
            assert values.max() <= high
            assert np.all(np.diff(np.abs(values - values[-1])) < 0.0)
            assert np.abs(values - values[-1]).max() <= CHANGE


def test_gaze_changes_where_it_was_prepared(engine):
    field = {"mode": "dynamic", "tolerance": "loose", **WIDE}
    spec = bench_of(engine, **field).spec
    assert "gaze_deg" not in states_towards(spec, 5.0, 0.5, 3)[0]
    turning = spec.with_settings(gaze_range_deg=(5.0, 3.0))
    gazes_deg = [s["gaze_deg"] for s in states_towards(turning, 5.0, 0.5, 3)]
    assert len(set(gazes_deg)) == 3
    assert gazes_deg[-1] == turning.settings.gaze_deg


@pytest.mark.parametrize("ranges", [WIDE, POINT])
def test_kernels_are_made_anew_for_every_frame(engine, rng, ranges):
    bench = bench_of(engine, **ranges)
    view = bench.view(texture(rng, 40, 64), 1.0)
    frames, times_ms = timed_frames(
        bench.renderer, view, bench.handle, **STATE, repeats=3
    )
    assert len(frames) == len(times_ms) == 3
    assert all(frame.stage_times_ms["psf_blend_ms"] > 0.0 for frame in frames)
    alone = bench.render(view, **STATE)
    assert np.array_equal(frames[-1].color, alone.color)
    assert frames[-1].pupil_diameter_mm == STATE["pupil_diameter_mm"]
