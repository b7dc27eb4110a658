"""`ocufilter headset` in a real runtime: frames, poses, eyes, and what goes wrong.

Started by `run_in_root.sh`, like test_runtime.py.
"""

import contextlib
import os
import shutil
import time

import numpy as np
import pytest

from tests.headset.monado import Monado, Pose, RemoteHead
from tests.headset.program import Program
from tests.headset.rooms import stripes
from tests.headset.test_runtime import EYES, HEADS, SOON, pose_error
from tests.page_commands import ways_in

N_FRAMES = 300
LONG = "100000"
LOOSE = '{"tolerance": "loose", "object_range_dpt": [0, 1]}'
CONTRAST = 0.25  # of the stripes that a sharp eye sees


class Viewer(Program):
    """One run of `watched_viewer`."""

    def __init__(self, monado: Monado, folder, *arguments: str):
        module = "tests.headset.watched_viewer"
        super().__init__(folder, monado.environment, "-m", module, *arguments)

    def frames(self):
        """Yield what was asked for and shown, frame by frame."""
        for line in self.lines():
            if "frame" in line:
                yield line["frame"]

    def await_frame(self, is_wanted):
        """Return the first frame that is."""
        for frame in self.frames():
            if is_wanted(frame):
                return frame
        raise AssertionError(f"it ended before that: {self.said[-2000:]}")


@pytest.fixture
def room(tmp_path):
    return str(stripes(tmp_path / "room.glb"))


def contrast(row, middle=0.5):
    """Return how far the light of a row's middle goes up and down, 0 to 1."""
    row = np.asarray(row, float)
    n = len(row)
    part = row[int(n * (middle - 0.15)) : int(n * (middle + 0.15))]
    return (np.percentile(part, 95) - np.percentile(part, 5)) / 255.0


def is_filtered(frame):
    """Return whether the right eye, a myope's of -8 dpt, sees no stripes."""
    return len(frame["rows"]) == 2 and contrast(frame["rows"][1]) < CONTRAST


EYES_APART = (
    "--left",
    "emmetropia",
    "--right",
    '{"kind": "prescription", "sphere_dpt": -8}',
    "--pupil-mm",
    "4",
    "--settings",
    LOOSE,
)


def test_frames_with_both_layers_are_taken_and_eyes_differ(started, tmp_path, room):
    arguments = ("--scene", room, "--validate", "--frames", str(N_FRAMES), *EYES_APART)
    with Viewer(started(), tmp_path, *arguments) as viewer:
        lines = list(viewer.lines())
        complaints = viewer.complaints()
    (session,) = [line["session"] for line in lines if "session" in line]
    assert session["has_depth"]
    (report,) = [line for line in lines if "filtered" in line]
    assert report["filtered"] == N_FRAMES
    assert report["repeated"] == 0
    frames = [line["frame"] for line in lines if "frame" in line]
    shown = [frame for frame in frames if frame["shown"]]
    assert len(shown) >= N_FRAMES
    assert shown[-1]["state"] == "FOCUSED"
    assert complaints == []
    for frame in shown:
        assert [view["pose"] for view in frame["shown"]] == [
            view["pose"] for view in frame["asked"]
        ]
    left, right = shown[-1]["rows"]
    assert contrast(left) > 2 * CONTRAST
    assert contrast(right) < CONTRAST


def test_the_printed_line_shows_a_scene(started, tmp_path):
    (command,) = (c for c in ways_in()["OpenXR"] if c.is_one_of(["headset"]))
    brief = ("--frames", "30", "--scale", "0.2")
    with Viewer(started(), tmp_path, *command.arguments[1:], *brief) as viewer:
        lines = list(viewer.lines())
        assert viewer.exit_code() == 0, viewer.said
    (report,) = [line for line in lines if "filtered" in line]
    assert report["filtered"] == 30
    assert "myopia" in viewer.said and "keratoconus" in viewer.said


def test_views_are_where_the_headset_is(started, tmp_path, room):
    monado = started(remote=True)
    arguments = ("--scene", room, "--frames", LONG, "--scale", "0.2", *EYES_APART)
    with RemoteHead() as remote, Viewer(monado, tmp_path, *arguments) as viewer:
        viewer.await_frame(is_filtered)
        frames = viewer.frames()
        worst = 0.0
        # LOCAL's origin is where the head was when the session began.
        for head in HEADS:
            remote.move(head, EYES)
            for _ in range(SOON + 2):
                frame = next(frames)
            shown = [as_located(view) for view in frame["shown"]]
            apart = pose_error(shown, head)
            worst = max(worst, apart)
    assert worst < 1e-4


