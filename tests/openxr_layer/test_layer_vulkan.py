"""Programs that use Vulkan with the layer, on the mock runtime.

Khronos' validation layer, with synchronization validation, watches the device that the
program, the layer and the runtime use.  The program itself reports where the layer uses
the queue in a call in which it may not.
"""

from pathlib import Path

import numpy as np
import pytest

from filter_service import FilterSettings
from tests.end_to_end.layer_double import RunningHelper
from tests.native_build import runtime_of
from tests.openxr_layer import build
from tests.openxr_layer.captured import pixels_of
from tests.openxr_layer.layered import (
    LONG_MS,
    frozen_eyes,
    layer_environment,
    layer_lines,
)
from tests.openxr_layer.programs import run_hello_xr
from tests.openxr_layer.test_layer import (
    DEPTH_NOTES,
    Stage,
    check_clean,
    is_filtered_after_start,
    kind_of,
    shown_kinds,
)
from tests.openxr_layer.test_layer_live import (  # noqa: F401  with the stage below
    test_a_helper_that_hangs,
    test_a_helper_that_starts_late_is_killed_and_comes_back,
    test_results_from_before_recentering_are_not_shown,
    test_results_that_are_too_old_are_not_shown,
)
from tests.openxr_layer.test_layer_programs import (
    PROFILES,
    SETTINGS,
    filtered_by_hand,
    needs_hello_xr,
)

VALIDATION = Path("/usr/share/vulkan/explicit_layer.d/VkLayer_khronos_validation.json")
pytestmark = pytest.mark.skipif(not VALIDATION.exists(), reason="no Vulkan here")

TRANSFER_SRC = 8
"""XR_SWAPCHAIN_USAGE_TRANSFER_SRC_BIT."""


N_FRAMES, HELLO_FRAMES = 24, 40
RATE_HZ = "120"
"""Without a rate, the frames would be over before the helper has answered."""


class VulkanStage(Stage):
    """A stage whose program uses Vulkan."""

    def run(
        self,
        case,
        *options,
        version=2,
        validate=True,
        n_frames=N_FRAMES,
        **variables,
    ):
        own = ("--vulkan", version, *(["--validate"] if validate else []))
        variables = {"MOCK_XR_RATE_HZ": RATE_HZ} | variables
        return super().run(case, *own, *options, n_frames=n_frames, **variables)


@pytest.fixture
def stage(layer, runtime, driver, tmp_path):
    return VulkanStage(layer, runtime, driver, tmp_path)


def messages(ran):
    """Return what validation has found."""
    return [line for line in ran.said.splitlines() if "driver: validation" in line]


def check_valid(ran, n_frames=N_FRAMES):
    check_clean(ran, n_frames)
    assert messages(ran) == []


# What is filtered

FILTERED = ["plain", "array", "wide", "offset", "msaa4", "dynamic-size"]
FILTERED += ["other-thread", "no-context", "space-destroyed", "end-from-thread"]
FILTERED += ["ahead", "view-locked"]


@pytest.mark.parametrize("case", FILTERED)
def test_frames_are_filtered(stage, case):
    with stage.helper():
        ran = stage.run(case)
    check_valid(ran)
    kinds = shown_kinds(ran)
    assert is_filtered_after_start(kinds)
    # The depth is that of another frame in general, and is dropped.
    has_depth = ["depth" in f["layers"][0]["views"][0] for f in ran.frames]
    assert has_depth == [kind == "own" for kind in kinds]


def test_three_hundred_frames(stage):
    with stage.helper():
        ran = stage.run("plain", n_frames=300)
    check_valid(ran, 300)
    kinds = shown_kinds(ran)
    assert kinds.count("filtered") >= 295
    assert is_filtered_after_start(kinds)


def test_the_first_extension(stage):
    with stage.helper():
        ran = stage.run("plain", version=1)
    check_valid(ran)
    assert is_filtered_after_start(shown_kinds(ran))


FORMATS = {
    "SRGB8_ALPHA8": "R8G8B8A8_SRGB",
    "RGBA8": "R8G8B8A8_UNORM",
    "BGRA8_SRGB": "B8G8R8A8_SRGB",
    "BGRA8": "B8G8R8A8_UNORM",
    "RGB10_A2": "A2B10G10R10_UNORM",
    "RGBA16F": "R16G16B16A16_SFLOAT",
}


@pytest.mark.parametrize("kind", FORMATS)
def test_formats(stage, kind):
    with stage.helper():
        ran = stage.run("plain", "--format", kind)
    check_valid(ran)
    assert is_filtered_after_start(shown_kinds(ran))
    formats = {frame["layers"][0]["views"][0]["format"] for frame in ran.frames}
    assert formats == {f"VK_{FORMATS[kind]}"}


DEPTHS = {"D16": 1e-5, "D24S8": 1e-7, "D32F": 0.0, "D32FS8": 0.0}
"""Formats of depth, and half a step."""


