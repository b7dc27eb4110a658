"""Headset frames that stay in textures, from the renderer to the shown image."""

import importlib
import json
import time
from functools import cache

import moderngl
import numpy as np
import pytest
from PIL import Image

from clients.headset.runtime import (
    DueFrame,
    ShownView,
    SimulatedRuntime,
    eye_views,
    still,
    swaying,
    upright,
)
from clients.headset.scenery import Presenter, SceneScenery, viewpoint
from clients.headset.stereo_filter import LocalFilter, StereoFrame
from clients.headset.stereo_gaze import RgbdPicture, StereoGaze, images_of
from clients.scenes.catalog import build_scene
from clients.scenes.scene_view import open_context, read_texture
from filter_service import FilterSettings
from filter_service.gl import current_context
from tests.commands import run_command
from tests.end_to_end.headset_doubles import viewer_of
from tests.numerical.gl_calls import CountedContext

pytestmark = pytest.mark.gl

SIZE_PX = (96, 108)
SETTINGS = FilterSettings(pupil_range_mm=(3.0, 5.0), tolerance="loose")
PROFILES = {"left": "myopia", "right": "keratoconus"}


@cache
def courtyard():
    return build_scene("courtyard")


WAIT_S = 90.0


def profile_of(name):
    return {"kind": "preset", "name": name}


class Headset:
    """Renderer, gaze and filter of both eyes in one context."""

    def __init__(self, context, profiles=PROFILES):
        self.said = []
        self.scenery = SceneScenery(
            context, courtyard(), upright(viewpoint(courtyard())), supersampling=1
        )
        self.seeing = LocalFilter(SETTINGS, self.said.append, context)
        self.look = StereoGaze(age_years=30.0)
        for eye, name in profiles.items():
            self.seeing.change(eye, profile_of(name))

    def frame(self, at_s=0.0, head=still):
        """Render and filter a frame."""
        views = eye_views(head(at_s))
        due = DueFrame(int(1e9 * at_s), True, views, head(at_s))
        pictures = self.scenery.pictures(views, SIZE_PX)
        known = [self.seeing.known(picture) for picture in pictures]
        eyes = self.look.follow(due, pictures, known)
        return self.seeing.see(StereoFrame(due, pictures, eyes, time.monotonic()))

    def until_filtered(self):
        """Wait until both eyes are ready, and filter a frame."""
        until_s = time.monotonic() + WAIT_S
        while time.monotonic() < until_s:
            seen = self.frame()
            if seen is not None and None not in seen.used_focus_dpt:
                return seen
            time.sleep(0.01)
        raise AssertionError("the eyes are never ready")

    def close(self):
        self.seeing.close()
        self.scenery.close()


@pytest.fixture
def context():
    found = open_context(430)
    yield found
    found.release()


def test_pictures_are_those_of_arrays(context):
    headset = Headset(context)
    seen = headset.until_filtered()
    for _ in range(6):
        last = headset.frame()
    with context:
        found = [read_texture(color)[..., :3] for color in last.colors]
    pictures, views = last.frame.pictures, last.frame.views
    for n, picture in enumerate(pictures):
        state = last.frame.eyes[n].state
        with context:
            expected = headset.seeing.filters[picture.view.eye].filter(
                views[n],
                pupil_diameter_mm=state.pupil_diameter_mm,
                focus_dpt=state.focus_dpt,
                gaze_deg=last.frame.eyes[n].gaze_deg,
                bright_pixels=False,  # as in textures
            )
        assert np.abs(found[n].astype(int) - expected.color).max() <= 1
        assert (found[n] != picture.color).any()
    assert seen.notes == last.notes
    assert set(last.stages_ms) == {"filter_ms", "around_ms"}
    headset.close()


def test_eyes_follow_an_earlier_image_without_reading_this_one(context):
    headset = Headset(context)
    headset.until_filtered()
    for k in range(8):
        seen = headset.frame(k / 72.0, swaying)
    known = [headset.seeing.known(picture) for picture in seen.frame.pictures]
    for own, earlier in zip(seen.frame.pictures, known, strict=True):
        assert isinstance(earlier, RgbdPicture)
        assert earlier.view.eye == own.view.eye
        assert earlier.view.pose != own.view.pose
        assert earlier.depth_m.size < 0.02 * SIZE_PX[0] * SIZE_PX[1]
        assert "_arrays" not in vars(own), "the image was read"
    headset.close()


