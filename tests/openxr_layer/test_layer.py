"""What the runtime is shown of a program with the layer, on the mock runtime.

The filter inverts pictures, so that each shown picture tells its frame and whether it
was filtered.
"""

import re
import shutil
import subprocess
import time

import numpy as np
import pytest

from clients.openxr_layer.program import LAYER_NAME, LIBRARY_VARIABLE, OFF_VARIABLE
from clients.openxr_layer.wire import SOCKET_VARIABLE
from tests.commands import run_command
from tests.end_to_end.layer_double import RunningHelper
from tests.native_build import runtime_of
from tests.openxr_layer import build
from tests.openxr_layer.captured import drawn, pixels_of
from tests.openxr_layer.layered import (
    LONG_MS,
    inverting_eyes,
    layer_environment,
    layer_lines,
)
from tests.openxr_layer.programs import SIZE_PX, Run

N_FRAMES = 12


class Stage:
    """The layer, the mock runtime and the driver; and a helper, if one is started."""

    def __init__(self, library, runtime, driver, folder):
        self.folder, self.path = folder, folder / "layer.sock"
        self._library, self._runtime, self.driver = library, runtime, driver

    def run(self, case, *options, n_frames=N_FRAMES, **variables):
        own = layer_environment(self._library, self.folder, self.path)
        shutil.rmtree(self.folder / "captured", ignore_errors=True)
        command = (self.driver, case, "--frames", n_frames, *options)
        return Run(self._runtime, self.folder, *command, **(own | variables))

    def helper(self, *, wait_ms=LONG_MS, **options):
        return RunningHelper(self.path, inverting_eyes, wait_ms=wait_ms, **options)


@pytest.fixture
def stage(layer, runtime, driver, tmp_path):
    return Stage(layer, runtime, driver, tmp_path)


def floats(numbers):
    return [float.fromhex(number) for number in numbers]


FULL = {"GL_RGBA16F": 1.0, "GL_RGB10_A2": 1023.0}
FULL |= {"VK_R16G16B16A16_SFLOAT": 1.0, "VK_A2B10G10R10_UNORM": 1023.0}


def levels(view, pixels):
    """Return colors as bytes, exactly or as they are stored."""
    return 255.0 * pixels[..., :3] / FULL.get(view["format"], 255.0)


def kind_of(view, pixels, number, eye):
    """Return whether the picture of a frame is its "own", "filtered", or neither."""
    found = levels(view, pixels)
    expected = drawn(number, eye, view["rect"][2:]).astype(float)
    for name, picture in {"own": expected, "filtered": 255.0 - expected}.items():
        if np.abs(found - picture).max() <= 0.51:
            return name
    return "neither"


def shown_kinds(ran, *, index=0):
    """Return for each frame how its views are shown, with their own poses."""
    kinds = []
    for told, frame in ran.pairs():
        layer = frame["layers"][index]
        found = set()
        for eye, view in enumerate(layer["views"]):
            assert view["pose"] + view["fov"] == floats(told["views"][eye])
            pixels = pixels_of(ran.folder, view)
            found.add(kind_of(view, pixels, told["frame"], eye))
        assert len(found) == 1
        kinds.append(found.pop())
    return kinds


def check_clean(ran, n_frames=N_FRAMES):
    assert ran.violations == []
    assert ran.exit_code == 0, ran.told[-1]
    assert ran.told[-1]["frames"] == n_frames


def is_filtered_after_start(kinds):
    """Whether all but the first frames, before there is a connection, are filtered."""
    first = kinds.index("filtered")
    return first <= len(kinds) // 2 and set(kinds[first:]) == {"filtered"}


# What is filtered

FILTERED = ["plain", "array", "wide", "offset", "msaa4", "dynamic-size"]
FILTERED += ["other-thread", "no-context", "space-destroyed", "end-from-thread"]
FILTERED += ["ahead", "view-locked"]


