"""What drives an eye from moment to moment, against published values and formulas."""

import json
import math

import numpy as np
import pytest

from estimator.dynamics import (
    LATENCY_RANGE_S,
    AccommodationResponse,
    DelayedApproach,
    GazeFollower,
    reflex_latency_s,
    steady_pupil_mm,
)
from tests.numerical.moving_eyes import (
    recorded_pulses,
    steps_response,
)
from tests.source_tree import ROOT

REFERENCE = json.loads((ROOT / "tests/data/eye_reference.json").read_text("utf-8"))


def test_the_steady_pupil_is_watson_and_yellott_s():
    for row in REFERENCE["watson_yellott"]:
        area_deg2 = math.pi * (row["fov_deg"] / 2) ** 2
        found_mm = steady_pupil_mm(row["L"], area_deg2, row["age"])
        assert found_mm == pytest.approx(row["D"], abs=1e-9)
    assert steady_pupil_mm(10, 900 * math.pi, 30) == pytest.approx(3.828, abs=1e-3)


def test_the_steady_pupil_shrinks_with_light_and_age_and_stays_human():
    lights = np.geomspace(1e-3, 1e4, 40)
    for age_years in (20, 45, 83):
        sizes_mm = [steady_pupil_mm(light, 2800, age_years) for light in lights]
        assert np.all(np.diff(sizes_mm) < 0)
        assert min(sizes_mm) > 1.5
        assert max(sizes_mm) < 8.0
    assert steady_pupil_mm(1, 2800, 20) > steady_pupil_mm(1, 2800, 70)
    assert steady_pupil_mm(1, 2800, 30, n_eyes=1) > steady_pupil_mm(1, 2800, 30)
    assert steady_pupil_mm(1, 2800, 5) == steady_pupil_mm(1, 2800, 20)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((-1.0, 100.0, 30), "luminance_cd_m2 is -1.0"),
        ((math.nan, 100.0, 30), "luminance_cd_m2"),
        ((1.0, 0.0, 30), "field_area_deg2"),
    ],
)
def test_light_that_is_none_is_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        steady_pupil_mm(*arguments)
    with pytest.raises(ValueError, match="n_eyes is 3"):
        steady_pupil_mm(1.0, 100.0, 30, n_eyes=3)


@pytest.mark.parametrize("step_s", [0.5, 0.1, 1 / 72, 0.001])
def test_an_approach_does_not_depend_on_how_often_it_is_asked(step_s):
    follower = DelayedApproach(1.0, 0.3, lambda value, target: 0.2 * abs(target))
    follower.follow(1.0, 0.0)
    follower.follow(3.0, 1.0)
    times_s = np.arange(1.0, 3.0, step_s)
    found = [follower.follow(3.0, t) for t in times_s]
    moving_s = np.maximum(times_s - 1.3, 0.0)
    expected = np.where(times_s < 1.3, 1.0, 3.0 - 2.0 * np.exp(-moving_s / 0.6))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_targets_act_in_order_each_after_the_latency():
    follower = DelayedApproach(0.0, 0.5, lambda value, target: 1e-9)
    follower.follow(0.0, 0.0)
    for target, at_s in ((1.0, 0.1), (2.0, 0.2), (5.0, 0.3)):
        follower.follow(target, at_s)
    assert follower.value_at(0.59) == 0.0
    assert follower.value_at(0.65) == pytest.approx(1.0)
    assert follower.value_at(0.75) == pytest.approx(2.0)
    assert follower.value_at(9.0) == pytest.approx(5.0)
    assert follower.follow(7.0, 3.0) == pytest.approx(5.0), "time runs on only"
    for wrong in ((math.nan, 10.0), (1.0, math.inf)):
        with pytest.raises(ValueError, match="finite"):
            follower.follow(*wrong)


def tracked(gaze_deg, rate_hz=120, **settings):
    """Gaze samples through a follower: (n, 2) of what came out."""
    follower = GazeFollower(**settings)
    found = []
    for i, (h_deg, v_deg) in enumerate(gaze_deg):
        follower.see(h_deg, v_deg, i / rate_hz)
        seen = follower.at(i / rate_hz)
        found.append((seen.h_deg, seen.v_deg))
    return np.array(found)


def test_a_resting_gaze_trembles_less(rng):
    noise_deg = rng.normal(0.0, 0.3, (2400, 2))
    seen = tracked(noise_deg + np.array((5.0, -3.0)))
    assert seen[240:].std(axis=0).max() < 0.5 * 0.3
    np.testing.assert_allclose(seen[240:].mean(axis=0), (5.0, -3.0), atol=0.05)


def test_a_saccade_is_followed_at_once_and_on_a_straight_line():
    speed_deg_s, rate_hz = 300.0, 120
    ramp = np.clip((np.arange(200) - 100) / rate_hz * speed_deg_s, 0.0, 15.0)
    way = np.stack([ramp, 0.5 * ramp], axis=1)
    seen = tracked(way)
    after = round(0.05 * rate_hz)  # the saccade takes 50 ms
    assert seen[100 + 2 * after, 0] > 0.9 * 15.0
    np.testing.assert_allclose(seen[:, 1], 0.5 * seen[:, 0], atol=1e-9)


