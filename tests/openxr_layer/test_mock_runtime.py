"""The mock runtime serves programs, sees what is wrong, and captures what is shown.

Run in the root of `tests/headset/setup_root.sh`, with the packages libopenxr-dev,
libgl-dev, libegl-dev, libvulkan-dev, libx11-dev, openxr-layer-corevalidation,
libopenxr-utils, xserver-xorg-core and xserver-xorg-video-dummy.
"""

import shutil
import subprocess

import numpy as np
import pytest

from tests.native_build import runtime_of
from tests.openxr_layer import build
from tests.openxr_layer.captured import drawn, pixels_of
from tests.openxr_layer.programs import SIZE_PX, Run, run_hello_xr

N_FRAMES = 8
NEAR_M, FAR_M, DISTANCE_M = 0.1, 100.0, 2.0


@pytest.fixture
def shown(runtime, driver, tmp_path):
    """Return how to run a case of the driver."""

    def run(case, *options, **variables):
        frames = ("--frames", N_FRAMES)
        return Run(runtime, tmp_path, driver, case, *frames, *options, **variables)

    return run


def check_pictures(run, alpha=255):
    """Compare each captured view with what the driver draws."""
    n_compared = 0
    for told, captured in run.pairs():
        (layer,) = captured["layers"]
        for i, view in enumerate(layer["views"]):
            assert view["pose"] + view["fov"] == floats(told["views"][i])
            pixels = pixels_of(run.folder, view)
            assert (pixels[..., :3] == drawn(told["frame"], i, view["rect"][2:])).all()
            assert (pixels[..., 3] == alpha).all()
            n_compared += 1
    return n_compared


def floats(numbers):
    return [float.fromhex(number) for number in numbers]


def check_clean(run, n_frames=N_FRAMES):
    assert run.violations == []
    assert run.exit_code == 0, run.told[-1]
    assert run.told[-1]["frames"] == n_frames


CASES = {
    "plain": N_FRAMES,
    "array": N_FRAMES,
    "wide": N_FRAMES,
    "offset": N_FRAMES,
    "msaa4": N_FRAMES,
    "dynamic-size": N_FRAMES,
    "other-thread": N_FRAMES,
    "no-context": N_FRAMES,
    "end-from-thread": N_FRAMES,
    "restart": 3 * N_FRAMES,
    "second-session": 3 * N_FRAMES,
}


@pytest.mark.parametrize(("case", "n_frames"), CASES.items())
def test_the_driver_is_shown(shown, case, n_frames):
    run = shown(case, "--check-state")
    check_clean(run, n_frames)
    assert check_pictures(run) == 2 * n_frames
    views = run.frames[-1]["layers"][0]["views"]
    assert {view["samples"] for view in views} == {4 if case == "msaa4" else 1}
    assert [view["array_index"] for view in views] == [0, case == "array"]
    if case == "wide":
        assert [view["rect"][0] for view in views] == [0, SIZE_PX[0]]


def test_frames_are_waited_for_in_a_thread(shown):
    run = shown("plain", "--threads", MOCK_XR_RATE_HZ="90")
    check_clean(run)
    assert check_pictures(run) == 2 * N_FRAMES


@pytest.mark.parametrize("case", ["plain", "other-thread", "restart"])
def test_a_window_is_taken_too(shown, display, tmp_path, case):
    report = tmp_path / "validation.txt"
    variables = {
        "DISPLAY": display,
        "XR_ENABLE_API_LAYERS": "XR_APILAYER_LUNARG_core_validation",
        "XR_CORE_VALIDATION_EXPORT_TYPE": "text",
        "XR_CORE_VALIDATION_FILE_NAME": str(report),
    }
    run = shown(case, "--check-state", "--glx", **variables)
    n_frames = CASES[case]
    check_clean(run, n_frames)
    assert check_pictures(run) == 2 * n_frames
    complaints = [line for line in report.read_text().splitlines() if "VUID" in line]
    assert all("VALID_DEBUG" in line for line in complaints)


