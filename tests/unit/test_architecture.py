"""Who may import whom, and which file is the home of which library."""

import importlib
import re
import subprocess
import sys
from fnmatch import fnmatch

import pytest

import estimator
import filter_service
import ocufilter
from tests.source_tree import (
    PACKAGES,
    ROOT,
    imports_of,
    package_imports,
    python_files,
)

FACE = tuple(f"filter_service.{name}" for name in filter_service.__all__)
"""What `filter_service` shows to researchers and clients."""

EYE_FACE = tuple(f"estimator.{name}" for name in estimator.__all__)
"""What `estimator` shows to them."""

MAY_IMPORT = {
    "estimator": ("estimator",),
    "filter_service": ("filter_service", "estimator"),
    "training": ("training", "estimator"),
    "clients": (
        "clients",
        "filter_service.messages",
        "filter_service.errors",
        "filter_service.command_line",  # of all commands
        "filter_service.progress",  # of long programs
        "filter_service.waiting",  # and of waits
        "filter_service.atomic_files",  # files that people keep
        "filter_service.log_lines",  # logs that stop no one
        "filter_service.keys",  # a client's own
        "filter_service.shared_memory",  # memory shared with the service
        "filter_service.filter_protocol",  # what its filter implements
        "filter_service.settings",
        "filter_service.camera",  # and its options
        "filter_service.image_files",  # pictures and depth in files
        "filter_service.pictures",  # and those that were sent
        "filter_service.bounded_images",  # and their limits
        "filter_service.color_encoding",  # colors of videos
        "estimator.bounded_files",  # text and JSON of files
        "estimator.profile_body",  # a profile as plain values
        "estimator.parse_profile",  # and whether it is one
        "estimator.thread_count",
        "estimator.dynamics",  # of an eye that looks
        "estimator.media",  # how much light an eye scatters
        "estimator.acuity.letters",  # shapes of letters on charts
        *FACE,
        *EYE_FACE,
    ),
    "ocufilter": (
        *("clients", "estimator", "filter_service"),  # whose names it shows
        "clients.commands.program",  # as `python -m ocufilter`
    ),
}
"""Ours that each package may import, as dotted prefixes."""

COMMANDS = "clients/commands/"
"""The command line stands on top of all packages but the tests."""

SCENES_IN_EXAMPLES = (
    "clients.frame_log",
    "clients.pyrender_renderer",
    "clients.scene_renderer",
    "clients.scenes",
    "clients.streaming",
)
"""Modules of scenes, which docs/how-to/pyrender.md describes."""

EXAMPLES_IMPORT = {
    *("trimesh", "numpy", "scipy", "PIL", "matplotlib", "torch", "common"),
}
"""Besides the standard library and the public names."""

ESTIMATOR_SUBPACKAGES = {
    # subpackage of the estimator: the others that it may import
    "native": (),
    "optics": ("native",),
    "wavefront": ("native", "optics"),
    "psf": ("native", "optics"),
    "corrections": ("wavefront", "optics"),
    "media": (),
    "color": (),
    "acuity": ("psf", "optics"),
    "dynamics": (),
    "eye": ("corrections", "wavefront", "optics"),
    "profiles": ("eye", "corrections", "media", "wavefront", "optics"),
    "periphery": ("profiles", "optics"),
    "networks": ("eye", "optics"),
    "estimate": ("networks", "profiles", "eye", "wavefront", "optics"),
    "field": (
        *("native", "estimate", "networks", "periphery", "profiles"),
        *("eye", "corrections", "wavefront", "optics", "psf"),
    ),
    "image_quality": (
        *("field", "estimate", "profiles", "acuity", "media", "corrections", "psf"),
        *("wavefront", "optics"),
    ),
}
"""From light to an eye over its field: each knows only those before it."""

FILTER_SUBPACKAGES = {
    "gl": (),
    "native": (),
    "wire": (),
    "planning": ("native",),
    "psfs": ("planning", "gl", "native"),
    "rendering": ("psfs", "planning", "gl", "native"),
    "building": ("psfs", "planning"),
    "filtering": ("building", "rendering", "psfs", "planning", "gl"),
    "correcting": ("filtering", "rendering"),
    "service": ("filtering", "building", "wire"),
}
"""A frame's data runs one way; each knows only those before it."""

SUBPACKAGES = {"estimator": ESTIMATOR_SUBPACKAGES, "filter_service": FILTER_SUBPACKAGES}


KNOW_MESSAGES = ("service", "wire")
"""Everyone else works on settings, cameras and views, not on what travels."""