def as_located(view):
    x, y, z, *orientation = view["pose"]
    return {
        "position_m": (x, y + 1.6, z),
        "orientation": orientation,
        "angles_deg": np.degrees(np.arctan(view["tangents"])).tolist(),
    }


def test_the_screen_shows_what_each_eye_sees(started, tmp_path, room):
    monado = started(remote=True, screen=True)  # a head that keeps still
    arguments = ("--scene", room, "--frames", LONG, *EYES_APART)
    with Viewer(monado, tmp_path, *arguments) as viewer:
        viewer.await_frame(is_filtered)
        frames = viewer.frames()
        for _ in range(6):
            next(frames)
        screen = monado.screenshot()
    from PIL import Image

    Image.fromarray(screen).save(tmp_path / "screen.png")
    keep = os.environ.get("HEADSET_SCREENSHOTS")
    if keep:
        shutil.copy(tmp_path / "screen.png", keep)
    left, right = np.split(screen, 2, axis=1)
    assert contrast(left[len(left) // 2, :, 1]) > 2 * CONTRAST
    assert contrast(right[len(right) // 2, :, 1]) < CONTRAST


def test_a_runtime_that_dies_is_waited_for(started, tmp_path, room):
    monado = started()
    arguments = ("--scene", room, "--frames", LONG, *EYES_APART)
    with Viewer(monado, tmp_path, *arguments) as viewer:
        viewer.await_frame(is_filtered)
        monado.kill()
        time.sleep(2.5)
        monado.restart()
        # The eyes are still there: the first frame that is shown is filtered.
        frame = viewer.await_frame(lambda frame: frame["shown"])
        while frame is not None and not is_filtered(frame):
            frame = viewer.await_frame(lambda frame: frame["shown"])
        said = viewer.said
    assert "lost the OpenXR runtime" in said
    assert "does not respond" in said
    assert said.count("Monado") >= 2


@pytest.fixture
def service(tmp_path):
    """Return how to start the filter service, and its endpoint."""
    from clients.service_process import ServiceProcess

    bind = f"ipc://{tmp_path}/service"
    with contextlib.ExitStack() as stack:

        def start():
            return stack.enter_context(
                ServiceProcess({"bind": bind}, start_timeout_s=60.0)
            )

        yield start, bind


def test_through_a_service_pictures_keep_their_poses(started, tmp_path, room, service):
    start, endpoint = service
    start()
    monado = started(remote=True)
    arguments = ("--scene", room, "--frames", "60", "--scale", "0.2", *EYES_APART)
    asked, shown, n_shown = set(), set(), 0
    with RemoteHead() as remote:
        remote.move(Pose((0.0, 1.6, 0.0)), EYES)
        with Viewer(
            monado, tmp_path, *arguments, "--service", endpoint, "--validate"
        ) as viewer:
            for line in viewer.lines():
                if "filtered" in line:
                    report = line
                if "frame" not in line:
                    continue
                frame = line["frame"]
                side_m = 0.05 * np.sin(0.3 * len(asked))
                remote.move(Pose((side_m, 1.6, 0.0)), EYES)
                asked |= {tuple(view["pose"]) for view in frame["asked"]}
                if is_filtered(frame):
                    n_shown += 1
                    poses = {tuple(view["pose"]) for view in frame["shown"]}
                    assert poses <= asked, "not one that was ever asked for"
                    shown |= poses
            complaints = viewer.complaints()
    assert report["filtered"] == 60
    assert n_shown >= 50
    assert len(shown) > 50, "the head moves"
    assert complaints == []


def test_a_service_that_dies_and_comes_back(started, tmp_path, room, service):
    start, endpoint = service
    first = start()
    arguments = ("--scene", room, "--frames", LONG, "--service", endpoint, *EYES_APART)
    with Viewer(started(), tmp_path, *arguments) as viewer:
        viewer.await_frame(is_filtered)
        first.kill()
        # The scene as it is, not the last picture.
        viewer.await_frame(lambda frame: frame["shown"] and not is_filtered(frame))
        frames = viewer.frames()
        assert not any(is_filtered(next(frames)) for _ in range(20))
        start()
        viewer.await_frame(is_filtered)
        said = viewer.said
    assert "no filter service" in said
    assert "connected to the filter service" in said
