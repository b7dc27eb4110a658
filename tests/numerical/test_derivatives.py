"""Derivatives of images against Richardson differences of the filter at other steps."""

import numpy as np
import pytest

from filter_service import Camera, EyeFilter, FilterSettings, image_derivatives
from filter_service.errors import BadMessage
from filter_service.filtering.derivatives import PROFILE_STEPS, STEPS

WIDTH, HEIGHT = 36, 24
CAMERA = Camera.from_fov(1.8, width_px=WIDTH, height_px=HEIGHT)
PROFILE = {
    "kind": "zernike",
    "pupil_diameter_mm": 6.0,
    "wavelength_nm": 550.0,
    "zernike_um": {"2,-2": 0.1, "2,0": 0.8, "3,-1": 0.1, "3,1": -0.08, "4,0": 0.15},
}
SETTINGS = FilterSettings(mode="on-axis", eye_model="wavefront")
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 2.0}
FAR_STATE = {**STATE, "focus_dpt": 0.0}  # beyond the far point of the eye


@pytest.fixture(scope="module")
def eye_filter():
    with EyeFilter(PROFILE, CAMERA, SETTINGS) as found:
        found.wait()
        yield found


@pytest.fixture(scope="module")
def color():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    bars = 0.1 + 0.8 * ((x // 6 + y // 8) % 2)
    return np.stack([bars, 0.5 * bars + 0.2, 1.0 - bars], -1).astype(np.float32)


@pytest.fixture(scope="module")
def depth_m():
    """A slanted surface beside a near one, which covers it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.where(x < 14, 0.5, 0.8 + 1.2 * y / HEIGHT).astype(np.float32)


def with_term(term, value_um):
    return {**PROFILE, "zernike_um": {**PROFILE["zernike_um"], term: value_um}}


def richardson(image_at, value, step):
    """Return the derivative from differences at the step and at its double."""
    slopes = [
        (image_at(value + h) - image_at(value - h)) / (2.0 * h)
        for h in (step, 2.0 * step)
    ]
    return (4.0 * slopes[0] - slopes[1]) / 3.0


def filtered(eye_filter, color, depth_m, **state):
    return eye_filter.filter(
        *(color, depth_m),
        **state,
        output="linear",
        whole=True,
        merge=False,
        bright_pixels=False,
        render_tolerance=0.0,
    ).color.astype(float)


def check(found, expected):
    """PSFs have errors that change with the state: they limit single pixels."""
    assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected)
    size = np.vdot(found, expected) / np.vdot(expected, expected)
    assert size == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("name", ["pupil_diameter_mm", "focus_dpt"])
def test_derivatives_by_the_state(eye_filter, color, depth_m, name):
    found = image_derivatives(eye_filter, color, depth_m, [name], **STATE)[name]
    expected = richardson(
        lambda value: filtered(eye_filter, color, depth_m, **{**STATE, name: value}),
        *(STATE[name], 0.8 * STEPS[name]),
    )
    check(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("term", PROFILE["zernike_um"])
def test_derivatives_by_coefficients(eye_filter, color, depth_m, term):
    name = f"profile.zernike_um.{term}"
    found = image_derivatives(
        *(eye_filter, color, depth_m, [name]), **FAR_STATE, profile=PROFILE
    )[name]

    def image_at(value):
        with EyeFilter(with_term(term, value), CAMERA, SETTINGS) as other:
            return filtered(other, color, depth_m, **FAR_STATE)

    value_um = PROFILE["zernike_um"][term]
    expected = richardson(image_at, value_um, 0.8 * PROFILE_STEPS["_um"])
    check(found, expected)


def test_beyond_the_far_point_the_focus_has_no_effect(eye_filter, color, depth_m):
    state = {**STATE, "focus_dpt": 0.2}
    found = image_derivatives(
        eye_filter, color, depth_m, ["focus_dpt", "pupil_diameter_mm"], **state
    )
    assert not found["focus_dpt"].any()
    assert found["pupil_diameter_mm"].any()


def test_several_colors_have_derivatives_of_their_own(eye_filter, color, depth_m):
    names = ["focus_dpt"]
    one = image_derivatives(eye_filter, color, depth_m, names, **STATE)["focus_dpt"]
    colors = np.stack([color, 2.0 * color])[None]
    found = image_derivatives(eye_filter, colors, depth_m, names, **STATE)["focus_dpt"]
    assert found.shape == colors.shape
    np.testing.assert_array_equal(found[0, 0], one)
    np.testing.assert_allclose(found[0, 1], 2.0 * one, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("depth_m", "parameters: 'depth_m'.*pupil_diameter_mm, focus_dpt"),
        ("gaze_h_deg", "mode on-axis"),
        ("profile.kind", "is 'zernike'.*a number"),
        ("profile.zernike_um.9,1", "there is no '9,1'"),
        ("profile.sphere_dpt", "there is no 'sphere_dpt'"),
        ("profile.wavelength_nm", "ends in _dpt, _um, _mm, _mm3, _deg"),
    ],
)
def test_other_parameters_raise(eye_filter, color, depth_m, name, message):
    with pytest.raises(BadMessage, match=message):
        image_derivatives(
            *(eye_filter, color, depth_m, [name]), **STATE, profile=PROFILE
        )


def test_a_parameter_of_the_profile_needs_the_profile(eye_filter, color, depth_m):
    with pytest.raises(BadMessage, match=r"profile: it is missing"):
        image_derivatives(
            *(eye_filter, color, depth_m, ["profile.zernike_um.4,0"]), **STATE
        )


def test_a_difference_beyond_the_prepared_range_raises(eye_filter, color, depth_m):
    state = {**STATE, "pupil_diameter_mm": 6.95}
    with pytest.raises(BadMessage, match=r"read 7\.03.*2 to 7, .*pupil_range_mm"):
        image_derivatives(eye_filter, color, depth_m, ["pupil_diameter_mm"], **state)