@pytest.mark.parametrize("case", FILTERED)
def test_frames_are_filtered(stage, case):
    with stage.helper():
        ran = stage.run(case, "--check-state")
    check_clean(ran)
    kinds = shown_kinds(ran)
    assert is_filtered_after_start(kinds)
    # The depth is that of another frame in general, and is dropped.
    has_depth = ["depth" in f["layers"][0]["views"][0] for f in ran.frames]
    assert has_depth == [kind == "own" for kind in kinds]


def without_other_contexts(violations):
    """Return the other ones: the mock does not know that a program has two contexts."""
    return [line for line in violations if "current context" not in line]


def test_another_context_is_current(stage):
    with stage.helper():
        ran = stage.run("other-context", "--check-state")
    assert ran.exit_code == 0, ran.told[-1]
    assert without_other_contexts(ran.violations) == []
    assert is_filtered_after_start(shown_kinds(ran))


@pytest.mark.parametrize("kind", ["RGBA8", "SRGB8_ALPHA8", "RGB10_A2", "RGBA16F"])
def test_formats(stage, kind):
    with stage.helper():
        ran = stage.run("plain", "--format", kind)
    check_clean(ran)
    assert is_filtered_after_start(shown_kinds(ran))
    assert {f["layers"][0]["views"][0]["format"] for f in ran.frames} == {f"GL_{kind}"}


def test_on_glx(stage, display):
    with stage.helper():
        ran = stage.run("plain", "--check-state", "--glx", DISPLAY=display)
    check_clean(ran)
    assert is_filtered_after_start(shown_kinds(ran))


BUFFERED = {"OCUFILTER_LAYER_READS": "buffered"}
"""As with a hardware GPU: reads do not wait."""


@pytest.mark.parametrize("case", ["plain", "array", "msaa4", "other-thread", "restart"])
def test_reads_that_do_not_wait(stage, case):
    with stage.helper():
        ran = stage.run(case, "--check-state", n_frames=30, **BUFFERED)
    check_clean(ran, 90 if case == "restart" else 30)
    kinds = shown_kinds(ran)
    assert kinds[-1] == "filtered"
    assert case == "restart" or is_filtered_after_start(kinds)


# What is not


def test_without_a_helper_frames_are_the_own(stage):
    ran = stage.run("plain", "--check-state")
    check_clean(ran)
    assert set(shown_kinds(ran)) == {"own"}
    assert layer_lines(ran) == ["no helper is connected; trying again every second"]


@pytest.mark.parametrize(
    ("case", "line"),
    [
        ("action-space", "in the space of a controller"),
        ("mono", "layers of 1 views are not filtered"),
    ],
)
def test_other_layers_pass(stage, case, line):
    with stage.helper():
        ran = stage.run(case, MOCK_XR_MONO="1")
    check_clean(ran)
    assert set(shown_kinds(ran)) == {"own"}
    assert sum(line in said for said in layer_lines(ran)) == 1


BLENDED = 6  # by the texture's alpha, which is not premultiplied


@pytest.mark.parametrize(
    ("case", "index"), [("two-layers", 0), ("quad-below", 1), ("quad-above", 0)]
)
def test_one_of_several_layers_is_filtered(stage, case, index):
    with stage.helper(leave_quads=True):
        ran = stage.run(case)
    check_clean(ran)
    assert is_filtered_after_start(shown_kinds(ran, index=index))
    for told, frame in ran.pairs():
        other = frame["layers"][1 - index]
        assert other["type"] == ("projection" if case == "two-layers" else "quad")
        if other["type"] == "quad":
            pixels = pixels_of(ran.folder, other)
            assert kind_of(other, pixels, told["frame"], 2) == "own"
            continue
        assert other["flags"] == BLENDED
        for eye, view in enumerate(other["views"]):
            pixels = pixels_of(ran.folder, view)
            assert kind_of(view, pixels, told["frame"], eye) == "own"


