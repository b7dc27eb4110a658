"""Quads and head-locked layers are filtered at their distance."""

import numpy as np
import pytest

from clients.headset.stereo_gaze import RgbdPicture
from clients.openxr_layer import wire
from clients.openxr_layer.quads import Quad, light_of
from filter_service import FilterSettings
from tests.end_to_end.layer_double import RunningHelper
from tests.openxr_layer.captured import drawn, pixels_of
from tests.openxr_layer.layered import LONG_MS, frozen_eyes
from tests.openxr_layer.test_layer import Stage, check_clean, kind_of
from tests.openxr_layer.test_layer_programs import (
    PROFILES,
    SETTINGS,
    filtered_by_hand,
)
from tests.openxr_layer.test_layer_vulkan import VALIDATION, VulkanStage, check_valid
from tests.unit.test_layer_quads import over_by_rays

N_FRAMES, SIZE_PX = 20, (64, 48)
QUAD_PX, QUAD_M, SCENE_M = 64, 0.3, 2.0
HEAD = "0.1 0.05 0 0 0.0998334 0 0.9950042"  # turned to the left by 11.5 degrees
QUICK = SETTINGS | {"mode": "on-axis", "eye_model": "wavefront"}  # to prepare
SHOWN = {"MOCK_XR_RATE_HZ": "60", "MOCK_XR_SIZE": "64x48"}


@pytest.fixture
def stage(request, layer, runtime, driver, tmp_path):
    """Return a stage of an API, which the test names."""
    if request.param == "Vulkan" and not VALIDATION.exists():
        pytest.skip("no Vulkan here")
    kind = VulkanStage if request.param == "Vulkan" else Stage
    (tmp_path / "head.txt").write_text(HEAD)
    return kind(layer, runtime, driver, tmp_path)


def run(stage, case, **variables):
    head = {"MOCK_XR_HEAD": str(stage.folder / "head.txt")}
    ran = stage.run(case, n_frames=N_FRAMES, **SHOWN, **head, **variables)
    check = check_valid if isinstance(stage, VulkanStage) else check_clean
    check(ran, N_FRAMES)
    return ran


def quad_of(number, case, head):
    """Return the quad of a frame of the driver."""
    color = drawn(number, 2, (QUAD_PX, QUAD_PX))
    alpha = np.round(255.0 * np.arange(QUAD_PX) / QUAD_PX)
    alpha = np.broadcast_to(alpha[None, :, None], (QUAD_PX, QUAD_PX, 1))
    raw = np.concatenate([color, alpha], axis=2).astype(np.uint8)
    flags = wire.IS_BLENDED | wire.IS_UNPREMULTIPLIED if case == "quad-alpha" else 0
    pose = (0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0)
    if case == "quad-locked":
        x, y, z, qx, qy, qz, qw = map(float, head.split())
        # One meter ahead of the head, which is turned about y.
        ahead = np.array([-2.0 * qy * qw, 0.0, -(1.0 - 2.0 * qy * qy)])
        pose = (x + ahead[0], y, z + ahead[2], qx, qy, qz, qw)
    light = light_of(raw, wire.SRGB8, flags)
    return Quad(pose, (QUAD_M, QUAD_M), light, ("left", "right"))


def composed(number, index, view, quad):
    """Return the picture of a view with its quad, ray by ray."""
    color = np.ascontiguousarray(drawn(number, index, SIZE_PX)[::-1])
    depth_m = np.full(color.shape[:2], SCENE_M, np.float32)
    if quad is not None:
        color, depth_m = over_by_rays(color, depth_m, view, quad)
    return RgbdPicture(view, color, depth_m)


with_opengl = pytest.mark.parametrize("stage", ["OpenGL"], indirect=True)
with_both = pytest.mark.parametrize("stage", ["OpenGL", "Vulkan"], indirect=True)


@pytest.mark.parametrize(
    ("stage", "case"),
    [
        ("OpenGL", "quad-above"),
        ("OpenGL", "quad-locked"),
        ("Vulkan", "quad-above"),
        ("Vulkan", "quad-alpha"),
        ("Vulkan", "view-locked"),
    ],
    indirect=["stage"],
)
def test_quads_are_seen_as_the_eye_filter_sees_them(stage, case):
    inputs = {}
    make_eyes = frozen_eyes(PROFILES, FilterSettings(**QUICK))
    with RunningHelper(stage.path, make_eyes, wait_ms=LONG_MS) as helper:
        helper.helper.on_frame = lambda frame, _: inputs.setdefault(
            frame.due.display_time_ns, frame
        )
        ran = run(stage, case)
    told, frame = list(ran.pairs())[-1]
    given = inputs[frame["display_time"]]
    # The quad is in the projection, and no layer of its own.
    (layer,) = frame["layers"]
    assert layer["space"]["kind"] == ("VIEW" if case == "view-locked" else "LOCAL")
    quad = None
    if case.startswith("quad"):
        quad = quad_of(told["frame"], case, HEAD)
    n_changed = 0
    for index, (view, picture) in enumerate(
        zip(layer["views"], given.pictures, strict=True)
    ):
        wanted = composed(told["frame"], index, picture.view, quad)
        assert np.abs(wanted.color.astype(int) - picture.color).max() <= 1
        expected = filtered_by_hand(picture.view.eye, wanted, QUICK)
        found = pixels_of(ran.folder, view)[::-1, :, :3].astype(int)
        assert np.abs(found - expected).max() <= 1
        plain = composed(told["frame"], index, picture.view, None)
        n_changed += (plain.color != wanted.color).any(axis=2).sum()
    assert n_changed > 40 or quad is None


@with_both
def test_a_quad_is_left_by_option(stage):
    with stage.helper(leave_quads=True):
        ran = run(stage, "quad-above")
    told, frame = list(ran.pairs())[-1]
    projection, quad = frame["layers"]
    pixels = pixels_of(ran.folder, quad)
    assert kind_of(quad, pixels, told["frame"], 2) == "own"
    view = projection["views"][0]
    assert kind_of(view, pixels_of(ran.folder, view), told["frame"], 0) == "filtered"


@with_opengl
def test_without_a_helper_a_quad_is_the_own(stage):
    ran = run(stage, "quad-above")
    assert [len(frame["layers"]) for frame in ran.frames] == [2] * N_FRAMES
