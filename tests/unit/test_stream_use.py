"""Which part of an eye a stream of frames uses, and will use."""

import pytest

from filter_service.building.used_ranges import UsedRanges
from filter_service.filtering.stream_use import (
    HISTORY_S,
    FrameUse,
    StreamUse,
)
from filter_service.settings import FilterSettings

SETTINGS = FilterSettings()
SCENE = (0.1, 1.4)


def stream(states, *, every_s=0.1):
    """A stream of (pupil, focus) at even times."""
    use = StreamUse()
    for k, (pupil_mm, focus_dpt) in enumerate(states):
        use.note(FrameUse(k * every_s, pupil_mm, focus_dpt, SCENE))
    return use


def test_before_any_frame_a_daylight_eye_is_prepared_for():
    wanted = StreamUse().wanted(1.0, SETTINGS)
    assert wanted.pupil_mm == (3.5, 4.5)
    assert wanted.focus_dpt[0] == 0.0
    assert StreamUse().now is None and StreamUse().ahead(1.0) is None
    assert not StreamUse().leaves(wanted, 1.0, SETTINGS)


def test_a_still_stream_wants_little_and_stays_in_it():
    use = stream([(4.1, 0.0)] * 30)
    wanted = use.wanted(1.0, SETTINGS)
    assert wanted.pupil_mm == (3.5, 4.5)
    assert wanted.focus_dpt == (0.0, 0.5)
    assert wanted.object_dpt == (0.0, 2.0)
    assert not use.leaves(wanted, 1.0, SETTINGS)


def test_a_breathing_pupil_stays_in_what_is_prepared():
    use = stream([(4.0 + 0.1 * (-1) ** k, 1.0) for k in range(60)])
    assert not use.leaves(use.wanted(1.0, SETTINGS), 1.0, SETTINGS)


def test_a_sweep_is_met_ahead_of_time():
    use = stream([(3.0 + 0.05 * k, 0.06 * k) for k in range(11)])  # 0.5 mm/s, 0.6 dpt/s
    wanted = use.wanted(1.0, SETTINGS)
    # 3.2 s later 3.5 + 1.6 mm and 0.6 + 1.9 dpt, of which 1 mm and 1.5 dpt count
    assert wanted.pupil_mm[0] <= 3.0 and wanted.pupil_mm[1] >= 4.5
    assert wanted.focus_dpt[1] >= 2.1
    assert not use.leaves(wanted, 1.0, SETTINGS)
    still = stream([(3.0, 0.0)] * 11).wanted(1.0, SETTINGS)
    assert use.leaves(still, 1.0, SETTINGS)


def test_a_gaze_to_and_fro_keeps_both_distances():
    use = stream([(4.0, 0.0 if k // 10 % 2 else 3.0) for k in range(80)])
    wanted = use.wanted(0.5, SETTINGS)
    assert wanted.focus_dpt[0] == 0.0 and wanted.focus_dpt[1] >= 3.0


def test_what_was_long_ago_is_forgotten():
    use = StreamUse()
    use.note(FrameUse(0.0, 7.0, 6.0, SCENE))
    for k in range(20):
        use.note(FrameUse(HISTORY_S + 0.1 * (k + 1), 4.0, 0.0, SCENE))
    assert use.wanted(1.0, SETTINGS).pupil_mm[1] <= 4.5


def test_nothing_beyond_the_settings_is_wanted():
    settings = FilterSettings(pupil_range_mm=(3.9, 4.1), object_range_dpt=(0.0, 1.0))
    use = stream([(6.0, 3.0)] * 5)
    wanted = use.wanted(1.0, settings)
    assert wanted.pupil_mm == (4.1, 4.1)
    assert wanted.object_dpt == (0.0, 1.0)
    assert not use.leaves(wanted, 1.0, settings)
    assert wanted.applied(settings).pupil_range_mm == (4.1, 4.1)


@pytest.mark.parametrize(
    ("other", "holds"),
    [
        (UsedRanges((3.0, 4.0), (0.0, 1.0), (0.0, 2.0)), True),
        (UsedRanges((2.9, 4.0), (0.0, 1.0), (0.0, 2.0)), False),
        (UsedRanges((3.0, 4.0), (0.0, 1.1), (0.0, 2.0)), False),
        (UsedRanges((3.0, 4.0), (0.0, 1.0), (0.0, 2.1)), False),
    ],
)
def test_holding_is_in_all_three(other, holds):
    assert UsedRanges((3.0, 4.0), (0.0, 1.0), (0.0, 2.0)).holds(other) == holds


def planes_stream(frames, settings=SETTINGS):
    use = StreamUse()
    for k, planes_dpt in enumerate(frames):
        use.note(FrameUse(0.1 * k, 4.0, 1.0, SCENE, planes_dpt))
    return use.wanted(1.0, settings).planes_dpt


def test_planes_that_stay_are_prepared_alone():
    assert planes_stream([(0.1, 1.4)] * 9) == (0.1, 1.4)
    assert planes_stream([(0.1,), (1.4,)] * 9) == (0.1, 1.4)
    nearer = FilterSettings(object_range_dpt=(0.5, 1.0))
    assert planes_stream([(0.1, 0.2, 1.4)], nearer) == (0.5, 1.0)
    told = FilterSettings(object_planes_dpt=(0.0, 2.0))
    assert planes_stream([(0.1, 1.4)], told) == (0.0, 2.0)


def test_planes_that_move_or_end_are_a_range():
    assert planes_stream([(0.2 * k,) for k in range(9)]) == ()
    assert planes_stream([(0.1, 1.4), (), (0.1, 1.4)]) == ()


def test_what_is_prepared_for_planes_holds_these_alone():
    ranges = (3.0, 4.0), (0.0, 1.0), (0.0, 2.0)
    planes = UsedRanges(*ranges, (0.5, 1.5))
    assert planes.holds(UsedRanges(*ranges, (1.5,)))
    assert not planes.holds(UsedRanges(*ranges, (0.6,)))
    assert not planes.holds(UsedRanges(*ranges))
    assert UsedRanges(*ranges).holds(planes)
    assert planes.applied(SETTINGS).object_planes_dpt == (0.5, 1.5)
