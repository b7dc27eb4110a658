"""The runtime and the application, built once; where that fails, tests are skipped."""

import shutil

import pytest

from tests.headset.xorg import Xorg
from tests.native_build import runtime_of
from tests.openxr_layer import build

collect_ignore = ["applications"]  # only if named: another root and more time


def pytest_collection_modifyitems(items):
    """Skip where nothing can be built."""
    reason = build.missing()
    for item in items:
        if reason and "tests/openxr_layer" in item.nodeid:
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def runtime(tmp_path_factory):
    """Return the manifest of the mock runtime."""
    return build.build_runtime(tmp_path_factory.mktemp("runtime"))


@pytest.fixture(scope="session")
def driver(tmp_path_factory):
    """Return the path of the application."""
    return build.build_driver(tmp_path_factory.mktemp("driver"))


@pytest.fixture(scope="session")
def watched(tmp_path_factory):
    """Return both, built for ThreadSanitizer."""
    if runtime_of("thread") is None:
        pytest.skip("no ThreadSanitizer here")
    folder = tmp_path_factory.mktemp("watched")
    flag = "-fsanitize=thread"
    return build.build_runtime(folder, flag), build.build_driver(folder, flag)


@pytest.fixture(scope="session")
def layer(tmp_path_factory):
    """Return the path of the layer's library."""
    return build.build_layer(tmp_path_factory.mktemp("layer"))


@pytest.fixture(scope="session")
def display(tmp_path_factory):
    """Return the name of a display with a dummy screen."""
    if shutil.which("Xorg") is None:
        pytest.skip("no Xorg with its dummy driver here")
    server = Xorg(tmp_path_factory.mktemp("xorg"))
    try:
        yield server.start()
    finally:
        server.stop()
