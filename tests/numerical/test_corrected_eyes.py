"""Pictures solved for eyes, judged by frames that the public filter renders of them."""

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from filter_service.camera import Camera
from filter_service.correcting import correct
from filter_service.errors import BadMessage
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.shared_builder import open_inline_builder
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings

WIDTH_PX, HEIGHT_PX = 48, 32
CAMERA = Camera.from_fov(1.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)
SETTINGS = FilterSettings(mode="on-axis", eye_model="wavefront", chromatic=False)
STATE = {"pupil_diameter_mm": 3.0, "focus_dpt": 0.0}
VIEWER, OTHER, WORSE = "-1 dpt", "-0.5 dpt", "-2 dpt"
PROFILES = {
    name: {"kind": "prescription", "sphere_dpt": float(name.split()[0])}
    for name in (VIEWER, OTHER, WORSE)
}
EYES = {}
INFINITE = np.full((HEIGHT_PX, WIDTH_PX), np.inf, np.float32)


def scene(*, low=0.0, high=1.0):
    """Return bars and steps between two levels of light, far away."""
    x = np.arange(WIDTH_PX) // 4 % 2 * np.ones((HEIGHT_PX, 1))
    x[: HEIGHT_PX // 2] = np.arange(WIDTH_PX) // 8 % 4 / 3.0
    color = (low + (high - low) * x)[..., None] * np.array([1.0, 0.8, 0.6])
    return RgbdView(color.astype(np.float32), INFINITE, CAMERA.tangents)


@pytest.fixture(scope="module", autouse=True)
def eyes():
    """The filter of each eye, and their builder."""
    with ExitStack() as closing:
        EYES["builder"] = open_inline_builder(closing, engine="native")
        for name, profile in PROFILES.items():
            EYES[name] = closing.enter_context(
                EyeFilter(profile, CAMERA, SETTINGS, builder=EYES["builder"])
            )
        yield
    EYES.clear()


def seen(name, view, color=None, **state):
    """Return a frame of the public filter, linear light."""
    if color is not None:
        view = replace(view, color=np.asarray(color, np.float32))
    return (
        EYES[name]
        .filter(
            view,
            **STATE | state,
            output="linear",
            merge=False,
            bright_pixels=False,
            whole=True,
        )
        .color
    )


def solve(view, *names, target_eye=None, **given):
    profiles = [PROFILES[name] for name in names or (VIEWER,)]
    return correct(
        view,
        profiles,
        target_eye=target_eye and PROFILES[target_eye],
        **STATE | {"settings": SETTINGS, "builder": EYES["builder"]} | given,
    )


def rms(difference):
    return float(np.sqrt(np.mean(np.square(difference, dtype=np.float64))))


@pytest.fixture(scope="module")
def plain():
    """The scene, solved for a viewer."""
    return solve(scene())


@pytest.fixture(scope="module")
def halved():
    """The scene at half its contrast, solved for the same viewer."""
    return solve(scene(), contrast=0.5, brightness=0.4)


def test_the_viewer_sees_what_the_result_says(plain):
    view = scene()
    for image, color in ((plain.before, plain.target), (plain.after, plain.color)):
        assert np.abs(seen(VIEWER, view, color) - image).max() < 2e-3
    assert plain.color.min() >= 0.0
    assert plain.color.max() <= 1.0
    np.testing.assert_array_equal(plain.target, view.color)
    for image, psnr_db in (
        (plain.before, plain.psnr_before_db),
        (plain.after, plain.psnr_after_db),
    ):
        assert np.isclose(-20.0 * np.log10(rms(image - plain.target)), psnr_db)


def test_the_picture_comes_nearer_and_more_so_with_less_contrast(plain, halved):
    assert plain.psnr_after_db > plain.psnr_before_db + 0.5
    gain_db = plain.psnr_after_db - plain.psnr_before_db
    assert halved.psnr_after_db - halved.psnr_before_db > gain_db + 1.0
    assert plain.has_converged
    assert halved.has_converged
    assert plain.iteration_count == len(plain.errors) - 1
    assert plain.lower_bound <= min(plain.errors)
    assert np.isclose(10.0 ** (-plain.psnr_after_db / 10.0), min(plain.errors))


def test_what_contrast_is_given_up_is_told(plain, halved):
    assert (plain.contrast_given_up_ratio, halved.contrast_given_up_ratio) == (0.0, 0.5)
    color = scene().color.astype(np.float64)
    means = color.mean(axis=(0, 1))
    wanted = means + 0.4 - means.mean() + 0.5 * (color - means)
    np.testing.assert_allclose(halved.target, wanted, atol=1e-6)
    assert plain.seen_before_ratio < plain.seen_after_ratio < 1.0
    assert halved.seen_before_ratio < halved.seen_after_ratio < 0.5
    about = color - means
    slope = np.vdot(plain.after - plain.after.mean(axis=(0, 1)), about)
    assert np.isclose(slope / np.vdot(about, about), plain.seen_after_ratio, rtol=1e-4)


def test_a_viewer_sees_what_an_eye_with_more_blur_sees():
    view = scene()
    found = solve(view, target_eye=WORSE)
    meant = seen(WORSE, view)
    assert np.abs(found.target - meant).max() < 2e-3
    assert found.psnr_after_db > found.psnr_before_db + 10.0
    assert rms(seen(VIEWER, view, found.color) - meant) < 0.3 * rms(
        seen(VIEWER, view, meant) - meant
    )


def test_the_error_over_a_range_of_states_is_the_mean_over_them(plain):
    found = solve(scene(), pupil_range_mm=0.5, focus_range_dpt=0.25)
    states = [{}, {"pupil_diameter_mm": 2.5}, {"pupil_diameter_mm": 3.5}]
    states.append({"focus_dpt": 1.25})  # the eye is focused at 1 dpt when relaxed
    nearer = replace(scene(), depth_m=np.full_like(INFINITE, 4.0))

    def error(color):
        squares = [
            rms(seen(VIEWER, scene(), color, **s) - found.target) for s in states
        ]
        squares.append(rms(seen(VIEWER, nearer, color) - found.target))
        return np.mean(np.square(squares))

    assert np.isclose(error(found.color), min(found.errors), rtol=0.02)
    assert error(found.color) < error(plain.color)


def test_an_error_of_focus_is_one_of_the_distance_of_a_near_display():
    found = solve(scene(), display_distance_m=2.0, focus_range_dpt=0.25)
    squares = []
    for distance_m in (2.0, 4.0 / 3.0, 4.0):
        view = replace(scene(), depth_m=np.full_like(INFINITE, distance_m))
        squares.append(rms(seen(VIEWER, view, found.color) - found.target) ** 2)
    assert np.isclose(np.mean(squares), min(found.errors), rtol=0.02)


def test_both_eyes_look_at_the_same_picture(plain):
    both = solve(scene(), VIEWER, OTHER)
    errors = [
        [rms(seen(eye, scene(), x) - both.target) ** 2 for eye in (VIEWER, OTHER)]
        for x in (both.color, plain.color)
    ]
    assert np.isclose(np.mean(errors[0]), min(both.errors), rtol=0.01)
    assert np.mean(errors[0]) < np.mean(errors[1])
    assert errors[0][0] > errors[1][0]  # for the first eye alone there is a better one


def test_a_display_at_its_own_distance(plain):
    near = solve(scene(), display_distance_m=1.0)
    assert near.psnr_before_db > plain.psnr_before_db + 10.0  # at the far point


def test_a_weighted_solution_has_the_smaller_weighted_error(plain):
    weighted = solve(scene(), metric="sensitivity")
    assert weighted.psnr_after_db < plain.psnr_after_db
    assert weighted.has_converged


def test_progress_is_reported():
    told = []
    solve(scene(), on_progress=lambda fraction, stage: told.append((fraction, stage)))
    assert told[-1] == (1.0, "iterations")
    assert any(stage.startswith("viewer's eye, ") for _, stage in told)


def test_8_bit_scenes_are_decoded(plain):
    from filter_service.color_encoding import srgb8_of

    codes = srgb8_of(scene().color)
    found = solve(replace(scene(), color=codes), max_iterations=1)
    assert np.abs(found.target - plain.target).max() < 0.01
    assert found.color_srgb8.dtype == np.uint8
    assert found.notes[-1] == "not converged after 1 iterations"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"view": INFINITE}, r"view: a ndarray \(allowed: an RgbdView\)"),
        ({"contrast": "half"}, r"contrast: it is 'half' \(allowed: 0.01 to 1\)"),
        ({"contrast": 0.0}, r"contrast: it is 0.0 \(allowed: 0.01 to 1\)"),
        ({"brightness": 1.5}, r"brightness: it is 1.5 \(allowed: 0 to 1\)"),
        ({"metric": "l1"}, r"metric: it is 'l1' \(allowed: retina or sensitivity\)"),
        ({"pupil_range_mm": -1.0}, r"pupil_range_mm: it is -1.0 \(allowed: 0 to 2\)"),
        ({"focus_range_dpt": 3.0}, r"focus_range_dpt: it is 3.0 \(allowed: 0 to 2\)"),
        ({"display_distance_m": 0.0}, r"display_distance_m: it is 0.0 \(allowed: 0.05"),
        ({"viewer": []}, r"viewer: it is empty \(allowed: one profile or more\)"),
        ({"pupil_diameter_mm": 10.0}, "pupil_diameter_mm"),
        (
            {"pupil_diameter_mm": 1.0, "pupil_range_mm": 0.6},
            r"pupil_range_mm: pupils are 0.4 to 1.6 mm \(allowed: pupils of 0.5 to 9",
        ),
        ({"tolerance": -1.0}, r"tolerance: it is -1.0 \(allowed: 0 to 1\)"),
        ({"max_iterations": 0}, r"max_iterations: it is 0 \(allowed: 1 to 100000\)"),
    ],
)
def test_bad_input_is_named_before_an_eye_is_estimated(change, said, monkeypatch):
    monkeypatch.setattr("filter_service.correcting.correction.EyeFilter", None)
    with pytest.raises(BadMessage, match=said):
        correct(**{"view": scene(), "viewer": PROFILES[VIEWER]} | STATE | change)
