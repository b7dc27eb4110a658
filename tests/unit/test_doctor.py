"""What `ocufilter doctor` makes of the shaders."""

from pathlib import Path

import pytest

from clients.commands import doctor
from clients.commands.doctor import (
    check_engine,
    check_layer,
    check_native,
    check_packages,
    check_shaders,
)
from clients.commands.doctor_probes import probe_native, probe_shaders
from clients.openxr_layer.program import LIBRARY_VARIABLE
from filter_service.gl import passes as gl_passes
from filter_service.gl.passes import Passes
from filter_service.native import library

GOOD = {"program_count": 27, "frame_error": 0.0}


def test_the_probe_runs_every_pass_and_all_is_well(monkeypatch):
    compiled = set()
    program = Passes.program

    def noting(passes, name, **defines):
        compiled.add(f"{name}.comp.glsl")
        return program(passes, name, **defines)

    monkeypatch.setattr(Passes, "program", noting)
    found = probe_shaders()
    check = check_shaders({}, found)
    assert check.ok and not check.fix, check
    assert f"{found['program_count']} programs" in check.detail
    passes = gl_passes.SHADER_ROOT / "passes"
    of_textures = {"sample_input.comp.glsl"}  # of a caller's context
    assert compiled == {path.name for path in passes.glob("*.glsl")} - of_textures


def test_a_missing_shader_is_named_with_what_brings_it_back(monkeypatch, tmp_path):
    monkeypatch.setattr(gl_passes, "SHADER_ROOT", tmp_path)
    check = check_shaders({}, probe_shaders())
    assert not check.ok
    assert "'passes/begin_plan.comp.glsl' does not exist" in check.detail
    assert check.fix == "git checkout -- shaders"


def test_a_shader_that_does_not_compile_is_named_in_one_line(monkeypatch, tmp_path):
    (tmp_path / "passes").mkdir()
    (tmp_path / "passes" / "begin_plan.comp.glsl").write_text("nonsense\n")
    monkeypatch.setattr(gl_passes, "SHADER_ROOT", tmp_path)
    check = check_shaders({}, probe_shaders())
    assert not check.ok
    assert "begin_plan.comp.glsl" in check.detail
    assert "\n" not in check.detail


@pytest.mark.parametrize(
    "change",
    [
        {"frame_error": 0.01},
        {"frame_error": float("nan")},
    ],
)
def test_a_wrong_picture_fails(change):
    assert check_shaders({}, GOOD).ok
    check = check_shaders({}, GOOD | change)
    assert not check.ok
    assert "driver" in check.fix


def test_without_opengl_shaders_are_not_tried():
    check = check_shaders({"error": "no context"}, {})
    assert not check.ok
    assert "not run" in check.detail


CHECKS = (
    *("python", "service packages", "gl", "compute", "shaders", "native"),
    *("client packages", "window packages", "pyrender packages", "display", "layer"),
)


def test_the_demo_needs_no_package_of_the_extras():
    ok = dict.fromkeys(CHECKS, True) | {"client packages": False}
    assert doctor.what_works(ok)["demo"]


@pytest.mark.parametrize("lost", ["gl", "compute", "shaders"])
def test_filter_and_serve_need_the_compiled_libraries_and_no_opengl(lost):
    ok = dict.fromkeys(CHECKS, True)
    assert all(doctor.what_works(ok).values())
    works = doctor.what_works(ok | {lost: False})
    assert works["filter"]
    assert works["serve"]
    assert works["demo"] == (lost != "gl")  # its scenes are rendered with OpenGL
    assert not any(doctor.what_works(ok | {"native": False}).values())


def test_a_layer_that_was_not_built(monkeypatch):
    monkeypatch.setenv(LIBRARY_VARIABLE, "none")
    check = check_layer()
    assert not check.ok
    assert "libvulkan-dev" in check.detail
    ok = dict.fromkeys(CHECKS, True) | {check.name: check.ok}
    assert [name for name, works in doctor.what_works(ok).items() if not works] == [
        "layer"
    ]


def test_the_native_engine_s_probe_filters_a_perfect_eye():
    check = check_native(probe_native())
    assert check.ok
    assert not check.fix
    assert "threads" in check.detail


def test_without_a_compiled_library_a_compiler_is_named(monkeypatch):
    monkeypatch.setattr(library, "PATH", Path("_loops.so"))
    library.loops.cache_clear()
    check = check_native(probe_native())
    library.loops.cache_clear()
    assert not check.ok
    assert "gcc" in check.fix
    assert "not built" in check.detail


LLVMPIPE = {"info": {"renderer": "llvmpipe (LLVM 15)"}}
NATIVE = {"name": "native (avx2, 2 threads)", "frame_error": 0.0}


@pytest.mark.parametrize(
    ("gl", "native", "says"),
    [
        ({"info": {"renderer": "NVIDIA H100"}}, NATIVE, "gl: NVIDIA H100"),
        (LLVMPIPE, NATIVE, "native: llvmpipe"),
        ({"error": "no libEGL"}, NATIVE, "native: no OpenGL"),
        (LLVMPIPE, {"error": "not built"}, "none"),
        ({"error": "no libEGL"}, {"error": "not built"}, "none"),
    ],
)
def test_the_engine_that_will_be_chosen_is_named_with_the_reason(gl, native, says):
    check = check_engine(gl, native)
    assert check.detail.startswith(says)
    assert check.ok == (says != "none")


def test_a_named_device_asks_for_gl(monkeypatch):
    monkeypatch.setenv("OCUFILTER_GL_DEVICE", "0")
    check = check_engine(LLVMPIPE, NATIVE)
    assert check.ok
    assert check.detail.startswith("gl: OCUFILTER_GL_DEVICE")
    check = check_engine({"error": "no such device"}, NATIVE)
    assert not check.ok
    assert check.fix == "unset OCUFILTER_GL_DEVICE"


def test_a_wheel_s_missing_packages_are_installed_with_pip(monkeypatch):
    monkeypatch.setattr(doctor, "IN_CHECKOUT", False)
    versions = {"av": None, "numpy": "1", "lz4": None, "glfw": None}
    check = check_packages("client packages", ("av", "lz4"), versions)
    assert check.fix == "pip install av lz4"
    check = check_packages("window packages", ("glfw",), versions)
    assert check.fix == "pip install glfw"
