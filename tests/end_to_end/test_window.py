"""The live window and the stream into it, on a virtual X display."""

import os
import shutil
import subprocess
import sys

import pytest

from clients.service_process import CHECKOUT

pytestmark = pytest.mark.clock

SHOW_AND_READ_BACK = """
import glfw, numpy as np
from clients.scene_renderer import SceneRenderer
from clients.scenes.catalog import build_scene
from clients.window import LiveWindow, _close_on_escape

scene = build_scene("primitives")
with LiveWindow((161, 91), "test") as window, SceneRenderer(scene, (161, 91)) as view:
    for step in range(2):  # the two kinds of GL context take turns
        pose = np.eye(4)
        pose[0, 3] = 0.02 * step
        color, _ = view.render(pose)
        assert window.show(color, 255 - color, "title")
        shown = window.shown()
        assert (shown[:, :161] == color).all(), "the left picture is not the input"
        assert (shown[:, 161:] == 255 - color).all(), "the right one is not the other"
    _close_on_escape(window._window, glfw.KEY_A, 0, glfw.PRESS, 0)
    assert window.show(color, color)
    _close_on_escape(window._window, glfw.KEY_ESCAPE, 0, glfw.PRESS, 0)
    assert not window.show(color, color)
"""

STREAM_UNTIL_ESCAPE = """
import glfw
from clients import pyrender_stream, window

class Watched(window.LiveWindow):
    n_shown = 0

    def show(self, left, right, title=None):
        Watched.n_shown += 1
        if Watched.n_shown == 4:  # "preparing" and three answers
            window._close_on_escape(self._window, glfw.KEY_ESCAPE, 0, glfw.PRESS, 0)
        return super().show(left, right, title)

window.LiveWindow = Watched
try:
    pyrender_stream.main()
finally:
    assert Watched.n_shown == 4, Watched.n_shown
"""


@pytest.fixture(scope="module")
def display():
    """The name of a virtual X display."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed (apt-get install xvfb): no display to open")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1280x800x24"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as server:
        yield f":{server.stdout.readline().decode().strip()}"
        server.terminate()


def _python(code, *arguments, display=None):
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    environment.pop("WAYLAND_DISPLAY", None)
    if display is not None:
        environment["DISPLAY"] = display
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *arguments],
        cwd=CHECKOUT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )


def test_window_shows_both_pictures_exactly_and_closes_on_escape(display):
    finished = _python(SHOW_AND_READ_BACK, display=display)
    assert finished.returncode == 0, finished.stderr


@pytest.mark.parametrize(
    "renderer", ["own", pytest.param("pyrender", marks=pytest.mark.clients)]
)
def test_live_stream_shows_answers_until_escape(display, real_service, renderer):
    finished = _python(
        STREAM_UNTIL_ESCAPE,
        "--window",
        *("--endpoint", real_service.endpoint),
        *("--scene", "primitives", "--size", "96x54", "--frames", "5"),
        *("--renderer", renderer),
        display=display,
    )
    assert finished.returncode == 0, finished.stderr
    assert "frames filtered" in finished.stdout


def test_missing_display_is_said_in_one_line():
    finished = _python(
        "from clients.pyrender_stream import main; main()",
        *("--window", "--scene", "primitives"),
    )
    assert finished.returncode == 1
    assert finished.stderr.count("\n") == 1
    assert "no window can be opened" in finished.stderr