HOME = {
    # library: files that may import it, each with its reason
    "torch": ("training/*", "ocufilter/torch.py"),  # never in the service
    "onnx": ("training/*",),
    "onnxruntime": (
        "estimator/networks/inference.py",
        "training/export.py",  # judges the file that it wrote
    ),
    "moderngl": (
        "filter_service/gl/gpu.py",  # one owner of the context
        "filter_service/gl/passes.py",  # and of what runs in it
        "filter_service/gl/staging.py",  # names its types
        "filter_service/gl/current_context.py",  # a context of the caller
        "filter_service/gl/texture_io.py",  # and its textures
        "clients/window.py",  # shows frames in a window of its own
        "clients/scenes/scene_*.py",  # renders scenes
        "clients/headset/*",  # draws into a headset's images
    ),
    "glfw": ("clients/window.py", "clients/headset/openxr_gl.py"),
    "pyrender": ("clients/pyrender_renderer.py",),  # and not before its settings
    "OpenGL": ("clients/pyrender_renderer.py",),  # buffers and errors of pyrender
    "pyglet": ("clients/pyrender_renderer.py",),
    "trimesh": ("clients/pyrender_renderer.py",),  # reads files
    "xr": ("clients/headset/openxr_*",),  # makes PyOpenGL use GLX
    "zmq": (
        "filter_service/service/router.py",  # the server's socket and nothing else
        "filter_service/service/router.py",  # who may connect to it
        "filter_service/service/router.py",  # messages of too many parts
        "filter_service/service/status_query.py",  # one ping
        "filter_service/keys.py",  # makes pairs of them
        "clients/connection.py",  # the client's socket and nothing else
    ),
    "nicegui": ("clients/web/*",),
    "fastapi": ("clients/web/*",),
    "uvicorn": ("clients/web/server.py",),
    "playwright": ("tests/web/*", "tests/benchmarks/bench_web.py"),
    "prometheus_client": ("filter_service/service/metrics.py",),
    "lz4": ("filter_service/wire/images.py",),
    "msgpack": ("filter_service/messages.py", "filter_service/wire/message.py"),
    "msgspec": (
        "estimator/profiles/*",  # types of profiles
        "filter_service/validation.py",  # values against annotated types
        "filter_service/settings.py",  # their limits
        "filter_service/camera.py",
        "filter_service/view_state.py",
        "filter_service/protocol_schema.py",
        "filter_service/wire/*",
        "clients/batch/manifest.py",  # records of earlier runs
    ),
    "weasyprint": ("clients/report/make.py",),  # loads the system library Pango
    "lazy_loader": ("*/__init__.py",),  # names without what they load
    "av": ("clients/batch/video_*.py",),  # frames of videos, exactly
    "ray": ("clients/batch/pools.py",),  # many machines
    "matplotlib": (
        "clients/*",
        "tests/*",  # plots of measurements
        "estimator/estimate/plot.py",  # `ocufilter estimate --plot`
        "estimator/field/field_figure.py",  # `ocufilter field --plot`
        "estimator/psf/drawing.py",  # and PSFs in figures
        "estimator/image_quality/*.py",  # `LabeledArray.plot`
        "training/learning_curve.py",
    ),
    "OpenEXR": ("filter_service/exr_files.py",),
    "PIL": (
        "filter_service/bounded_images.py",  # opens
        "filter_service/pictures.py",  # reads
        "filter_service/image_files.py",  # writes
        "filter_service/psfs/picture.py",
        "clients/*",  # captions, textures, contact sheet
    ),
    "typer": (
        "filter_service/command_line.py",  # what all commands share
        "filter_service/serve.py",
        "clients/*",
    ),
    "rich": ("filter_service/progress.py", "clients/*", "training/*"),  # bars, tables
    "pandas": ("estimator/image_quality/labeled_array.py",),  # on request
    "xarray": ("estimator/image_quality/labeled_array.py",),
    "hypothesis": ("tests/*",),
    "pytest": ("tests/*",),
}

ANYWHERE = {"numpy"}
SCIPY_FREE = ("clients/*",)  # a client needs no scientific stack

NEVER_LOADED_BY_CLIENT_LIBRARY = (
    "estimator",
    "filter_service.gl.gpu",
    "moderngl",
    "scipy",
    "torch",
)


def _may(module: str, prefixes: tuple[str, ...]) -> bool:
    return any(module == p or module.startswith(p + ".") for p in prefixes)


@pytest.fixture(scope="module", autouse=True)
def parsed():
    """Parse all files, whose imports are kept."""
    for package in PACKAGES:
        package_imports(package)


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_in_the_allowed_direction(package):
    wrong = [
        f"{entry.file}:{entry.line} imports {entry.module}"
        for entry in package_imports(package)
        if entry.top in (*PACKAGES, "tests")
        and not _may(entry.module, MAY_IMPORT[package])
        and not entry.file.startswith(COMMANDS)
    ]
    assert not wrong, "\n".join(wrong)


def test_examples_use_what_the_face_shows_and_nothing_else():
    face = {f"ocufilter.{name}" for name in ocufilter.__all__}
    scripts = sorted((ROOT / "examples").glob("*.py"))
    assert len(scripts) > 1
    wrong = [
        f"{entry.file}:{entry.line} imports {entry.module}"
        for path in scripts
        for entry in imports_of(path)
        if entry.module not in face
        and not _may(entry.module, ("ocufilter.torch",))
        and not _may(entry.module, SCENES_IN_EXAMPLES)
        and entry.top not in {*EXAMPLES_IMPORT, *sys.stdlib_module_names}
    ]
    assert not wrong, "\n".join(wrong)


