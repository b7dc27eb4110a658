"""Who may import whom, and which file is the home of which library."""

import subprocess
import sys
from fnmatch import fnmatch

import pytest

from tests.source_tree import PACKAGES, ROOT, imports_of, package_imports

MAY_IMPORT = {
    "estimator": ("estimator",),
    "filter_service": ("filter_service", "estimator"),
    "training": ("training", "estimator"),
    "clients": ("clients", "filter_service.messages", "filter_service.errors"),
}
"""Ours that each package may import, as dotted prefixes."""

HOME = {
    # library: files that may import it, each with its reason
    "torch": ("training/*",),  # the service must run without it
    "onnx": ("training/*",),
    "onnxruntime": ("estimator/networks.py",),
    "moderngl": (
        "filter_service/gpu.py",  # one owner of the context
        "clients/window.py",  # shows frames in a window of its own
    ),
    "glfw": ("clients/window.py",),
    "zmq": (
        "filter_service/server.py",
        "filter_service/mailbox.py",  # the server's socket and nothing else
        "clients/connection.py",  # the client's socket and nothing else
    ),
    "msgpack": ("filter_service/messages.py", "filter_service/wire_checks.py"),
    "numba": (
        "estimator/psf_*.py",  # kernels of the PSF engines
        "estimator/raytrace_kernels.py",
        "estimator/wavefront_*.py",  # aiming and fitting
        "filter_service/reference*.py",  # twins of the passes
        "filter_service/psf_pack.py",  # loops over single kernels
        "filter_service/doctor_probes.py",  # asks which threads it runs on
        "filter_service/threads.py",
    ),
    "pyrender": ("clients/*",),
    "trimesh": ("clients/*",),
    "OpenGL": ("clients/*",),
    "pyglet": ("clients/*",),
    "imageio": ("clients/*",),
    "imageio_ffmpeg": ("clients/*",),  # videos
    "matplotlib": (
        "clients/*",
        "tests/*",  # plots of measurements
        "estimator/eye_plot.py",  # `ocufilter estimate --plot`
    ),
    "OpenEXR": ("filter_service/image_files.py",),
    "PIL": (
        "filter_service/image_files.py",
        "filter_service/psf_picture.py",
        "clients/*",  # captions, textures, contact sheet
    ),
    "typer": ("filter_service/__main__.py", "filter_service/commands/*"),
    "rich": ("filter_service/commands/*", "clients/*"),  # progress bars
    "hypothesis": ("tests/*",),
    "pytest": ("tests/*",),
}

ANYWHERE = {"numpy"}
SCIPY_FREE = ("clients/*",)  # a client needs no scientific stack

NEVER_LOADED_BY_CLIENT_LIBRARY = (
    "estimator",
    "filter_service.gpu",
    "moderngl",
    "numba",
    "scipy",
    "torch",
)


def _may(module: str, prefixes: tuple[str, ...]) -> bool:
    return any(module == p or module.startswith(p + ".") for p in prefixes)


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_in_the_allowed_direction(package):
    wrong = [
        f"{entry.file}:{entry.line} imports {entry.module}"
        for entry in package_imports(package)
        if entry.top in (*PACKAGES, "tests")
        and not _may(entry.module, MAY_IMPORT[package])
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_library_is_imported_in_its_home_only(package):
    wrong = []
    for entry in package_imports(package):
        if entry.top in (*PACKAGES, "tests", *sys.stdlib_module_names, *ANYWHERE):
            continue
        if entry.top == "scipy":
            allowed = not any(fnmatch(entry.file, p) for p in SCIPY_FREE)
        else:
            homes = HOME.get(entry.top, ())
            allowed = any(fnmatch(entry.file, pattern) for pattern in homes)
        if not allowed:
            wrong.append(f"{entry.file}:{entry.line} imports {entry.top}")
    assert not wrong, "\n".join(wrong)


def test_filter_service_init_imports_nothing_so_that_clients_stay_light():
    assert imports_of(ROOT / "filter_service" / "__init__.py") == []


def test_the_client_library_loads_neither_opengl_nor_the_eye_model():
    script = (
        "import sys, clients.filter_client\n"
        f"wrong = [m for m in {NEVER_LOADED_BY_CLIENT_LIBRARY!r} if m in sys.modules]\n"
        "sys.exit(' '.join(wrong) or 0)"
    )
    finished = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True
    )
    assert finished.returncode == 0, finished.stderr


def test_the_rules_catch_a_wrong_import(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.source_tree.ROOT", tmp_path)
    folder = tmp_path / "estimator"
    folder.mkdir()
    (folder / "bad.py").write_text(
        "def f():\n    import torch\n    from filter_service import gpu\n"
    )
    modules = [entry.module for entry in package_imports("estimator")]
    assert modules == ["torch", "filter_service.gpu"]
    assert not _may("filter_service.gpu", MAY_IMPORT["estimator"])
    assert not _may("filter_service.messages_extra", MAY_IMPORT["clients"])