def test_an_eye_with_straylight_is_filtered_in_arrays(context):
    headset = Headset(context, {"left": "emmetropia", "right": "emmetropia"})
    headset.seeing.change(
        "right", {"kind": "preset", "name": "emmetropia", "straylight": {}}
    )
    seen = headset.until_filtered()
    assert all(isinstance(color, np.ndarray) for color in seen.colors)
    assert any("straylight" in line for line in headset.said)
    headset.seeing.change("right", profile_of("myopia"))
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        seen = headset.frame()
        if seen is not None and isinstance(seen.colors[0], moderngl.Texture):
            break
    else:
        raise AssertionError("frames stay in arrays")
    headset.close()


def stereo_frames(headset, presenter, target, count):
    """Filter frames of a moving head and draw them, as a session does."""
    for k in range(count):
        seen = headset.frame(k / 90.0, swaying)
        for color, picture in zip(seen.colors, seen.frame.pictures, strict=True):
            plain, depth_m = images_of(picture)
            shown = ShownView(picture.view, color, depth_m, plain, 0.5)
            presenter.draw(shown, target)


def test_a_frame_transfers_no_image_and_waits_for_nothing(monkeypatch):
    """Renderer, gaze, focus, pupils, filter and the headset's image: all of a frame."""
    courtyard()  # its shadow maps leave no context current
    real = open_context(430)
    with real:
        counted = CountedContext()
        importlib.import_module("filter_service.gl.gpu")  # with the class, not this:
        monkeypatch.setattr(current_context, "CurrentContext", lambda: counted)
        context = moderngl.create_context(context=counted, require=430)
        target = context.framebuffer([context.texture(SIZE_PX, 4)])
        presenter, headset = Presenter(context, SIZE_PX), Headset(context)
        headset.until_filtered()
        stereo_frames(headset, presenter, target, 15)
        context.finish()
        counted.clear()
        count = 8
        stereo_frames(headset, presenter, target, count)
        image_bytes = SIZE_PX[0] * SIZE_PX[1]
        assert counted.waits == []
        assert counted.images == []
        assert counted.largest("down") < image_bytes
        assert counted.largest("up") <= 1 << 16
        assert counted.total("up") <= count << 16
        assert counted.calls["glDispatchComputeIndirect"] >= 2 * count
        # One read of an image is enough to fail.
        headset.scenery.pictures(eye_views(still(0.0)), SIZE_PX)[0].image.read()
        assert counted.images
        headset.close()
    real.release()


def test_a_session_in_textures(context):
    """The viewer itself, in a simulated headset."""
    shown = []
    headset = Headset(context)
    runtime = SimulatedRuntime(
        SIZE_PX, rate_hz=500.0, on_shown=lambda due, views: shown.append(views)
    )
    viewer = viewer_of(
        runtime,
        headset.seeing,
        profiles={eye: profile_of(name) for eye, name in PROFILES.items()},
        scenery=headset.scenery,
    )
    log = viewer.run(max_frames=6, limit_s=60.0, warm_up_s=WAIT_S)
    assert log.n_filtered == 6
    assert isinstance(shown[-1][0].color, moderngl.Texture)
    assert all(len(views) == 2 for views in shown)
    headset.close()


@pytest.mark.parametrize(
    "textures", ["yes", pytest.param("no", marks=pytest.mark.slow)]
)
def test_the_command_writes_the_last_images(tmp_path, textures):
    command = [
        "headset",
        "--simulated",
        "--size",
        "96x100",
        "--frames",
        "4",
        "--seconds",
        "30",
    ]
    command += ["--textures", textures, "--left", "myopia", "--right", "myopia"]
    command += ["--settings", '{"tolerance": "loose", "pupil_range_mm": [3, 5]}']
    ran = run_command(*command, "--out", tmp_path, "--json")
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["filtered"] == 4
    for eye in ("left", "right"):
        image = np.asarray(Image.open(tmp_path / f"{eye}.png"))
        assert image.shape == (100, 96, 3)
        assert image.std() > 5.0