def _subpackages():
    return [(package, name) for package, names in SUBPACKAGES.items() for name in names]


@pytest.mark.parametrize(("package", "subpackage"), _subpackages())
def test_subpackages_import_only_those_before_them(package, subpackage):
    earlier = SUBPACKAGES[package]
    allowed = tuple(f"{package}.{name}" for name in (subpackage, *earlier[subpackage]))
    every = tuple(f"{package}.{name}" for name in earlier)
    wrong = [
        f"{entry.file}:{entry.line} imports {entry.module}"
        for entry in package_imports(f"{package}/{subpackage}")
        if _may(entry.module, every) and not _may(entry.module, allowed)
    ]
    assert not wrong, "\n".join(wrong)


ENGINE_PARTS = (
    "filter_service.gl",
    "filter_service.rendering.gl",
    "filter_service.rendering.native",
)


def test_engines_do_not_know_each_other():
    native = package_imports("filter_service/rendering/native")
    gl = package_imports("filter_service/rendering/gl")
    assert native
    assert gl
    assert not [e for e in native if _may(e.module, ENGINE_PARTS[:2])]
    assert not [e for e in gl if _may(e.module, ENGINE_PARTS[2:])]


def test_what_engines_share_knows_no_engine():
    wrong = [
        f"{entry.file}:{entry.line} imports {entry.module}"
        for path in (ROOT / "filter_service" / "rendering").glob("*.py")
        for entry in imports_of(path)
        if _may(entry.module, ENGINE_PARTS)
    ]
    assert not wrong, "\n".join(wrong)


def test_only_the_service_knows_messages():
    wrong = [
        f"{entry.file}:{entry.line} imports {entry.module}"
        for name in FILTER_SUBPACKAGES
        if name not in KNOW_MESSAGES
        for entry in package_imports(f"filter_service/{name}")
        if _may(entry.module, ("filter_service.messages", "filter_service.wire"))
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", SUBPACKAGES)
def test_every_folder_is_a_subpackage(package):
    folders = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
    modules = {path.stem for path in (ROOT / package).glob("*.py")}
    assert folders <= set(SUBPACKAGES[package]) <= folders | modules


def _graph():
    """Return the modules that each module of ours imports."""
    modules = {}
    for package in PACKAGES:
        for path in python_files(package):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            modules[name.removesuffix(".__init__")] = path
    return {
        name: {
            found
            for entry in imports_of(path)
            for found in (entry.module, entry.module.rpartition(".")[0])
            if found in modules and found != name
        }
        for name, path in modules.items()
    }


def test_no_module_imports_itself_by_a_detour():
    with pytest.raises(StopIteration):
        next(circles(_graph()))


def circles(graph):
    """Yield the circles of a graph {node: its followers}."""
    open_, done = [], set()

    def visit(node):
        if node in open_:
            yield open_[open_.index(node) :]
            return
        if node in done:
            return
        open_.append(node)
        for following in sorted(graph.get(node, ())):
            yield from visit(following)
        open_.pop()
        done.add(node)

    for node in graph:
        yield from visit(node)


def test_circles_are_found():
    assert list(circles({"a": {"b"}, "b": {"c"}, "c": set()})) == []
    assert list(circles({"a": {"b"}, "b": {"c"}, "c": {"b"}})) == [["b", "c"]]


def _packages():
    return [
        path.parent
        for package in ("estimator", "filter_service", "clients", "ocufilter")
        for path in sorted((ROOT / package).rglob("__init__.py"))
    ]


@pytest.mark.parametrize("folder", _packages(), ids=lambda p: str(p.relative_to(ROOT)))
def test_every_package_lists_its_files(folder):
    name = ".".join(folder.relative_to(ROOT).parts)
    face = importlib.import_module(name)
    if folder.name == "scenes":
        return  # a handful of plain modules
    files = {p.stem for p in folder.glob("*.py")} - {"__init__", "__main__"}
    subpackages = {p.parent.name + "/" for p in folder.glob("*/__init__.py")}
    text = (folder / "__init__.py").read_text(encoding="utf-8")
    listed = set(re.findall(r"^ *([\w./]+)  +\S", text, flags=re.MULTILINE))
    if name != "clients":  # its list names what to start with
        assert files | subpackages <= listed, sorted((files | subpackages) - listed)
    for entry in listed:
        path = folder / entry
        assert path.exists() or path.with_suffix(".py").is_file(), entry
    for public in getattr(face, "__all__", ()):
        assert getattr(face, public) is not None


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


def test_the_faces_import_no_more_than_names():
    for package in ("filter_service", "estimator", "clients"):
        found = imports_of(ROOT / package / "__init__.py")
        assert [entry.module for entry in found] == ["lazy_loader"]


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


def test_without_torch_its_layer_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "ocufilter.torch", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ocufilter\[torch\]'"):
        importlib.import_module("ocufilter.torch")


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
