"""Flicker and popping along short parts of the paths of `bench_sequence`."""

from dataclasses import replace

import numpy as np
import pytest

from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.bench_sequence import (
    EYES,
    FOCUSING_EYES,
    MAX_POPPING_RATIO,
    MIN_FLICKER_DB,
    VARIANTS,
    SequenceBench,
    path_errors,
)
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.sequences import (
    WINDOWS,
    cropped,
    exact_state,
    flicker,
    path,
)

pytestmark = pytest.mark.tools

FRAMES = 12
FIRST = {"camera": 60, "pupil": 70, "focus": 80, "gaze": 58}
"""Frames at which the parts of the paths start."""


def test_flicker_is_the_change_of_the_error(rng):
    steady = rng.normal(size=(4, 5, 3))
    still = flicker([[steady]] * 6)
    assert still.step_rms.max() == 0.0
    assert still.flicker_db >= 200.0
    assert still.error_rms[0] == pytest.approx(np.sqrt(np.mean(steady**2)))
    moving = flicker([[steady + 0.01 * t] for t in range(6)])
    assert moving.flicker_db == pytest.approx(40.0)
    assert moving.step_999 == pytest.approx(0.01)
    assert moving.jumps() == pytest.approx(1.0)
    steps = np.array([0.0, 1.0, 2.0, 7.0, 8.0, 9.0, 10.0])
    popping = flicker([[steady + 0.001 * step] for step in steps])
    assert popping.jumps().argmax() == 2
    assert popping.jumps().max() == pytest.approx(5.0)
    assert popping.popping_ratio == pytest.approx(5.0)
    quiet = flicker([[steady + 1e-5 * step] for step in steps])
    assert quiet.popping_ratio < 1.0


@pytest.mark.slow
def test_windows_see_what_the_whole_frame_sees():
    moment = path("static", 0, 1)[0]
    whole = dense_reference(
        moment.view,
        exact_state("keratoconus", moment, "on-axis"),
        bins=True,
        kept=False,
    )
    for window in WINDOWS:
        part, inner = cropped(moment.view, window)
        assert part.color.shape[0] > inner[0].stop - inner[0].start
        state = exact_state("keratoconus", replace(moment, view=part), "on-axis")
        seen = dense_reference(part, state, bins=True, kept=False)[inner]
        assert np.abs(seen - whole[window]).max() <= 1e-4


@pytest.fixture
def sequence_bench():
    made = []

    def make(mode, motion):
        eyes = FOCUSING_EYES if motion == "focus" else EYES
        made.append(SequenceBench(NativeRenderer, mode, eyes[mode]))
        return made[-1]

    yield make
    for bench in made:
        bench.release()


@pytest.mark.parametrize("mode", ["on-axis", "dynamic"])
def test_nothing_changes_while_nothing_moves(sequence_bench, mode):
    bench = sequence_bench(mode, "static")
    moments = path("static", 0, 4)
    for variant in (VARIANTS["ours"], VARIANTS["fresh kernels"]):
        colors = [color for color, _ in bench.frames(moments, variant, gaze=False)]
        assert all(np.array_equal(color, colors[0]) for color in colors[1:])


def check_steady(bench, motion, count):
    first = FIRST[motion]
    found = flicker(path_errors(bench, motion, (first, first + count)))
    assert found.flicker_db >= MIN_FLICKER_DB[bench.mode]
    assert found.popping_ratio <= MAX_POPPING_RATIO
    # The frames do differ, and so do their errors.
    assert found.step_rms.min() > 0.0


@pytest.mark.parametrize(
    "motion", [pytest.param("camera", marks=pytest.mark.slow), "pupil", "focus"]
)
def test_errors_change_steadily_along_a_path(sequence_bench, motion):
    check_steady(sequence_bench("on-axis", motion), motion, FRAMES)


@pytest.mark.slow
@pytest.mark.parametrize(
    "motion", [pytest.param("camera", marks=pytest.mark.slow), "pupil", "focus"]
)
def test_errors_change_steadily_over_the_field(sequence_bench, motion):
    check_steady(sequence_bench("dynamic", motion), motion, FRAMES)


@pytest.mark.slow
def test_errors_change_steadily_while_the_gaze_turns(sequence_bench):
    check_steady(sequence_bench("dynamic", "gaze"), "gaze", 4)