@pytest.mark.parametrize("planes", [("0.1", "100"), ("100", "0.1"), ("inf", "0.1")])
@pytest.mark.parametrize("kind", DEPTHS)
def test_depth(stage, kind, planes):
    distance_m = 2.5
    frames = []
    with stage.helper() as helper:
        helper.helper.on_frame = lambda frame, _: frames.append(frame)
        ran = stage.run(
            *("plain", "--depth", kind, "--distance-m", distance_m),
            *("--near-z", planes[0], "--far-z", planes[1]),
        )
    check_valid(ran)
    own = next(
        frame for frame in ran.frames if "depth" in frame["layers"][0]["views"][0]
    )
    stored = pixels_of(ran.folder, own["layers"][0]["views"][0]["depth"])
    near_m, far_m = map(float, planes)
    # The value of a perspective projection, which is 0 at near_m and 1 at far_m.
    expected = (1 / near_m - 1 / distance_m) / (1 / near_m - 1 / far_m)
    step = DEPTHS[kind]
    assert abs(stored - expected).max() <= step + 2e-7
    for picture in frames[-1].pictures:
        # Half a step, in diopters.
        limit_dpt = (step + 2e-6) * abs(1 / near_m - 1 / far_m)
        assert abs(1 / picture.depth_m - 1 / distance_m).max() <= limit_dpt


@pytest.mark.parametrize("case", DEPTH_NOTES)
def test_wrong_depth(stage, case):
    with stage.helper() as helper:
        ran = stage.run(case, MOCK_XR_LENIENT_DEPTH="1")
    assert ran.exit_code == 0
    assert messages(ran) == []
    assert is_filtered_after_start(shown_kinds(ran))
    notes = [line for line in helper.lines if "depth" in line]
    assert bool(notes) == bool(DEPTH_NOTES[case])
    assert DEPTH_NOTES[case] in "".join(notes)


def test_a_flipped_view_is_filtered(stage):
    with stage.helper():
        ran = stage.run("fov-flipped")
    check_valid(ran)
    view = ran.frames[-1]["layers"][0]["views"][0]
    assert view["fov"][2] < view["fov"][3]
    pixels = pixels_of(ran.folder, view)[::-1]
    last = [line["frame"] for line in ran.told if "frame" in line][-1]
    assert kind_of(view, pixels, last, 0) == "filtered"


def test_images_may_be_copied(stage):
    ran = stage.run("plain")
    check_valid(ran)
    usages = {frame["layers"][0]["views"][0]["usage"] for frame in ran.frames}
    assert all(usage & TRANSFER_SRC for usage in usages)


# What is not


def test_without_a_helper_frames_are_the_own(stage):
    ran = stage.run("plain")
    check_valid(ran)
    assert set(shown_kinds(ran)) == {"own"}
    assert layer_lines(ran) == ["no helper is connected; trying again every second"]


@pytest.mark.parametrize(
    ("case", "index"), [("two-layers", 0), ("quad-below", 1), ("quad-above", 0)]
)
def test_one_of_several_layers_is_filtered(stage, case, index):
    with stage.helper(leave_quads=True):
        ran = stage.run(case)
    check_valid(ran)
    assert is_filtered_after_start(shown_kinds(ran, index=index))


def test_other_layers_pass(stage):
    with stage.helper():
        ran = stage.run("mono", MOCK_XR_MONO="1")
    check_valid(ran)
    assert set(shown_kinds(ran)) == {"own"}


# Odd cases


@pytest.mark.parametrize("case", ["restart", "second-session"])
def test_sessions_one_after_the_other(stage, case):
    with stage.helper():
        ran = stage.run(case, n_frames=40, MOCK_XR_RATE_HZ="30")
    check_valid(ran, 120)
    kinds = shown_kinds(ran)
    assert set(kinds) == {"own", "filtered"}
    if case == "restart":  # else two of them are open at the same time
        assert kinds[39::40] == ["filtered"] * 3
    assert kinds[-1] == "filtered"


def test_an_image_that_grows(stage):
    with stage.helper():
        ran = stage.run("growing", n_frames=90)
    check_valid(ran, 90)
    assert is_filtered_after_start(shown_kinds(ran))


def test_a_swapchain_that_cannot_be_replaced(stage):
    # Four are the program's, and two the layer's until the image grows.
    with stage.helper(wait_ms=0):
        ran = stage.run(
            "growing", n_frames=90, MOCK_XR_RATE_HZ="60", MOCK_XR_MAX_SWAPCHAINS="7"
        )
    check_valid(ran, 90)
    assert any("provides no swapchain" in line for line in layer_lines(ran))


@pytest.mark.parametrize("case", ["reuse", "half-rate"])
def test_images_without_a_new_release_are_filtered(stage, case):
    with stage.helper():
        ran = stage.run(case, n_frames=40)
    check_valid(ran, 40)
    last = ran.frames[-1]["layers"][0]["views"][0]
    pixels = pixels_of(ran.folder, last)
    numbers = [line["frame"] for line in ran.told if "frame" in line]
    kinds = {kind_of(last, pixels, number, 0) for number in numbers}
    # An image that was released before there was a helper has no copy.
    assert kinds & {"own", "filtered"} == {"own" if case == "reuse" else "filtered"}


