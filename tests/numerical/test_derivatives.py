"""Derivatives of images against differences of the filter at other steps, and against
the derivatives of images by quadrature.
"""

from dataclasses import replace

import numpy as np
import pytest

from filter_service import (
    Camera,
    EyeFilter,
    FilterSettings,
    RgbdView,
    image_derivatives,
)
from filter_service.errors import BadMessage
from filter_service.filtering.derivatives import PROFILE_STEPS, STEPS
from tests.reference.flat_image import FlatScene, derivative, wavefront_of_profile

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


SMOOTH = 0.2 + 0.6 * np.exp(
    -np.add.outer((np.arange(16) - 7.0) ** 2, (np.arange(20) - 9.0) ** 2) / 8.0
)
SMOOTH_CAMERA = Camera.from_fov(0.7, width_px=20, height_px=16)
ONE_COLOR = FilterSettings(mode="on-axis", eye_model="wavefront", chromatic=False)
MYOPIA = {"kind": "prescription", "sphere_dpt": -2.0, "higher_order": "none"}
SPHERICAL = {
    "kind": "zernike",
    "pupil_diameter_mm": 5.0,
    "wavelength_nm": 587.56,
    "zernike_um": {"2,0": 0.4, "4,0": 0.1},
}


@pytest.mark.long("PSFs by quadrature")
@pytest.mark.parametrize(
    ("profile", "name", "focus_dpt"),
    [
        (MYOPIA, "pupil_diameter_mm", 2.6),
        pytest.param(MYOPIA, "focus_dpt", 2.6, marks=pytest.mark.slow),
        pytest.param(MYOPIA, "profile.sphere_dpt", 0.0, marks=pytest.mark.slow),
        (SPHERICAL, "profile.zernike_um.4,0", 0.0),
    ],
)
def test_fine_derivatives_are_those_of_quadrature(profile, name, focus_dpt):
    pupil_mm, object_dpt = 3.0, 1.3
    color = np.repeat(SMOOTH[..., None], 3, axis=2).astype(np.float32)
    depth_m = np.full(SMOOTH.shape, 1.0 / object_dpt, np.float32)
    view = RgbdView(color, depth_m, SMOOTH_CAMERA.tangents, depth_kind="radial")
    with EyeFilter(profile, SMOOTH_CAMERA, ONE_COLOR) as eye_filter:
        found = image_derivatives(
            *(eye_filter, color, view, [name]),
            pupil_diameter_mm=pupil_mm,
            focus_dpt=focus_dpt,
            profile=profile,
            accuracy="fine",
        )[name]
    cornea_um, measured_nm = wavefront_of_profile(profile)
    scene = FlatScene(
        cornea_um=cornea_um,
        measured_nm=measured_nm,
        pupil_diameter_mm=pupil_mm,
        focus_dpt=focus_dpt,
        object_dpt=object_dpt,
        light=SMOOTH,
        pitch_mrad=SMOOTH_CAMERA.pixel_pitch_mrad,
    )

    def image_at(value):
        if hasattr(scene, name):
            own = replace(scene, **{name: value})
        elif name.endswith("sphere_dpt"):
            own = scene.with_power(value)
        else:
            own = scene.with_term(4, 0, value, profile["pupil_diameter_mm"] / 2.0)
        return own.image()[..., 0]

    expected = derivative(image_at, getattr(scene, name, 0.0), 0.02)
    size = np.vdot(expected, expected)
    np.testing.assert_array_equal(found[..., 0], found[..., 1])
    own = found[..., 1]
    assert np.vdot(own, expected) / size == pytest.approx(1.0, abs=1e-3)
    assert np.linalg.norm(own - expected) < 2e-3 * size**0.5


@pytest.mark.slow
def test_fine_derivatives_of_several_distances(eye_filter, color, depth_m):
    """Beyond edges of depth, both accuracies differ by the error of the normal one."""
    near_m = np.where(depth_m == 0.5, 0.5, 0.9).astype(np.float32)
    normal, fine = (
        image_derivatives(
            *(eye_filter, color, near_m, ["focus_dpt"]), **STATE, accuracy=accuracy
        )["focus_dpt"]
        for accuracy in ("normal", "fine")
    )
    columns = np.abs(np.arange(WIDTH) - 13.5) > 4.0
    check(normal[:, columns], fine[:, columns].astype(float))


def test_unknown_accuracies_and_settings_without_quadrature_raise(
    eye_filter, color, depth_m
):
    with pytest.raises(BadMessage, match=r"accuracy: 'exact'.*normal or fine"):
        image_derivatives(
            *(eye_filter, color, depth_m, ["focus_dpt"]), **STATE, accuracy="exact"
        )
    settings = SETTINGS.changed(diffraction=False)
    with (
        EyeFilter(PROFILE, CAMERA, settings) as other,
        pytest.raises(BadMessage, match=r"accuracy: 'fine'.*without diffraction"),
    ):
        image_derivatives(
            *(other, color, depth_m, ["focus_dpt"]), **STATE, accuracy="fine"
        )
