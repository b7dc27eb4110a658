"""Shared fixtures: a seed per test, strict arithmetic, one OpenGL context."""

import os
import random
import zlib
from dataclasses import dataclass

# two cores are what the project plans for; must be set before numba is imported
os.environ.setdefault("NUMBA_NUM_THREADS", str(min(2, os.cpu_count() or 1)))

# a service that a test starts leaves the user's folder of stores alone
os.environ["OCUFILTER_CACHE_DIR"] = ""

import numpy as np
import pytest

# Underflow to zero is what the tail of every Gaussian and PSF is meant to do.
np.seterr(divide="raise", over="raise", invalid="raise", under="ignore")

SESSION_GPU = pytest.StashKey()

ENGINES = ("native", "gl")


def _seed(node_id: str) -> int:
    """The same for both engines."""
    for engine in ENGINES:
        node_id = node_id.replace(f"[{engine}]", "").replace(f"[{engine}-", "[")
    return zlib.crc32(node_id.encode())


@pytest.fixture(autouse=True)
def seeded(request):
    """Give every test its own fixed seed, whatever ran before it."""
    random.seed(_seed(request.node.nodeid))


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

    Those marked ``both_engines`` run on gl every time.
    """
    if "engine" not in metafunc.fixturenames:
        return
    always = metafunc.definition.get_closest_marker("both_engines") is not None
    gl = pytest.param("gl", marks=() if always else pytest.mark.slow)
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
