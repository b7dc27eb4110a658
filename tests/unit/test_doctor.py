"""What `ocufilter doctor` makes of the shaders."""

import pytest

from filter_service.commands import doctor_checks
from filter_service.commands.doctor_checks import check_packages, check_shaders
from filter_service.commands.doctor_probes import probe_shaders
from filter_service.gl import shader_source
from filter_service.gl.gpu import Gpu

GOOD = {"program_count": 27, "frame_error": 0.0, "psf_error": 0.04}


def test_the_probe_runs_every_pass_and_all_is_well(monkeypatch):
    compiled = set()
    program = Gpu.program

    def noting(gpu, name, **defines):
        compiled.add(f"{name}.comp.glsl")
        return program(gpu, name, **defines)

    monkeypatch.setattr(Gpu, "program", noting)
    found = probe_shaders()
    check = check_shaders({}, found)
    assert check.ok and not check.fix, check
    assert f"{found['program_count']} programs" in check.detail
    passes = shader_source.SHADER_ROOT / "passes"
    assert compiled == {path.name for path in passes.glob("*.glsl")}


def test_a_missing_shader_is_named_with_what_brings_it_back(monkeypatch, tmp_path):
    monkeypatch.setattr(shader_source, "SHADER_ROOT", tmp_path)
    check = check_shaders({}, probe_shaders())
    assert not check.ok
    assert "'passes/build_fragments.comp.glsl' does not exist" in check.detail
    assert check.fix == "git checkout -- shaders"


def test_a_shader_that_does_not_compile_is_named_in_one_line(monkeypatch, tmp_path):
    (tmp_path / "passes").mkdir()
    (tmp_path / "passes" / "build_fragments.comp.glsl").write_text("nonsense\n")
    monkeypatch.setattr(shader_source, "SHADER_ROOT", tmp_path)
    check = check_shaders({}, probe_shaders())
    assert not check.ok
    assert "build_fragments.comp.glsl" in check.detail
    assert "\n" not in check.detail


@pytest.mark.parametrize(
    "change",
    [
        {"frame_error": 0.01},
        {"frame_error": float("nan")},
        {"psf_error": 0.2},
        {"psf_error": float("nan")},
    ],
)
def test_wrong_pictures_and_psfs_fail(change):
    assert check_shaders({}, GOOD).ok
    check = check_shaders({}, GOOD | change)
    assert not check.ok and "driver" in check.fix


def test_without_opengl_shaders_are_not_tried():
    check = check_shaders({"error": "no context"}, {})
    assert not check.ok and "not tried" in check.detail


@pytest.mark.parametrize("lost", ["gl", "compute", "shaders"])
def test_filter_and_serve_need_the_shaders(lost):
    names = ("python", "service packages", "gl", "compute", "shaders", "threads")
    ok = dict.fromkeys((*names, "client packages", "window packages", "display"), True)
    assert all(doctor_checks.what_works(ok).values())
    works = doctor_checks.what_works(ok | {lost: False})
    assert [name for name, it_works in works.items() if it_works] == ["psf"]


def test_a_wheel_s_missing_packages_are_installed_with_pip(monkeypatch):
    monkeypatch.setattr(doctor_checks, "IN_CHECKOUT", False)
    versions = {"pyrender": None, "trimesh": "1", "imageio": None, "glfw": None}
    check = check_packages("client packages", ("pyrender", "imageio"), versions)
    assert check.fix == f"pip install imageio && {doctor_checks.FIX_PYRENDER}"
    check = check_packages("window packages", ("glfw",), versions)
    assert check.fix == "pip install glfw"
