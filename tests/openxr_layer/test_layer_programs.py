"""Programs that know nothing of the layer: Debian's hello_xr, and `headset`."""

import json
import shutil
import sys

import numpy as np
import pytest

from filter_service import EyeFilter, FilterSettings, RgbdView
from filter_service.messages import body_of_eye
from tests.end_to_end.layer_double import RunningHelper
from tests.headset.rooms import stripes
from tests.openxr_layer.captured import pixels_of
from tests.openxr_layer.layered import (
    FOCUS_DPT,
    LONG_MS,
    PUPIL_MM,
    frozen_eyes,
    layer_environment,
)
from tests.openxr_layer.programs import Run, run_hello_xr

SIZE_PX = (160, 180)
N_FRAMES = 30
GAZE_DEG = (4.0, -2.0)  # which frozen eyes do not follow
SETTINGS = {
    "pupil_range_mm": (PUPIL_MM, PUPIL_MM),
    "focus_range_dpt": (FOCUS_DPT, FOCUS_DPT),
    "object_range_dpt": (0.0, 2.0),
}
PROFILES = {
    "left": {"kind": "prescription", "sphere_dpt": -4.0},
    "right": {
        "kind": "prescription",
        "sphere_dpt": -2.0,
        "cylinder_dpt": -1.0,
        "axis_deg": 30.0,
    },
}

needs_hello_xr = pytest.mark.skipif(
    shutil.which("hello_xr") is None, reason="no hello_xr here"
)


@pytest.fixture
def environment(layer, tmp_path):
    own = layer_environment(layer, tmp_path, tmp_path / "layer.sock")
    return own | {"MOCK_XR_SIZE": "{}x{}".format(*SIZE_PX)}


@pytest.fixture
def moving_head(tmp_path):
    """Return a script of a head that comes to the same 20 places again and again."""
    lines = []
    for i in list(range(20)) * 1000:
        turn, aside = 0.02 * np.sin(0.3 * i), 0.05 * np.sin(0.2 * i)
        lines.append(f"{aside} 0.02 0 0 {np.sin(turn)} 0 {np.cos(turn)}")
    path = tmp_path / "head.txt"
    path.write_text("\n".join(lines))
    return str(path)


def filtered_by_hand(eye, picture, settings=SETTINGS):
    """Return what `EyeFilter` gives for a picture, as bytes of its own encoding."""
    is_srgb = picture.color.dtype == np.uint8
    body = body_of_eye(PROFILES[eye], eye)
    with EyeFilter(body, picture.camera, settings) as eye_filter:
        view = RgbdView(picture.color, picture.depth_m, picture.view.tangents)
        seen = eye_filter.filter(
            view,
            pupil_diameter_mm=PUPIL_MM,
            focus_dpt=FOCUS_DPT,
            whole=True,
            output="srgb8" if is_srgb else "linear",
        )
    color = seen.views[0].color
    if is_srgb:
        return color.astype(int)
    return np.rint(255.0 * np.clip(color, 0.0, 1.0)).astype(int)


@needs_hello_xr
def test_hello_xr_is_shown_as_the_eye_filter_sees_it(
    environment, runtime, display, tmp_path, moving_head
):
    inputs = {}
    make_eyes = frozen_eyes(PROFILES, FilterSettings(**SETTINGS))
    path = tmp_path / "layer.sock"
    with RunningHelper(path, make_eyes, wait_ms=LONG_MS) as helper:
        helper.helper.on_frame = lambda frame, _: inputs.setdefault(
            frame.due.display_time_ns, frame
        )
        own = environment | {
            "MOCK_XR_HEAD": moving_head,
            "MOCK_XR_GAZE_DEG": "{:g},{:g}".format(*GAZE_DEG),
        }
        frames, violations = run_hello_xr(runtime, tmp_path, display, N_FRAMES, **own)
    assert violations == []
    assert len(frames) >= N_FRAMES - 5
    seen = [frame for frame in frames if frame["display_time"] in inputs]
    assert len(seen) >= N_FRAMES - 8  # all but those before the connection
    assert seen == frames[-len(seen) :]
    # Its first frames come before it has synchronized its actions.
    gazes = [inputs[frame["display_time"]].due.gaze for frame in seen[10:]]
    assert [(gaze.h_deg, gaze.v_deg) for gaze in gazes] == [
        pytest.approx(GAZE_DEG, abs=1e-4)
    ] * len(gazes)
    n_blurred = 0
    for frame in (seen[0], seen[len(seen) // 2], seen[-1]):
        given = inputs[frame["display_time"]]
        for view, picture in zip(
            frame["layers"][0]["views"], given.pictures, strict=True
        ):
            assert view["format"] == "GL_RGBA8"
            assert tuple(view["pose"]) == picture.view.pose
            expected = filtered_by_hand(picture.view.eye, picture)
            found = pixels_of(tmp_path / "captured", view)[::-1, :, :3]
            assert np.abs(found - expected).max() <= 1
            unfiltered = np.rint(255.0 * picture.color.astype(float))
            n_blurred += (expected != unfiltered).mean() > 0.002
    assert n_blurred == 6


HEADSET = ("--pupil-mm", str(PUPIL_MM), "--focus-dpt", str(FOCUS_DPT))
HEADSET += ("--gaze-range", "0,0")
HEADSET += ("--settings", json.dumps(SETTINGS), "--textures", "no")
HEADSET += ("--supersampling", "1", "--frames", str(N_FRAMES))


def run_headset(module, room, runtime, folder, environment):
    """Run the headset client; return it when it has ended."""
    folder.mkdir()
    eyes = []
    for eye, body in PROFILES.items():
        eyes += [f"--{eye}", json.dumps(body)]
    command = (sys.executable, "-m", *module, "--scene", room, *HEADSET, *eyes)
    ran = Run(runtime, folder, *command, **environment)
    assert ran.exit_code == 0, ran.said
    assert ran.violations == []
    return ran


def test_the_headset_client_is_filtered_as_it_filters_itself(
    environment, runtime, tmp_path, moving_head
):
    room = str(stripes(tmp_path / "room.glb"))
    own = environment | {"MOCK_XR_HEAD": moving_head}
    make_eyes = frozen_eyes(PROFILES, FilterSettings(**SETTINGS))
    plain_viewer = ("tests.openxr_layer.plain_viewer",)
    with RunningHelper(tmp_path / "layer.sock", make_eyes, wait_ms=LONG_MS):
        through = run_headset(plain_viewer, room, runtime, tmp_path / "through", own)
    del own["XR_ENABLE_API_LAYERS"]
    viewer = ("ocufilter", "headset")
    itself = run_headset(viewer, room, runtime, tmp_path / "itself", own)
    expected = {poses_of(frame): frame for frame in itself.frames[-N_FRAMES:]}
    n_compared = 0
    for frame in through.frames[-N_FRAMES // 2 :]:  # connected
        other = expected.get(poses_of(frame))
        if other is None:
            continue
        for found, wanted in zip(
            frame["layers"][0]["views"], other["layers"][0]["views"], strict=True
        ):
            assert found["fov"] == wanted["fov"]
            pixels = pixels_of(through.folder, found)[..., :3].astype(int)
            wanted_pixels = pixels_of(itself.folder, wanted)[..., :3]
            assert np.abs(pixels - wanted_pixels).max() <= 1
            n_compared += 1
    assert n_compared >= 10


def poses_of(frame):
    """Return the poses of both eyes, bit for bit."""
    return tuple(tuple(view["pose"]) for view in frame["layers"][0]["views"])
