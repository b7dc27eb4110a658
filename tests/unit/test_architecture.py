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

LAYERS = {
    # package of the service: those of its own packages that it may import
    "gl": (),
    "wire": (),
    "planning": ("wire",),
    "psfs": ("planning", "wire", "gl"),
    "rendering": ("psfs", "planning", "wire", "gl"),
    "service": ("rendering", "psfs", "planning", "wire", "gl"),
    "commands": ("service", "rendering", "psfs", "planning", "wire", "gl"),
}
"""A frame's data runs one way; each layer knows only those before it."""

HOME = {
    # library: files that may import it, each with its reason
    "torch": ("training/*",),  # the service must run without it
    "onnx": ("training/*",),
    "onnxruntime": (
        "estimator/networks.py",
        "training/export.py",  # judges the file that it wrote
    ),
    "moderngl": (
        "filter_service/gl/gpu.py",  # one owner of the context
        "clients/window.py",  # shows frames in a window of its own
    ),
    "glfw": ("clients/window.py",),
    "zmq": (
        "filter_service/service/server.py",
        "filter_service/service/mailbox.py",  # the server's socket and nothing else
        "clients/connection.py",  # the client's socket and nothing else
    ),
    "msgpack": ("filter_service/messages.py", "filter_service/wire/checks.py"),
    "numba": (
        "estimator/psf_*.py",  # kernels of the PSF engines
        "estimator/raytrace_kernels.py",
        "estimator/chief_ray_kernels.py",
        "estimator/wavefront_*.py",  # aiming and fitting
        "filter_service/rendering/reference*.py",  # twins of the passes
        "filter_service/psfs/pack.py",  # loops over single kernels
        "filter_service/psfs/read_kernels.py",  # planning a frame
        "filter_service/rendering/cell_maps.py",
        "filter_service/rendering/kernel_loops.py",
        "filter_service/commands/doctor_probes.py",  # asks which threads it runs on
        "filter_service/service/threads.py",
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
        "training/learning_curve.py",
    ),
    "OpenEXR": ("filter_service/commands/image_files.py",),
    "PIL": (
        "filter_service/commands/image_files.py",
        "filter_service/psfs/picture.py",
        "clients/*",  # captions, textures, contact sheet
    ),
    "typer": ("filter_service/__main__.py", "filter_service/commands/*"),
    "rich": ("filter_service/commands/*", "clients/*", "training/*"),  # progress bars
    "hypothesis": ("tests/*",),
    "pytest": ("tests/*",),
}

ANYWHERE = {"numpy"}
SCIPY_FREE = ("clients/*",)  # a client needs no scientific stack

NEVER_LOADED_BY_CLIENT_LIBRARY = (
    "estimator",
    "filter_service.gl.gpu",
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


@pytest.mark.parametrize("layer", LAYERS)
def test_layers_of_the_service_import_only_those_before_them(layer):
    allowed = [f"filter_service.{name}" for name in (layer, *LAYERS[layer])]
    layers = [f"filter_service.{name}" for name in LAYERS]
    wrong = [
        f"{entry.file}:{entry.line} imports {entry.module}"
        for entry in package_imports(f"filter_service/{layer}")
        if _may(entry.module, tuple(layers)) and not _may(entry.module, tuple(allowed))
    ]
    assert not wrong, "\n".join(wrong)


def test_every_folder_of_the_service_is_a_layer():
    folders = (ROOT / "filter_service").glob("*/__init__.py")
    assert {path.parent.name for path in folders} == set(LAYERS)


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
        "def f():\n    import torch\n    from filter_service.gl import gpu\n"
    )
    modules = [entry.module for entry in package_imports("estimator")]
    assert modules == ["torch", "filter_service.gl.gpu"]
    assert not _may("filter_service.gl.gpu", MAY_IMPORT["estimator"])
    assert not _may("filter_service.messages_extra", MAY_IMPORT["clients"])