def test_alpha_is_kept(stage):
    with stage.helper():
        ran = stage.run("alpha")
    check_clean(ran)
    assert is_filtered_after_start(shown_kinds(ran))
    layer = ran.frames[-1]["layers"][0]
    alpha = pixels_of(ran.folder, layer["views"][0])[..., 3]
    width_px = SIZE_PX[0]
    expected = np.round(255 * np.arange(width_px) / width_px)
    np.testing.assert_array_equal(alpha, np.broadcast_to(expected, alpha.shape))


def test_a_flipped_view_is_filtered(stage):
    with stage.helper():
        ran = stage.run("fov-flipped")
    check_clean(ran)
    kinds = set()
    for told, frame in ran.pairs():
        view = frame["layers"][0]["views"][0]
        assert view["fov"][2] < view["fov"][3]
        pixels = pixels_of(ran.folder, view)
        kinds |= {kind_of(view, pixels, told["frame"], 0)}
        kinds |= {kind_of(view, pixels[::-1], told["frame"], 0)}
    assert "filtered" in kinds


@pytest.mark.parametrize("case", ["reuse", "half-rate"])
def test_images_without_a_new_release_are_filtered(stage, case):
    with stage.helper():
        ran = stage.run(case, n_frames=40)
    check_clean(ran, 40)
    last = ran.frames[-1]["layers"][0]["views"][0]
    pixels = pixels_of(ran.folder, last)
    numbers = [line["frame"] for line in ran.told if "frame" in line]
    kinds = {kind_of(last, pixels, number, 0) for number in numbers}
    # An image that was released before there was a helper has no copy.
    assert kinds & {"own", "filtered"} == {"own" if case == "reuse" else "filtered"}


@pytest.mark.parametrize("case", ["restart", "second-session"])
def test_sessions_one_after_the_other(stage, case):
    with stage.helper():
        ran = stage.run(case, n_frames=40, MOCK_XR_RATE_HZ="30")
    check_clean(ran, 120)
    kinds = shown_kinds(ran)
    assert set(kinds) == {"own", "filtered"}
    if case == "restart":  # else two of them are open at the same time
        assert kinds[39::40] == ["filtered"] * 3
    assert kinds[-1] == "filtered"


def test_runtime_without_depth(stage):
    with stage.helper():
        ran = stage.run(
            "plain", MOCK_XR_EXTENSIONS="XR_KHR_opengl_enable,XR_MNDX_egl_enable"
        )
    check_clean(ran)
    assert is_filtered_after_start(shown_kinds(ran))


def test_runtime_without_depth_nor_helper(stage):
    ran = stage.run(
        "plain", MOCK_XR_EXTENSIONS="XR_KHR_opengl_enable,XR_MNDX_egl_enable"
    )
    check_clean(ran)
    assert set(shown_kinds(ran)) == {"own"}


def test_images_that_the_runtime_still_reads(stage):
    with stage.helper():
        ran = stage.run("plain", MOCK_XR_WAIT_TIMEOUTS="9", n_frames=40)
    check_clean(ran, 40)
    kinds = shown_kinds(ran)
    assert kinds[-1] == "filtered"


@pytest.mark.parametrize("n_swapchains", [6, 7])
def test_a_swapchain_that_cannot_be_replaced(stage, n_swapchains):
    # Four are the program's, and two the layer's until the image grows.
    with stage.helper(wait_ms=0):
        ran = stage.run(
            "growing",
            n_frames=90,
            MOCK_XR_RATE_HZ="60",
            MOCK_XR_MAX_SWAPCHAINS=str(n_swapchains),
        )
    check_clean(ran, 90)
    assert any("provides no swapchain" in line for line in layer_lines(ran))


def test_an_image_that_grows(stage):
    with stage.helper():
        ran = stage.run("growing", n_frames=90)
    check_clean(ran, 90)
    assert is_filtered_after_start(shown_kinds(ran))