def test_images_that_the_runtime_still_reads(stage):
    with stage.helper():
        ran = stage.run("plain", MOCK_XR_WAIT_TIMEOUTS="9", n_frames=40)
    check_valid(ran, 40)
    assert shown_kinds(ran)[-1] == "filtered"


@pytest.mark.parametrize("when", ["6", "6,instance"])
def test_a_session_that_is_lost(stage, when):
    with stage.helper():
        ran = stage.run("plain", MOCK_XR_LOSE_AT=when)
    assert ran.exit_code == 1
    assert ran.told[-1]["error"].endswith("_LOST")
    assert ran.violations == []
    assert messages(ran) == []


def test_a_device_that_is_lost(stage):
    with stage.helper():
        ran = stage.run("device-lost", n_frames=40)
    check_valid(ran, 40)
    kinds = shown_kinds(ran)
    first = kinds.index("filtered")
    lost = kinds.index("own", first)
    assert lost > first + 5
    assert set(kinds[lost:]) == {"own"}
    assert [line for line in layer_lines(ran) if "lost" in line] == [
        "the Vulkan device is lost; not filtered"
    ]


def test_validation_sees_the_layer(stage):
    """What the layer submits is validated: it expects the layout that is specified."""
    with stage.helper():
        ran = stage.run("wrong-layout", n_frames=6, MOCK_XR_CAPTURE="")
    assert any("current layout is" in line for line in messages(ran))


# A program that knows nothing of the layer


@needs_hello_xr
@pytest.mark.parametrize("graphics", ["Vulkan", "Vulkan2"])
def test_hello_xr_is_shown_as_the_eye_filter_sees_it(
    layer, runtime, tmp_path, graphics
):
    path, head = tmp_path / "layer.sock", tmp_path / "head.txt"
    head.write_text("\n".join(f"{1e-3 * i} 0 0 0 0 0 1" for i in range(1000)))
    inputs = {}
    make_eyes = frozen_eyes(PROFILES, FilterSettings(**SETTINGS))
    with RunningHelper(path, make_eyes, wait_ms=LONG_MS) as helper:
        helper.helper.on_frame = lambda frame, _: inputs.setdefault(
            frame.due.display_time_ns, frame
        )
        frames, found_wrong = run_hello_xr(
            *(runtime, tmp_path, "", HELLO_FRAMES, graphics),
            **layer_environment(layer, tmp_path, path),
            MOCK_XR_SIZE="160x180",
            MOCK_XR_HEAD=str(head),
            VK_INSTANCE_LAYERS="VK_LAYER_KHRONOS_validation",
            VK_KHRONOS_VALIDATION_VALIDATE_SYNC="1",
        )
    assert found_wrong == []
    seen = [frame for frame in frames if frame["display_time"] in inputs]
    assert len(seen) >= HELLO_FRAMES - 8  # all but those before the connection
    assert seen == frames[-len(seen) :]
    n_blurred = 0
    for number, frame in enumerate(seen):
        given = inputs[frame["display_time"]]
        for view, picture in zip(
            frame["layers"][0]["views"], given.pictures, strict=True
        ):
            assert view["format"] == "VK_R8G8B8A8_SRGB"
            assert tuple(view["pose"]) == picture.view.pose
            pixels = pixels_of(tmp_path / "captured", view)[::-1, :, :3]
            assert pixels.any()
            if number not in (0, len(seen) // 2, len(seen) - 1):
                continue
            expected = filtered_by_hand(picture.view.eye, picture)
            assert np.abs(pixels.astype(int) - expected).max() <= 1
            n_blurred += (expected != picture.color).mean() > 0.002
    assert n_blurred == 6


# Threads and memory


def test_threads_do_not_race(watched, tmp_path):
    library = build.build_layer(tmp_path, "-fsanitize=thread")
    stage = VulkanStage(library, *watched, tmp_path)
    variables = build.thread_sanitizer_options(tmp_path)
    with stage.helper():
        ran = stage.run("other-thread", "--threads", validate=False, **variables)
    assert "WARNING: ThreadSanitizer" not in ran.said
    check_clean(ran, N_FRAMES)
    assert "filtered" in shown_kinds(ran)


def test_addresses_are_valid(runtime, driver, tmp_path):
    preloaded = runtime_of("address")
    if preloaded is None:
        pytest.skip("no AddressSanitizer here")
    library = build.build_layer(tmp_path, "-fsanitize=address,undefined")
    stage = VulkanStage(library, runtime, driver, tmp_path)
    variables = {"LD_PRELOAD": str(preloaded), "ASAN_OPTIONS": "detect_leaks=0"}
    cases = {"msaa4": 1, "second-session": 3, "device-lost": 1}
    for case, n_sessions in cases.items():
        with stage.helper():
            ran = stage.run(case, validate=False, n_frames=36, **variables)
        assert "ERROR: AddressSanitizer" not in ran.said, ran.said
        assert "runtime error" not in ran.said, ran.said
        check_clean(ran, 36 * n_sessions)
