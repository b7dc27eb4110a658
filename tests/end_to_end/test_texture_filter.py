"""`EyeFilter` in the OpenGL context of its caller."""

import time

import numpy as np
import pytest

from filter_service import (
    BadMessage,
    Camera,
    DepthProjection,
    EyeFilter,
    GlTexture,
    RgbdView,
    TextureView,
)
from filter_service.errors import RenderFailed
from tests.numerical.gl_textures import Textures, callers_context
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import assert_same_frame
from tests.numerical.test_gl_objects import counted_objects

pytestmark = pytest.mark.gl

SIZE_PX = WIDTH, HEIGHT = 160, 90
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5, "bright_pixels": False}
"""Frames in arrays otherwise contain the light beyond kernels."""

SETTINGS = {"mode": "dynamic", "tolerance": "loose"}
NEAR_M = 0.05


@pytest.fixture(scope="module")
def scene():
    return scene_view("courtyard", width_px=WIDTH, height_px=HEIGHT)


def texture_view(textures, scene):
    """The scene as a renderer leaves it: sRGB and a depth buffer, last row first."""
    rgba = np.dstack([scene.color, np.full(scene.depth_m.shape, 255, np.uint8)])
    value = NEAR_M / scene.depth_m  # reversed, to infinity
    return TextureView(
        textures.new("srgb8_a8", SIZE_PX, rgba[::-1]),
        textures.new("d32f", SIZE_PX, value[::-1]),
        *SIZE_PX,
        scene.tangents,
        DepthProjection(NEAR_M, is_reversed=True),
    )


def frame_of(eye, view, target, **state):
    """Submit frames until one is filtered."""
    until_s = time.monotonic() + 60.0
    while time.monotonic() < until_s:
        shown = eye.filter_textures(view, target, **(STATE | state))
        if shown:
            return shown
        time.sleep(0.01)
    raise AssertionError("the eye is never ready")


def shown_image(textures, target):
    return textures.read(target, SIZE_PX)[::-1, :, :3].astype(int)


@pytest.mark.brief
@pytest.mark.long("three filters build eyes")
def test_frames_are_those_of_arrays(scene):
    with callers_context():
        textures = Textures()
        view, target = texture_view(textures, scene), textures.new("rgba8", SIZE_PX)
        camera = scene.camera
        with EyeFilter("myopia", camera, SETTINGS, gl_context="current") as eye:
            shown = frame_of(eye, view, target)
            assert shown.generation == 1
            assert shown.earlier.is_filtered
            expected = eye.filter(scene, **STATE)
            found = shown_image(textures, target)
            assert np.abs(found - expected.color).max() <= 1
            eye.set_profile("keratoconus")
            later = eye.filter_textures(view, target, **STATE)
            assert later.generation == 1  # until the new eye is ready
            assert np.abs(shown_image(textures, target) - found).max() <= 1
            while later.generation == 1:
                later = frame_of(eye, view, target)
                time.sleep(0.01)
            expected = eye.filter(scene, whole=True, **STATE)
            for _ in range(100):
                frame_of(eye, view, target)
                if np.abs(shown_image(textures, target) - expected.color).max() <= 1:
                    break
            else:
                raise AssertionError("PSFs stay missing")
        with EyeFilter("myopia", camera, SETTINGS) as own:  # in a context of its own
            first = own.filter(scene, **STATE)
        assert np.abs(found - first.color).max() <= 2


def test_two_eyes_share_a_context(scene):
    with callers_context():
        textures = Textures()
        view = texture_view(textures, scene)
        targets = [textures.new("srgb8_a8", SIZE_PX) for _ in range(2)]
        before = counted_objects()
        eyes = [
            EyeFilter(name, scene.camera, SETTINGS, gl_context="current")
            for name in ("emmetropia", "myopia")
        ]
        for _ in range(3):
            for eye, target in zip(eyes, targets, strict=True):
                frame_of(eye, view, target)
        for eye, target in zip(eyes, targets, strict=True):
            expected = eye.filter(scene, **STATE).color
            assert np.abs(shown_image(textures, target) - expected).max() <= 1
            eye.close()
        assert counted_objects() == before


def test_lists_may_grow_between_a_frame_and_the_reading_of_its_counters(scene):
    with callers_context():
        textures = Textures()
        view, target = texture_view(textures, scene), textures.new("rgba8", SIZE_PX)
        with EyeFilter("myopia", scene.camera, SETTINGS, gl_context="current") as eye:
            frame_of(eye, view, target)  # waits for its counters
            eye.filter_textures(view, target, **STATE)
            gpu = eye.builder.engine._gpu
            for name in ("ENTRIES", "ENTRIES_SPARE"):  # as another eye's frame does
                gpu.storage(name, 2 * gpu.buffers[name].size)
            gpu.wait()
            first = frame_of(eye, view, target)
            later = frame_of(eye, view, target)
            assert later.earlier.number > first.earlier.number
            assert later.earlier.is_filtered


