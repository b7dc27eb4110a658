"""Shared fixtures: a seed per test, strict arithmetic, one OpenGL context."""

import os
import random
import zlib

# two cores are what the project plans for; must be set before numba is imported
os.environ.setdefault("NUMBA_NUM_THREADS", str(min(2, os.cpu_count() or 1)))

# a service that a test starts leaves the user's folder of stores alone
os.environ["OCUFILTER_CACHE_DIR"] = ""

import numpy as np
import pytest

# Underflow to zero is what the tail of every Gaussian and PSF is meant to do.
np.seterr(divide="raise", over="raise", invalid="raise", under="ignore")

SESSION_GPU = pytest.StashKey()

SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "swr")


def _seed(node_id: str) -> int:
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


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Make the context current before any fixture: pyrender's tests leave theirs."""
    if "gpu" in item.fixturenames and SESSION_GPU in item.config.stash:
        item.config.stash[SESSION_GPU].context.__enter__()


@pytest.fixture(autouse=True)
def clean_gl_errors(request):
    """Fail a test that starts or ends with an OpenGL error pending."""
    if "gpu" not in request.fixturenames:
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
    renderer = request.getfixturevalue("gpu").info["renderer"]
    if any(name in renderer.lower() for name in SOFTWARE_RENDERERS):
        pytest.skip(f"needs a hardware GPU; this is {renderer}")
