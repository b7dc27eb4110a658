"""The states that the next frames of a stream will have."""

import numpy as np
import pytest

from filter_service.camera import Camera
from filter_service.filtering.frame_history import SPEED_S, FrameHistory
from filter_service.rendering.frame_kernels import STEP_PX, SampledView, first_frame
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from filter_service.view_state import State

TANGENTS = (-0.4, 0.4, 0.3, -0.3)


def view_of(depth_m, **more):
    color = np.zeros((*depth_m.shape, 3), np.uint8)
    return RgbdView(color, depth_m.astype(np.float32), TANGENTS, **more)


def noted(states, interval_s=0.05):
    history = FrameHistory()
    view = view_of(np.ones((12, 16)))
    for number, (pupil_mm, focus_dpt) in enumerate(states):
        at_s = 10.0 + number * interval_s
        history.record([view], State(pupil_mm, focus_dpt), at_s=at_s)
    return history


def predicted(history, lead_s):
    state = history.predicted(lead_s)
    return state.pupil_diameter_mm, state.focus_dpt


@pytest.mark.parametrize("lead_s", [0.06, 0.4])
def test_states_go_on_at_their_speed(lead_s):
    history = noted([(4.0 + 0.1 * k, 2.0 - 0.05 * k) for k in range(20)])
    expected = (5.9 + 2.0 * lead_s, 1.05 - 1.0 * lead_s)
    np.testing.assert_allclose(predicted(history, lead_s), expected, rtol=1e-9)


def test_only_the_last_frames_tell_the_speed():
    n_last = int(SPEED_S / 0.05) + 2
    history = noted([(2.0, 0.0), (7.0, 5.0)] * 10 + [(4.0, 1.0)] * n_last)
    np.testing.assert_allclose(predicted(history, 0.1), (4.0, 1.0))


def test_the_interval_is_that_of_the_last_frames():
    assert noted([(4.0, 1.0)] * 20).interval_s == pytest.approx(0.05)
    assert noted([(4.0, 1.0)]).interval_s == 0.0


@pytest.mark.parametrize("count", [0, 1])
def test_a_single_frame_tells_no_speed(count):
    assert noted([(4.0, 1.0)] * count).predicted(0.1) is None


def test_frames_at_the_same_time_tell_no_speed():
    assert noted([(4.0, 1.0), (5.0, 2.0)], interval_s=0.0).predicted(0.1) is None


def test_a_view_is_remembered_by_some_of_its_depths():
    depth_m = np.full((12, 16), 2.0)
    depth_m[0, 0] = np.nan
    seen = SampledView.later(view_of(depth_m, depth_kind="radial"))()
    assert seen.object_dpt.shape == (12 // STEP_PX, 16 // STEP_PX)
    np.testing.assert_allclose(seen.object_dpt, 0.5)
    assert seen.hidden_dpt is None


def test_what_is_hidden_is_remembered_too():
    depth_m, hidden_m = np.full((12, 16), 1.0), np.zeros((12, 16), np.float32)
    hidden_m[:, 8:] = 4.0
    view = view_of(
        depth_m,
        depth_kind="radial",
        hidden_color=np.zeros((12, 16, 3), np.uint8),
        hidden_depth_m=hidden_m,
    )
    hidden_dpt = SampledView.later(view)().hidden_dpt
    assert np.isnan(hidden_dpt[:, :2]).all()
    np.testing.assert_allclose(hidden_dpt[:, 2:], 0.25)


def test_a_memory_that_is_used_again_does_not_change_what_is_remembered():
    view = view_of(np.full((12, 16), 2.0), depth_kind="radial")
    sample = SampledView.later(view)
    view.depth_m[:] = 9.0
    np.testing.assert_allclose(sample().object_dpt, 0.5)


def test_a_first_frame_keeps_to_the_settings():
    camera = Camera(16, 12, TANGENTS)
    settings = FilterSettings(
        pupil_range_mm=(5.0, 6.0),
        focus_range_dpt=(1.0, 2.0),
        object_range_dpt=(0.5, 1.0),
    )
    use = first_frame(camera, settings)
    assert use.state == State(5.0, 1.0)
    (seen,) = use.views
    assert (seen.object_dpt.min(), seen.object_dpt.max()) == (0.5, 1.0)
