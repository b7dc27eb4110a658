"""A runtime that ends with the test; without one, tests are skipped."""

import contextlib
import shutil

import pytest

from tests.headset.monado import Monado


def pytest_collection_modifyitems(items):
    """Skip where there is no runtime."""
    if shutil.which("monado-service") is None:
        reason = "no runtime of OpenXR here; tests/headset/run_in_root.sh has one"
        for item in items:
            if "tests/headset" in item.nodeid:
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture
def started(tmp_path):
    """Return how to start a runtime that ends with the test."""
    with contextlib.ExitStack() as stack:
        yield lambda **options: stack.enter_context(Monado(tmp_path, **options))