SPOILER = """
#define _GNU_SOURCE
#define GL_GLEXT_PROTOTYPES
#include <dlfcn.h>
#include <EGL/egl.h>
#include <GL/gl.h>
#include <GL/glext.h>
#include <openxr/openxr.h>

XrResult xrReleaseSwapchainImage(XrSwapchain chain,
                                 const XrSwapchainImageReleaseInfo *info) {
    PFN_xrReleaseSwapchainImage next = dlsym(RTLD_NEXT, "xrReleaseSwapchainImage");
    XrResult result = next(chain, info);
    STATEMENT;
    return result;
}
"""
"""In front of the loader, as a layer would be behind it."""
SPOILERS = {
    "glViewport(0, 0, 1, 1)": "GL_VIEWPORT",
    "glActiveTexture(GL_TEXTURE5)": "GL_ACTIVE_TEXTURE",
    "glBindTexture(GL_TEXTURE_2D, 0)": "GL_TEXTURE_BINDING_2D of unit 3",
    "glBindFramebuffer(GL_READ_FRAMEBUFFER, 0)": "GL_READ_FRAMEBUFFER_BINDING",
    "glUseProgram(0)": "GL_CURRENT_PROGRAM",
    "glDisable(GL_SCISSOR_TEST)": "GL_SCISSOR_TEST",
    "glPixelStorei(GL_PACK_ALIGNMENT, 4)": "GL_PACK_ALIGNMENT",
    "glEnable(0)": "OpenGL's error 0x500",
    "eglBindAPI(EGL_OPENGL_ES_API)": "EGL's API",
    "eglMakeCurrent(eglGetCurrentDisplay(), 0, 0, 0)": "the current display changed",
}


@pytest.mark.parametrize(("statement", "name"), SPOILERS.items())
def test_the_driver_sees_a_state_that_changed(shown, tmp_path, statement, name):
    source, library = tmp_path / "spoiler.c", tmp_path / "spoiler.so"
    source.write_text(SPOILER.replace("STATEMENT", statement))
    command = [build.COMPILER, "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run([*command, "-lGL", "-lEGL"], check=True)
    run = shown("plain", "--check-state", LD_PRELOAD=str(library))
    assert run.exit_code == 1
    assert name in run.told[-1]["error"]
    assert run.told[-1]["call"].startswith("xrReleaseSwapchainImage")


@pytest.mark.parametrize(
    ("planes", "expected"),
    [
        ((NEAR_M, FAR_M), FAR_M * (DISTANCE_M - NEAR_M) / (FAR_M - NEAR_M)),
        ((FAR_M, NEAR_M), NEAR_M * (FAR_M - DISTANCE_M) / (FAR_M - NEAR_M)),
        ((NEAR_M, "inf"), DISTANCE_M - NEAR_M),
        (("inf", NEAR_M), NEAR_M),
    ],
)
@pytest.mark.parametrize("kind", ["D16", "D24", "D32F", "D24S8", "D32FS8"])
def test_depth_is_that_of_a_plane(shown, planes, expected, kind):
    near_z, far_z = planes
    run = shown("plain", "--depth", kind, "--near-z", near_z, "--far-z", far_z)
    check_clean(run)
    view = run.frames[-1]["layers"][0]["views"][1]
    assert view["depth"]["range_and_planes"] == pytest.approx(
        [0, 1, float(near_z), float(far_z)]
    )
    depth = pixels_of(run.folder, view["depth"])
    assert depth.shape == SIZE_PX[::-1]
    assert np.abs(depth - expected / DISTANCE_M).max() < 1e-5


def test_depth_is_no_number_in_half_of_the_columns(shown):
    run = shown("depth-nan")
    check_clean(run)
    depth = pixels_of(run.folder, run.frames[-1]["layers"][0]["views"][0]["depth"])
    odd = depth[:, 1::2]
    assert (np.isnan(odd) | (odd == 0)).all()  # Mesa clamps it to 0
    assert (depth[:, ::2] > 0).all()


def plane_depth(z_m):
    return FAR_M * (z_m - NEAR_M) / (z_m * (FAR_M - NEAR_M))


def is_plane(depth, z_m):
    return np.allclose(depth, plane_depth(z_m), atol=1e-5)


FAULTS = {
    "depth-constant": lambda depth, info: (depth == 1).all(),
    "depth-swapped": lambda depth, info: (
        is_plane(depth, DISTANCE_M) and info["range_and_planes"][2] == FAR_M
    ),
    "depth-zero-near": lambda depth, info: info["range_and_planes"][2] == 0,
    "depth-size": lambda depth, info: (
        is_plane(depth, DISTANCE_M)
        and depth.shape == (SIZE_PX[1] // 2, SIZE_PX[0] // 2)
    ),
    "depth-stale": lambda depth, info: (
        is_plane(depth, DISTANCE_M) and info["releases"] == 1
    ),
    "depth-garbage": lambda depth, info: 0.2 < depth.std() < 0.4,
    "depth-other-array": lambda depth, info: is_plane(
        depth, DISTANCE_M * (2 - info["view"])
    ),
}


@pytest.mark.parametrize(("case", "has_fault"), FAULTS.items())
def test_depth_has_its_fault(shown, case, has_fault):
    run = shown(case)
    check_clean(run)
    for i, view in enumerate(run.frames[-1]["layers"][0]["views"]):
        info = view["depth"] | {"view": i}
        assert has_fault(pixels_of(run.folder, info), info)


def test_without_the_extension_there_is_no_depth(shown):
    offered = "XR_KHR_opengl_enable,XR_MNDX_egl_enable"
    run = shown("plain", MOCK_XR_EXTENSIONS=offered)
    check_clean(run)
    assert all("depth" not in view for view in run.frames[-1]["layers"][0]["views"])


def test_color_formats(shown):
    full = {"RGBA8": 255, "RGBA16F": 1.0, "RGB10_A2": np.array([1023] * 3 + [3])}
    for kind, most in full.items():
        run = shown("plain", "--format", kind)
        check_clean(run)
        view = run.frames[-1]["layers"][0]["views"][0]
        last = [line for line in run.told if "frame" in line][-1]["frame"]
        expected = drawn(last, 0, SIZE_PX) / 255
        share = pixels_of(run.folder, view) / most
        np.testing.assert_array_equal(share[..., :3], expected)
        np.testing.assert_array_equal(share[..., 3], 1)
        shutil.rmtree(run.folder)


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("two-layers", ["projection", "projection"]),
        ("quad-below", ["quad", "projection"]),
        ("quad-above", ["projection", "quad"]),
    ],
)
def test_layers_keep_their_order(shown, case, expected):
    run = shown(case)
    check_clean(run)
    for told, frame in run.pairs():
        assert [layer["type"] for layer in frame["layers"]] == expected
        for layer in frame["layers"]:
            if layer["type"] == "quad":
                pixels = pixels_of(run.folder, layer)[..., :3]
                size_px = pixels.shape[1::-1]
                assert (pixels == drawn(told["frame"], 2, size_px)).all()


