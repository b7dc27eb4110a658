"""The headset's client in a window's OpenGL, for runtimes that take no EGL.

    python -m tests.headset.test_glx [--frames N] [--hide-egl]

As a program it shows each eye in one color and tells in JSON what became of it; the
tests start it.  Started by `run_in_root.sh`, like test_runtime.py.
"""

import argparse
import contextlib
import json

import numpy as np
import pytest

from tests.headset.monado import Xvfb
from tests.headset.program import Program
from tests.headset.rooms import stripes

EYE_SRGB = ((200, 40, 30), (20, 60, 180))
DEPTH_M = 2.0
SCREEN_ERROR = 3  # of 255: two conversions between sRGB and linear light
EDGE_PX = 3
N_FRAMES = 60
VARIABLE = "OCUFILTER_HEADSET_GRAPHICS"
NO_DISPLAY = "this OpenXR runtime requires an X display"


@pytest.fixture
def display(tmp_path):
    """Return the name of an X display of the program's own."""
    folder = tmp_path / "display"
    folder.mkdir()
    screen = Xvfb(folder)
    try:
        yield screen.start()
    finally:
        screen.stop()


def shown(monado, folder, *arguments, **environment):
    """Return a run of this file as a program."""
    return Program(
        folder,
        {"DISPLAY": ""} | monado.environment | environment,
        *("-m", "tests.headset.test_glx", *arguments),
    )


def outcome(program):
    """Return the last line that a program tells."""
    *_, last = program.lines()
    return last


def test_frames_from_a_hidden_window_are_taken(started, tmp_path, display):
    environment = {VARIABLE: "glx", "DISPLAY": display}
    with shown(started(), tmp_path, **environment) as program:
        told = outcome(program)
        complaints = program.complaints()
        assert program.exit_code() == 0
    assert told == {
        "graphics": "GLX",
        "frames": N_FRAMES,
        "state": "FOCUSED",
        "has_depth": True,
        "gl": "GL_NO_ERROR",
        "left_current": False,
    }
    assert complaints == []


def test_the_screen_shows_what_a_hidden_window_draws(started, tmp_path, display):
    monado = started(remote=True, screen=True)  # a head that keeps still
    environment = {VARIABLE: "glx", "DISPLAY": display}
    with shown(monado, tmp_path, "--frames", "100000", **environment) as program:
        lines = program.lines()
        while next(lines).get("frame", 0) < 30:
            pass
        screen = monado.screenshot()
    for half, color in zip(np.split(screen, 2, axis=1), EYE_SRGB, strict=True):
        inner = half[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX].astype(int)
        assert np.abs(inner - color).max() <= SCREEN_ERROR


@pytest.mark.parametrize(
    ("arguments", "graphics"), [((), "EGL"), (("--hide-egl",), "GLX")]
)
def test_the_runtime_says_what_it_takes(
    started, tmp_path, display, arguments, graphics
):
    arguments = ("--frames", "5", *arguments)
    with shown(started(), tmp_path, *arguments, DISPLAY=display) as program:
        told = outcome(program)
    assert (told["graphics"], told["frames"]) == (graphics, 5)


def test_egl_needs_no_display(started, tmp_path):
    with shown(started(), tmp_path, "--frames", "5") as program:
        assert outcome(program)["graphics"] == "EGL"


def test_a_window_needs_a_display(started, tmp_path):
    monado = started()
    for where in ("", ":4321"):
        with shown(monado, tmp_path, "--hide-egl", DISPLAY=where) as program:
            assert NO_DISPLAY in outcome(program)["error"]


def test_before_there_is_a_runtime_it_is_egl(started, tmp_path):
    nowhere = str(tmp_path / "nothing.json")
    with shown(started(), tmp_path, XR_RUNTIME_JSON=nowhere) as program:
        assert "no OpenXR runtime is set up here" in outcome(program)["error"]


def test_a_runtime_that_refuses_egl_names_the_variable(started, tmp_path):
    environment = {VARIABLE: "egl"}
    with shown(started(), tmp_path, "--hide-egl", **environment) as program:
        error = outcome(program)["error"]
    assert "XR_MNDX_egl_enable" in error
    assert f"{VARIABLE}=glx" in error


def test_another_word_is_refused(started, tmp_path):
    with shown(started(), tmp_path, **{VARIABLE: "vulkan"}) as program:
        assert "'vulkan'; allowed: egl, glx" in outcome(program)["error"]


def viewer(monado, folder, **environment):
    """Return a run of the command."""
    room = stripes(folder / "room.glb")
    return Program(
        folder,
        monado.environment | {VARIABLE: "glx"} | environment,
        *("-m", "tests.headset.watched_viewer", "--scene", str(room), "--validate"),
        *("--frames", "30", "--scale", "0.3", "--profile", "emmetropia"),
        *("--settings", '{"tolerance": "loose", "object_range_dpt": [0, 1]}'),
    )


def test_the_command_filters_in_a_hidden_window(started, tmp_path, display):
    with viewer(started(), tmp_path, DISPLAY=display) as program:
        told = outcome(program)
        complaints = program.complaints()
        assert program.exit_code() == 0
    assert told["filtered"] == 30
    assert complaints == []


def test_the_command_says_that_it_needs_a_display(started, tmp_path):
    with viewer(started(), tmp_path, DISPLAY="") as program:
        assert program.exit_code() != 0
        assert NO_DISPLAY in program.said


# --- the program -----------------------------------------------------------------


def tell(**what) -> None:
    print(json.dumps(what), flush=True)


def show(context, frame_count: int) -> None:
    """Show frames, and tell of them."""
    from clients.headset.openxr_gl import current_platform
    from clients.headset.openxr_runtime import OpenXrRuntime
    from clients.headset.program import CORE_VALIDATION

    with context:
        graphics = current_platform()
    runtime = OpenXrRuntime(context, layers=[CORE_VALIDATION])
    with contextlib.closing(runtime):
        n_shown = 0
        while n_shown < frame_count:
            due = runtime.begin_frame()
            if due is None:
                continue
            views = pictures(due.views, runtime.size_px) if due.should_render else []
            runtime.end_frame(due, views)
            n_shown += bool(views)
            tell(frame=n_shown)
        state = runtime.state
    with context:
        error = context.error
    tell(
        graphics=graphics.name,
        frames=n_shown,
        state=state,
        has_depth=runtime.has_depth,
        gl=error,
        left_current=graphics.is_current(),
    )


def pictures(views, size_px):
    """Return each eye's color, as far as `DEPTH_M`."""
    from clients.headset.runtime import ShownView

    width, height = size_px
    return [
        ShownView(
            view,
            np.full((height, width, 3), color, np.uint8),
            np.full((height, width), DEPTH_M, np.float32),
        )
        for view, color in zip(views, EYE_SRGB, strict=True)
    ]


def hide_egl() -> None:
    """Make the runtime one that does not offer EGL."""
    from clients.headset import openxr_gl, openxr_runtime

    offered = openxr_gl.offered_extensions() - {openxr_gl.EGL_ENABLE}
    for module in (openxr_gl, openxr_runtime):
        module.offered_extensions = lambda: offered


def main() -> None:
    """Read the arguments, and show frames."""
    from clients.headset.openxr_gl import open_context
    from clients.headset.runtime import NoRuntime

    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=N_FRAMES)
    parser.add_argument("--hide-egl", action="store_true")
    arguments = parser.parse_args()
    if arguments.hide_egl:
        hide_egl()
    try:
        with open_context() as context:
            show(context, arguments.frames)
    except (NoRuntime, ValueError) as error:
        tell(error=str(error))


if __name__ == "__main__":
    main()
