"""Shared fixtures: a seed per test, strict arithmetic, one OpenGL context."""

import gc
import os
import random
import zlib
from dataclasses import dataclass
from pathlib import Path

# a service that a test starts leaves the user's folder of stores alone
os.environ["OCUFILTER_CACHE_DIR"] = ""

import numpy as np
import pytest

# Underflow to zero is what the tail of every Gaussian and PSF is meant to do.
np.seterr(divide="raise", over="raise", invalid="raise", under="ignore")

SESSION_GPU = pytest.StashKey()

MOST_LONG_CASES = 180
"""Of one collection: what `make test` may hold of cases longer than the budget."""

ENGINES = ("native", "gl")

PSF_METHODS = ("enz", "fourier", "geometric")
SMALL_PSF = {"pupil_diameter_mm": 3.0, "wavelength_nm": 550.0, "pixel_pitch_mrad": 1.3}


def pytest_configure(config):
    """Record durations if the environment asks for it."""
    path = os.environ.get("OCUFILTER_DURATIONS")
    if path:
        from tests.audit.durations import Durations

        config.pluginmanager.register(Durations(Path(path)), "durations")


def _seed(node_id: str) -> int:
    """The same for both engines."""
    for engine in ENGINES:
        node_id = node_id.replace(f"[{engine}]", "").replace(f"[{engine}-", "[")
    return zlib.crc32(node_id.encode())


@pytest.fixture(autouse=True)
def seeded(request):
    """Give every test its own fixed seed, whatever ran before it."""
    random.seed(_seed(request.node.nodeid))


@pytest.fixture(scope="session", autouse=True)
def loaded(request):
    """Load in each worker what many tests share: no case pays for it as the first.

    A process that runs a few files itself loads what those need.
    """
    if not hasattr(request.config, "workerinput"):
        return
    from clients.figures.style import new_figure
    from estimator.psf.compute import compute_psfs
    from tests.reference.psf_integral import reference_kernel

    for method in PSF_METHODS:
        compute_psfs(np.zeros((1, 28)), method=method, **SMALL_PSF)
    reference_kernel(np.zeros(28), radius_px=2, **SMALL_PSF)
    new_figure(9.0, 9.0).subplots()
    # A full collection of all that is loaded takes 0.3 s, in whichever case it falls.
    gc.collect()
    gc.freeze()


@pytest.fixture
def rng(request):
    """A generator seeded by the test's name."""
    return np.random.default_rng(_seed(request.node.nodeid))


@pytest.fixture(scope="session")
def gpu(pytestconfig):
    """The one OpenGL context of the test run; a test leaves it without errors."""
    from filter_service.gl.gpu import Gpu

    pytestconfig.stash[SESSION_GPU] = Gpu()
    return pytestconfig.stash[SESSION_GPU]


@dataclass(frozen=True)
class Engine:
    """A frame engine that tests make renderers of.

    Attributes
    ----------
    gpu : Gpu or None
        The context of the test run, where the engine is gl.
    """

    name: str
    gpu: object = None

    def new_renderer(self):
        """A renderer of its own."""
        if self.gpu is None:
            from filter_service.rendering.native import NativeRenderer

            return NativeRenderer()
        from filter_service.rendering.gl import FilterRenderer

        return FilterRenderer(self.gpu)

    def limit_kernels(self, monkeypatch, texel_count, pixel_count):
        """Let a frame's kernels take no more than so many texels."""
        if self.gpu is None:
            from filter_service.rendering import image_cells

            per_pixel = texel_count / pixel_count
            monkeypatch.setattr(image_cells, "TEXELS_PER_PIXEL", per_pixel)
        else:
            from filter_service.rendering.gl import kernel_passes

            monkeypatch.setattr(kernel_passes, "MAX_KERNEL_TEXELS", texel_count)


def pytest_generate_tests(metafunc):
    """Run tests of the renderer on both engines; gl among the slow ones.

    Those marked ``both_engines`` run on gl in `make test-gl` as well.
    """
    if "engine" not in metafunc.fixturenames:
        return
    always = metafunc.definition.get_closest_marker("both_engines") is not None
    marks = [pytest.mark.gl, *[pytest.mark.slow] * (not always)]
    gl = pytest.param("gl", marks=marks)
    metafunc.parametrize("engine", ["native", gl], indirect=True, scope="session")


@pytest.fixture(scope="session")
def engine(request):
    """Each frame engine in turn."""
    if request.param == "native":
        return Engine("native")
    return Engine("gl", request.getfixturevalue("gpu"))


@pytest.fixture(scope="session")
def gl_engine(gpu):
    """The engine of compute shaders, for what is its own."""
    return Engine("gl", gpu)


def _refusal_of_long(items):
    """Return what is wrong with the marks ``long`` of selected cases, or ''."""
    marked = [(item, mark) for item in items for mark in item.iter_markers("long")]
    for item, mark in marked:
        reason = mark.args[0] if len(mark.args) == 1 else None
        if mark.kwargs or not isinstance(reason, str) or not reason.strip():
            given = mark.kwargs or mark.args or "none"
            return (
                f"{item.nodeid}: the mark long takes one reason, a text; it has {given}"
            )
    count = len({item.nodeid for item, _ in marked})
    if count > MOST_LONG_CASES:
        return f"{count} cases are marked long; allowed: at most {MOST_LONG_CASES}"
    return ""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Refuse marks ``long`` without a reason, and too many cases that have one.

    A worker of xdist cannot refuse: it selects nothing and tells its controller.
    """
    refusal = _refusal_of_long(items)
    if refusal and hasattr(config, "workeroutput"):
        config.workeroutput["refusal"] = refusal
        items.clear()
    elif refusal:
        raise pytest.UsageError(refusal)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """Refuse what a worker of xdist could not."""
    refusal = getattr(node, "workeroutput", {}).get("refusal")
    if refusal:
        raise pytest.UsageError(refusal)


def uses_gl(item):
    """Whether a test needs the OpenGL context."""
    call = getattr(item, "callspec", None)
    if call is not None and "engine" in call.params:
        return call.params["engine"] == "gl"
    return "gpu" in item.fixturenames


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Make the context current before any fixture: other tests leave none."""
    if uses_gl(item) and SESSION_GPU in item.config.stash:
        item.config.stash[SESSION_GPU].context.__enter__()


@pytest.fixture(autouse=True)
def clean_gl_errors(request):
    """Fail a test that starts or ends with an OpenGL error pending."""
    if not uses_gl(request.node):
        yield
        return
    context = request.getfixturevalue("gpu").context
    assert context.error == "GL_NO_ERROR", "left over from an earlier test"
    yield
    assert context.error == "GL_NO_ERROR", "an OpenGL call of this test failed"


@pytest.fixture(autouse=True)
def hardware_only(request):
    """Skip tests marked ``gpu`` where a software renderer stands in for one."""
    if request.node.get_closest_marker("gpu") is None:
        return
    gpu = request.getfixturevalue("gpu")
    if gpu.is_software:
        pytest.skip(f"needs a hardware GPU; this is {gpu.info['renderer']}")