def test_alpha_is_a_gradient(shown):
    run = shown("alpha")
    check_clean(run)
    width = SIZE_PX[0]
    alpha = np.round(255 * np.arange(width) / width)
    assert check_pictures(run, alpha) == 2 * N_FRAMES
    assert run.frames[-1]["layers"][0]["flags"] == 6


def test_a_picture_is_upside_down(shown):
    run = shown("fov-flipped")
    check_clean(run)
    for told, frame in run.pairs():
        for i, view in enumerate(frame["layers"][0]["views"]):
            *_, up, down = view["fov"]
            assert up < 0 < down
            pixels = pixels_of(run.folder, view)[::-1, :, :3]
            assert (pixels == drawn(told["frame"], i, SIZE_PX)).all()


def test_an_image_is_shown_again(shown):
    for case, releases in {"reuse": 1, "half-rate": N_FRAMES // 2}.items():
        run = shown(case)
        check_clean(run)
        view = run.frames[-1]["layers"][0]["views"][0]
        assert view["releases"] == releases
        shutil.rmtree(run.folder)


def test_the_head_moves_as_scripted(shown, tmp_path):
    turn = (0.0, np.sin(0.2), 0.0, np.cos(0.2))
    heads = [(0.1 * i, 1.0, -0.5, *turn) for i in range(4)]
    lines = [" ".join(map(str, head)) for head in heads]
    (tmp_path / "head.txt").write_text("\n".join(lines))
    run = shown("plain", MOCK_XR_HEAD=str(tmp_path / "head.txt"))
    check_clean(run)
    for frame in run.frames:
        views = frame["layers"][0]["views"]
        middle = np.mean([view["pose"] for view in views], axis=0)
        head = heads[min(frame["frame"], len(heads) - 1)]
        np.testing.assert_allclose(middle, head, atol=1e-6)


def test_spaces_are_told_apart(shown):
    for case, kind in {"view-locked": "VIEW", "action-space": "ACTION"}.items():
        run = shown(case)
        check_clean(run)
        kinds = {frame["layers"][0]["space"]["kind"] for frame in run.frames}
        assert kinds == {kind}
        shutil.rmtree(run.folder)


def test_gaze_is_where_it_was_scripted(shown):
    run = shown("action-space", MOCK_XR_GAZE_DEG="90,0")
    check_clean(run)
    left, right = run.frames[-1]["layers"][0]["views"]
    # The eyes stand aside of each other along x, which is the gaze's own forward, -z.
    apart = np.subtract(right["pose"], left["pose"])[:3]
    np.testing.assert_allclose(apart, (0, 0, -0.064), atol=1e-6)


def test_local_space_is_recentered(shown):
    run = shown("plain", MOCK_XR_RECENTER_AT="4")
    check_clean(run)
    turned = [f["layers"][0]["views"][0]["pose"][4] != 0 for f in run.frames]
    assert turned == [frame["frame"] > 4 for frame in run.frames]


def test_waits_for_images_are_in_vain_at_first(shown):
    run = shown("poll", MOCK_XR_WAIT_TIMEOUTS="5")
    check_clean(run)
    assert run.told[-1]["timeouts"] == 5
    assert check_pictures(run) == 2 * N_FRAMES


def test_the_session_is_lost(shown):
    for when, code in {
        "4": "XR_ERROR_SESSION_LOST",
        "4,instance": "XR_ERROR_INSTANCE_LOST",
    }.items():
        run = shown("plain", MOCK_XR_LOSE_AT=when)
        assert run.exit_code == 1
        assert run.told[-1]["error"] == code
        shutil.rmtree(run.folder)


def test_mono_views_are_an_option(shown):
    assert shown("mono").exit_code == 77
    run = shown("mono", MOCK_XR_MONO="1")
    check_clean(run)
    assert check_pictures(run) == N_FRAMES


WRONG = {
    "rect": "XR_ERROR_SWAPCHAIN_RECT_INVALID",
    "array index": "XR_ERROR_VALIDATION_FAILURE",
    "never released": "XR_ERROR_LAYER_INVALID",
    "space": "XR_ERROR_HANDLE_INVALID",
    "pose": "XR_ERROR_POSE_INVALID",
    "fov": "XR_ERROR_VALIDATION_FAILURE",
    "view count": "XR_ERROR_VALIDATION_FAILURE",
    "chain": "XR_ERROR_VALIDATION_FAILURE",
    "flags": "XR_ERROR_VALIDATION_FAILURE",
    "depth for color": "XR_ERROR_VALIDATION_FAILURE",
    "depth rect": "XR_ERROR_SWAPCHAIN_RECT_INVALID",
    "blend mode": "XR_ERROR_ENVIRONMENT_BLEND_MODE_UNSUPPORTED",
    "layer type": "XR_ERROR_LAYER_INVALID",
    "time": "XR_ERROR_TIME_INVALID",
    "swapchain": "XR_ERROR_HANDLE_INVALID",
    "wait": "XR_ERROR_CALL_ORDER_INVALID",
    "release": "XR_ERROR_CALL_ORDER_INVALID",
    "begin": "XR_ERROR_CALL_ORDER_INVALID",
    "end session": "XR_ERROR_SESSION_NOT_STOPPING",
    "context": "XR_SUCCESS",
}


def test_what_is_wrong_is_reported(shown):
    run = shown("violation")
    tried = {
        line["violation"]: line["code"] for line in run.told if "violation" in line
    }
    assert tried == WRONG
    assert len(run.violations) == len(WRONG)
    assert all(line.startswith("mock: violation: xr") for line in run.violations)


@pytest.mark.parametrize("case", ["depth-equal", "depth-range", "depth-rect"])
def test_depth_that_is_not_valid_is_reported(shown, case):
    run = shown(case)
    assert len(run.violations) == N_FRAMES
    assert run.frames == []
    run = shown(case, MOCK_XR_LENIENT_DEPTH="1")
    assert len(run.frames) == N_FRAMES
    assert {line["end_frame"] for line in run.told if "frame" in line} == {"XR_SUCCESS"}


@pytest.mark.parametrize(
    "case", ["plain", "other-thread", "end-from-thread", "restart"]
)
def test_threads_do_not_race(watched, tmp_path, case):
    manifest, program = watched
    run = Run(
        *(manifest, tmp_path, program, case, "--frames", N_FRAMES, "--threads"),
        **build.thread_sanitizer_options(tmp_path),
    )
    assert "WARNING: ThreadSanitizer" not in run.said
    check_clean(run, 3 * N_FRAMES if case == "restart" else N_FRAMES)


def test_addresses_are_valid(tmp_path, driver):
    library = runtime_of("address")
    if library is None:
        pytest.skip("no AddressSanitizer here")
    manifest = build.build_runtime(tmp_path, "-fsanitize=address,undefined")
    variables = {"LD_PRELOAD": str(library), "ASAN_OPTIONS": "detect_leaks=0"}
    for case, n_frames in {"msaa4": N_FRAMES, "second-session": 3 * N_FRAMES}.items():
        options = ("--frames", N_FRAMES)
        run = Run(manifest, tmp_path, driver, case, *options, **variables)
        assert "ERROR: AddressSanitizer" not in run.said
        check_clean(run, n_frames)


@pytest.mark.skipif(shutil.which("hello_xr") is None, reason="no hello_xr here")
def test_hello_xr_is_shown(runtime, tmp_path, display):
    n_frames = 60
    frames, violations = run_hello_xr(runtime, tmp_path, display, n_frames)
    assert violations == []
    assert len(frames) == n_frames
    for frame in frames:
        for view in frame["layers"][0]["views"]:
            assert pixels_of(tmp_path / "captured", view)[..., :3].max() > 0