def test_images_that_were_not_shown_for_a_while(stage):
    with stage.helper():
        ran = stage.run("hidden", n_frames=40)
    check_clean(ran, 40)
    shown = {frame["display_time"]: frame for frame in ran.frames}
    for line in ran.told:
        frame = shown.get(line.get("display_time"))
        if frame is None:
            continue
        view = frame["layers"][0]["views"][0]
        pixels = pixels_of(ran.folder, view)
        # It is of this frame, filtered or not.
        assert kind_of(view, pixels, line["frame"], 0) in ("own", "filtered")
    assert kind_of(view, pixels, line.get("frame", 39), 0) == "filtered"


def test_waiting_ends_where_the_runtime_still_reads(stage):
    with stage.helper(wait_ms=5000):
        ran = stage.run("plain", MOCK_XR_WAIT_TIMEOUTS=str(10**9))
    check_clean(ran)
    assert set(shown_kinds(ran)) == {"own"}


NO_X11 = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <string.h>
void *dlopen(const char *name, int flags) {
    static void *(*next)(const char *, int);
    if (!next) next = dlsym(RTLD_NEXT, "dlopen");
    return name && !strcmp(name, "libX11.so.6") ? NULL : next(name, flags);
}
"""


def test_a_session_that_cannot_be_filtered_and_a_runtime_without_depth(stage, display):
    source, library = stage.folder / "no_x11.c", stage.folder / "no_x11.so"
    source.write_text(NO_X11)
    command = (build.COMPILER, "-shared", "-fPIC", str(source), "-o", str(library))
    subprocess.run(command, check=True)
    ran = stage.run(
        *("plain", "--glx"),
        DISPLAY=display,
        LD_PRELOAD=str(library),
        MOCK_XR_EXTENSIONS="XR_KHR_opengl_enable,XR_MNDX_egl_enable",
    )
    check_clean(ran)  # the depth that it submits has been removed
    assert set(shown_kinds(ran)) == {"own"}
    assert any("libX11 is missing" in line for line in layer_lines(ran))


def test_a_forked_child_does_not_keep_the_helper(stage):
    with stage.helper() as helper:
        ran = stage.run("fork", n_frames=40)
        check_clean(ran, 40)
        end_s = time.monotonic() + 10.0  # the child lives on for twice as long
        while "driver: disconnected" not in helper.lines:
            assert time.monotonic() < end_s
            time.sleep(0.01)
    assert is_filtered_after_start(shown_kinds(ran))


def test_a_limit_of_file_sizes(stage):
    limited = stage.folder / "limited.sh"
    limited.write_text(f'#!/bin/sh\nulimit -f 8\nexec {stage.driver} "$@"\n')
    limited.chmod(0o755)
    stage.driver = limited
    # Mesa's cache of shaders, where there is one, exceeds the limit: the program ends.
    without = {"MOCK_XR_CAPTURE": "", "MESA_SHADER_CACHE_DISABLE": "true"}
    with stage.helper():
        ran = stage.run("plain", **without, MOCK_XR_SIZE="512x512")
    check_clean(ran)
    assert any("no shared memory" in line for line in layer_lines(ran))


def test_a_session_that_is_lost(stage):
    for when in ("6", "6,instance"):
        with stage.helper():
            ran = stage.run("plain", MOCK_XR_LOSE_AT=when)
        assert ran.exit_code == 1
        assert ran.told[-1]["error"].endswith("_LOST")
        assert ran.violations == []


# Depth

DEPTH_NOTES = {
    "depth-constant": "all its values are",
    "depth-nan": "",
    "depth-swapped": "swapped; corrected",
    "depth-zero-near": "planes are at 0",
    "depth-equal": "both its planes are at 1 m",
    "depth-range": "the range of the buffer",
    "depth-size": "",
    "depth-stale": "there is none",  # it was released before there was a helper
    "depth-rect": "there is none",
    "depth-garbage": "unrelated",
    "depth-other-array": "",
}


@pytest.mark.parametrize("case", DEPTH_NOTES)
def test_wrong_depth(stage, case):
    with stage.helper() as helper:
        ran = stage.run(case, MOCK_XR_LENIENT_DEPTH="1")
    assert ran.exit_code == 0
    assert is_filtered_after_start(shown_kinds(ran))
    notes = [line for line in helper.lines if "depth" in line]
    assert bool(notes) == bool(DEPTH_NOTES[case])
    assert DEPTH_NOTES[case] in "".join(notes)


# Threads and memory


@pytest.mark.parametrize(
    "case",
    ["plain", "other-thread", "end-from-thread", "restart", "no-context", "ahead"],
)
def test_threads_do_not_race(watched, tmp_path, case):
    library = build.build_layer(tmp_path, "-fsanitize=thread")
    stage = Stage(library, *watched, tmp_path)
    variables = build.thread_sanitizer_options(tmp_path)
    if case != "plain":
        variables |= BUFFERED
    with stage.helper():
        ran = stage.run(case, "--threads", **variables)
    assert "WARNING: ThreadSanitizer" not in ran.said
    check_clean(ran, 3 * N_FRAMES if case == "restart" else N_FRAMES)
    assert "filtered" in shown_kinds(ran) or case == "restart"


def test_addresses_are_valid(runtime, driver, tmp_path):
    preloaded = runtime_of("address")
    if preloaded is None:
        pytest.skip("no AddressSanitizer here")
    library = build.build_layer(tmp_path, "-fsanitize=address,undefined")
    stage = Stage(library, runtime, driver, tmp_path)
    variables = {"LD_PRELOAD": str(preloaded), "ASAN_OPTIONS": "detect_leaks=0"}
    cases = {"msaa4": 12, "second-session": 36, "two-layers": 12, "half-rate": 12}
    for case, n_frames in cases.items():
        reads = BUFFERED if case == "half-rate" else {}
        with stage.helper():
            ran = stage.run(case, **(variables | reads))
        assert not re.search("ERROR: AddressSanitizer|runtime error", ran.said), (
            ran.said
        )
        check_clean(ran, n_frames)


def test_handles_of_several_sessions(watched, tmp_path):
    library = build.build_layer(tmp_path, "-fsanitize=thread")
    program_path = build.build_handles(tmp_path, "-fsanitize=thread")
    own = layer_environment(library, tmp_path, tmp_path / "none.sock")
    own |= build.thread_sanitizer_options(tmp_path)
    ran = Run(watched[0], tmp_path, program_path, **own)
    assert "WARNING: ThreadSanitizer" not in ran.said
    assert ran.exit_code == 0, ran.said
    assert without_other_contexts(ran.violations) == []


# Installation


@pytest.mark.parametrize("kind", ["explicit", "implicit"])
def test_the_loader_finds_the_installed_layer(
    layer, runtime, driver, tmp_path, monkeypatch, kind
):
    monkeypatch.setenv(LIBRARY_VARIABLE, str(layer))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    options = ["--implicit"] if kind == "implicit" else []
    assert run_command("layer", "install", *options).returncode == 0
    enabled = {"XR_ENABLE_API_LAYERS": LAYER_NAME}
    variables = enabled if kind == "explicit" else {}
    socket = {SOCKET_VARIABLE: str(tmp_path / "layer.sock")}

    def lines(**more):
        shutil.rmtree(tmp_path / "captured", ignore_errors=True)
        command = (driver, "plain", "--frames", N_FRAMES)
        ran = Run(runtime, tmp_path, *command, **(socket | variables | more))
        check_clean(ran)
        return layer_lines(ran)

    assert lines() == ["no helper is connected; trying again every second"]
    if kind == "implicit":
        assert lines(**{OFF_VARIABLE: "1"}) == []
    assert run_command("layer", "remove").returncode == 0
    variables = {}
    assert lines() == []