def test_what_textures_cannot_have_is_refused(scene):
    with callers_context():
        textures = Textures()
        view, target = texture_view(textures, scene), textures.new("rgba8", SIZE_PX)
        cloudy = {"kind": "preset", "name": "emmetropia", "straylight": {}}
        with EyeFilter(cloudy, scene.camera, SETTINGS, gl_context="current") as eye:
            with pytest.raises(BadMessage, match="straylight"):
                frame_of(eye, view, target)
            assert eye.filter(scene, **STATE).color.shape == scene.color.shape
        with (
            EyeFilter("myopia", scene.camera, engine="gl") as own,
            pytest.raises(RenderFailed, match="gl_context='current'"),
        ):
            own.filter_textures(view, target, **STATE)
        with EyeFilter("myopia", scene.camera, gl_context="current") as eye:
            for wrong in ({"pupil_diameter_mm": 0.0}, {"focus_dpt": np.nan}):
                with pytest.raises(BadMessage):
                    eye.filter_textures(view, target, **(STATE | wrong))
            with pytest.raises(BadMessage, match="allowed: an existing texture"):
                for _ in range(6000):
                    eye.filter_textures(view, GlTexture(9999, "rgba8"), **STATE)
                    time.sleep(0.01)
    with pytest.raises(RenderFailed, match="no OpenGL context is current"):
        EyeFilter("myopia", scene.camera, gl_context="current")
    with pytest.raises(BadMessage, match="own or current"):
        EyeFilter("myopia", scene.camera, gl_context="mine")


def test_a_context_that_is_gone_is_an_error_and_no_crash(scene):
    with callers_context():
        textures = Textures()
        view, target = texture_view(textures, scene), textures.new("rgba8", SIZE_PX)
        eye = EyeFilter("myopia", scene.camera, SETTINGS, gl_context="current")
        frame_of(eye, view, target)
    with pytest.raises(RenderFailed, match="not current"):
        eye.filter_textures(view, target, **STATE)
    eye.close()
    with callers_context():
        textures = Textures()
        view, target = texture_view(textures, scene), textures.new("rgba8", SIZE_PX)
        with EyeFilter("myopia", scene.camera, SETTINGS, gl_context="current") as eye:
            frame_of(eye, view, target)


@pytest.mark.parametrize("where", ["native", "context of the caller"])
def test_frames_begun_early_are_those_of_filter(scene, where):
    """Also if a new eye is prepared meanwhile, which retires the stores of the old."""
    views = [
        RgbdView(
            np.ascontiguousarray(np.roll(scene.color, 9 * k, axis=1)),
            np.ascontiguousarray(np.roll(scene.depth_m, 9 * k, axis=1)),
            scene.tangents,
        )
        for k in range(4)
    ]
    states = [
        {"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt}
        for pupil_mm, focus_dpt in ((4.0, 0.5), (4.2, 0.7), (4.2, 0.7), (3.8, 0.2))
    ]
    engine = {"engine": "native"} if where == "native" else {"gl_context": "current"}
    with (
        callers_context(),
        EyeFilter("myopia", scene.camera, SETTINGS, **engine) as eye,
    ):
        expected = [
            eye.filter([view], **state).color
            for view, state in zip(views, states, strict=True)
        ]
        begun = [
            eye.begin([view], **state)
            for view, state in zip(views, states, strict=True)
        ]
        eye.set_profile("emmetropia")
        eye.wait()
        other = eye.filter([views[0]], whole=True, **states[0]).color
        for finish, color in zip(begun, expected, strict=True):
            assert_same_frame(finish().color, color, is_exact=where == "native")
        assert (other != expected[0]).any()
        stored = len(eye.prepared_stores)
        eye.filter([views[0]], **states[0])  # frees what is no longer used
        assert len(eye.prepared_stores) == stored == 1


@pytest.mark.long("an eye is built, with wide kernels")
@pytest.mark.parametrize(
    ("distance_m", "is_limited"),
    [(4.0, False), pytest.param(0.11, True, marks=pytest.mark.slow)],
)
def test_a_frame_reports_the_largest_kernel_only_if_it_exceeds_it(
    distance_m, is_limited
):
    """With pixels of 0.2 arcmin, the prepared range to 10 dpt does, too."""
    camera = Camera.from_intrinsics(
        *(17200.0, 17200.0, WIDTH / 2, HEIGHT / 2), width_px=WIDTH, height_px=HEIGHT
    )
    color = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    depth_m = np.full((HEIGHT, WIDTH), distance_m, np.float32)
    plain = RgbdView(color, depth_m, camera.tangents)
    profile = {"kind": "prescription", "sphere_dpt": 0.0}
    state = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.25}
    with callers_context():
        textures = Textures()
        view, target = texture_view(textures, plain), textures.new("rgba8", SIZE_PX)
        with EyeFilter(profile, camera, SETTINGS, gl_context="current") as eye:
            found = [frame_of(eye, view, target, **state), eye.filter(plain, **state)]
    for frame in found:
        assert ("blur_limited" in [note.code for note in frame.notes]) == is_limited
