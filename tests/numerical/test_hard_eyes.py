"""Eyes and displays at the edge of what there is: finite, smooth, or refused."""

from itertools import pairwise

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from filter_service.camera import Camera
from filter_service.errors import GridTooLarge
from filter_service.planning.grid import GridSpec
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.native.renderer import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings

WIDTH, HEIGHT = 72, 48
CAMERA = Camera(WIDTH, HEIGHT, (-0.45, 0.45, 0.3, -0.3))  # 12 mrad a pixel
HARD = {
    "-20 dpt": {"kind": "prescription", "sphere_dpt": -20.0},
    "+20 dpt": {"kind": "prescription", "sphere_dpt": 20.0},
    "8 dpt of cylinder": {
        "kind": "prescription",
        "sphere_dpt": -2.0,
        "cylinder_dpt": -8.0,
        "axis_deg": 30.0,
    },
    "-20 dpt worn": {
        "kind": "prescription",
        "sphere_dpt": -20.0,
        "vertex_mm": 12.0,
        "correction": {"sphere_dpt": -20.0, "vertex_mm": 12.0},
    },
    "+20 dpt worn": {
        "kind": "prescription",
        "sphere_dpt": 20.0,
        "vertex_mm": 12.0,
        "correction": {"sphere_dpt": 20.0, "vertex_mm": 12.0},
    },
    "cataract": {"kind": "preset", "name": "cataract"},
    "keratoconus": {"kind": "preset", "name": "keratoconus"},
}


def prepared(body, **settings):
    """A renderer with the store of an eye."""
    given = {
        "mode": "dynamic",
        "tolerance": "loose",
        "pupil_range_mm": (1.0, 8.0),
        "focus_range_dpt": (0.0, 6.0),
        "object_range_dpt": (0.0, 4.0),
    }
    spec = GridSpec(CAMERA, FilterSettings(**(given | settings)))
    eye, notes = eye_for_spec(parse_profile(body), spec)
    renderer = NativeRenderer()
    return renderer, renderer.load(build_psf_store(eye, spec)), notes


def scene(rng):
    color = rng.random((HEIGHT, WIDTH, 3)).astype(np.float32)
    depth_m = np.where(np.arange(WIDTH) < WIDTH // 2, 0.5, np.inf)
    depth_m = np.broadcast_to(depth_m, (HEIGHT, WIDTH)).astype(np.float32)
    return RgbdView(color, np.ascontiguousarray(depth_m), CAMERA.tangents)


OFTEN = ("+20 dpt worn", "keratoconus")


@pytest.mark.long("an eye is traced and planned over its widest ranges")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in OFTEN))
        for name in HARD
    ],
)
def test_hard_eyes_are_finite_and_smooth_through_sweeps(rng, name):
    renderer, handle, _ = prepared(HARD[name])
    view = scene(rng)
    for states in (
        [(pupil_mm, 1.0) for pupil_mm in np.linspace(1.0, 8.0, 29)],
        [(4.0, focus_dpt) for focus_dpt in np.linspace(0.0, 6.0, 25)],
    ):
        pictures = []
        for pupil_mm, focus_dpt in states:
            seen = renderer.render(
                view, handle, pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt
            )
            assert np.isfinite(seen.color).all()
            assert seen.color.min() >= -1e-6
            assert seen.color.max() <= 1.0 + 1e-3
            pictures.append(seen.color.astype(np.float64))
        steps = np.array(
            [np.sqrt(np.mean((b - a) ** 2)) for a, b in pairwise(pictures)]
        )
        # no step stands out: the largest is within a few of its neighbors
        beside = np.maximum(np.roll(steps, 1), np.roll(steps, -1))[1:-1]
        assert np.all(steps[1:-1] <= 3.0 * beside + 2e-3), steps


@pytest.mark.parametrize("display", ["550,550,550", "400,700,550", "700,550,400"])
def test_any_display_is_filtered(rng, display):
    body = {"kind": "preset", "name": "keratoconus"}
    renderer, handle, _ = prepared(
        body,
        mode="on-axis",
        display=display,
        pupil_range_mm=(4.0, 4.0),
        focus_range_dpt=(1.0, 1.0),
    )
    view = scene(rng)
    seen = renderer.render(view, handle, pupil_diameter_mm=4.0, focus_dpt=1.0)
    assert np.isfinite(seen.color).all()
    if display == "550,550,550":
        gray = RgbdView(
            np.repeat(view.color[..., :1], 3, axis=2), view.depth_m, view.tangents
        )
        seen = renderer.render(gray, handle, pupil_diameter_mm=4.0, focus_dpt=1.0)
        assert np.ptp(seen.color, axis=2).max() < 1e-3  # one light for all three


def test_blur_beyond_all_kernels_is_refused_in_words():
    telescope = Camera(WIDTH, HEIGHT, (-0.002, 0.002, 0.0013, -0.0013))
    settings = FilterSettings(
        mode="on-axis", pupil_range_mm=(8.0, 8.0), focus_range_dpt=(0.0, 0.0)
    )
    spec = GridSpec(telescope, settings)
    eye, _ = eye_for_spec(parse_profile(HARD["-20 dpt"]), spec)
    with pytest.raises(
        (ValueError, GridTooLarge), match=r"smaller pupil|fewer pixels|even mode"
    ):
        build_psf_store(eye, spec)


def test_an_eye_that_nobody_has_is_named():
    for name in ("-20 dpt", "+20 dpt"):
        settings = FilterSettings(
            mode="on-axis", pupil_range_mm=(3.0, 3.0), focus_range_dpt=(0.0, 0.0)
        )
        _, notes = eye_for_spec(parse_profile(HARD[name]), GridSpec(CAMERA, settings))
        assert any("unusual for a person" in note for note in notes)


def test_pupils_are_traced_up_to_the_limit_of_the_setting():
    settings = FilterSettings(
        mode="on-axis", pupil_range_mm=(8.2, 9.0), focus_range_dpt=(0.0, 0.0)
    )
    eye, _ = eye_for_spec(
        parse_profile({"kind": "preset", "name": "emmetropia"}),
        GridSpec(CAMERA, settings),
    )
    assert eye.usable_pupil_mm(9.0) == pytest.approx(9.0)
    notes = eye.notes(pupil_diameter_mm=9.0, focus_dpt=0.0)
    assert "pupil_capped" not in [note.code for note in notes]