def test_a_blink_is_bridged_and_a_loss_is_said():
    follower = GazeFollower()
    assert not follower.at(0.0).is_tracked
    follower.see(4.0, 2.0, 1.0)
    blink = follower.at(1.3)
    assert (blink.h_deg, blink.v_deg, blink.is_tracked) == (4.0, 2.0, True)
    assert blink.age_s == pytest.approx(0.3)
    lost = follower.at(1.5)
    assert (lost.h_deg, lost.v_deg, lost.is_tracked) == (0.0, 0.0, False)
    follower.see(-7.0, 0.0, 3.0)
    assert follower.at(3.0).h_deg == -7.0, "what was before the loss does not count"


def test_samples_that_are_none_or_old_change_nothing():
    follower = GazeFollower()
    follower.see(4.0, 2.0, 1.0)
    for sample in ((math.nan, 0.0, 1.1), (9.0, math.inf, 1.1), (9.0, 9.0, 0.5)):
        follower.see(*sample)
        assert follower.at(1.1).h_deg == 4.0
    for wrong in ({"min_cutoff_hz": 0}, {"speed_weight": -1}, {"max_age_s": math.nan}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            GazeFollower(**wrong)


def test_the_pupil_follows_recorded_pulses():
    """Those it was fitted to: 0.06 to 0.23 mm of a change of 2.3 to 2.7 mm.

    Coarsely the one that it was not fitted to, 0.50 mm of 3 mm: another instrument and
    unknown light; this pupil closes half as fast, and opens slower in the end.
    """
    names = []
    for name, _, recorded_mm, ours_mm in recorded_pulses():
        limit_mm = 0.55 if "not fitted" in name else 0.25
        assert np.sqrt(np.mean((ours_mm - recorded_mm) ** 2)) < limit_mm, name
        names.append(name)
    assert len(names) == 6


def test_the_pupil_waits_less_in_more_light():
    """34 ms less for each log unit (Myers & Stark 1993), about 0.2 to 0.3 s."""
    lights = (0.1, 1.0, 10.0, 100.0)
    latencies_s = [reflex_latency_s(light) for light in lights]
    np.testing.assert_allclose(np.diff(latencies_s), -0.034, atol=1e-12)
    assert min(latencies_s) >= 0.2
    assert max(latencies_s) <= 0.31
    assert reflex_latency_s(0.0) == LATENCY_RANGE_S[1]


@pytest.mark.parametrize(("cue", "per_dpt"), [("blur", 7.10), ("both", 3.56)])
@pytest.mark.parametrize("size_dpt", [1.0, 2.0, 3.0])
def test_accommodation_is_as_fast_as_measured(cue, per_dpt, size_dpt):
    """Peak speed, dpt/s, of young adults; lens and muscle are 0.156 s at their best."""
    times_s, found_dpt = steps_response(0.0, size_dpt, cue=cue)
    peak_dpt_s = np.diff(found_dpt).max() / 0.001
    allowed = 2.64 if cue == "blur" else 0.95  # the standard deviation among people
    assert abs(peak_dpt_s - per_dpt * size_dpt) < allowed * size_dpt
    begins_s = times_s[np.argmax(found_dpt > 0.0)]
    assert 0.30 <= begins_s <= 0.40  # Campbell & Westheimer 1960: 0.36 s
    assert found_dpt[-1] == pytest.approx(size_dpt, abs=1e-3)


@pytest.mark.parametrize("begin_dpt", [2.0, 3.0, 4.0])
@pytest.mark.parametrize("size_dpt", [1.0, 2.0])
def test_relaxation_is_as_fast_as_its_beginning_says(begin_dpt, size_dpt):
    """1.39 x beginning + 1.12 dpt/s whatever its size, Bharadwaj & Schor 2006."""
    _, found_dpt = steps_response(begin_dpt, begin_dpt - size_dpt)
    peak_dpt_s = -np.diff(found_dpt).min() / 0.001
    assert peak_dpt_s == pytest.approx(1.39 * begin_dpt + 1.12, rel=0.1)


def test_an_eye_does_what_it_can():
    old = AccommodationResponse(0.0, 0.5)
    old.follow(0.0, 0.0)
    old.follow(3.0, 1.0)
    assert old.follow(3.0, 9.0) == pytest.approx(0.5, abs=1e-6)
    myope = AccommodationResponse(2.0, 9.0)
    assert myope.follow(0.0, 0.0) == 2.0, "it cannot see farther"
    with pytest.raises(ValueError, match="cue is 'prism'"):
        AccommodationResponse(0.0, 5.0, cue="prism")
    for near_dpt in (-1.0, math.nan):
        with pytest.raises(ValueError, match="near_dpt is"):
            AccommodationResponse(0.0, near_dpt)
