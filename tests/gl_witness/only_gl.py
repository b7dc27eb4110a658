"""A pytest plugin: only the tests that draw with OpenGL, and what became of each.

    python -m pytest -p tests.gl_witness.only_gl tests/numerical

GL_WITNESS_SHADERS=hardware makes every context one of a GPU: its variants of the
passes, kernels in storage buffers, memory that stays mapped.  GL_WITNESS_OUT names a
file for the outcomes (JSON).
"""

import json
import os
from pathlib import Path

import pytest

from tests.conftest import uses_gl
from tests.gl_witness.hardware_shaders import use_hardware_shaders

OUTCOMES = pytest.StashKey()

OWN_CONTEXTS = {"own_gpu", "caller", "fences"}
"""Fixtures with which tests make contexts of their own.  Slow ones are left out: tens
of thousands of frames on every driver."""


def pytest_configure(config):
    config.stash[OUTCOMES] = {}
    if os.environ.get("GL_WITNESS_SHADERS") == "hardware":
        use_hardware_shaders()


def draws(item) -> bool:
    """Whether a test needs the OpenGL context, or makes one of its own."""
    if uses_gl(item) or "Gpu" in item.function.__code__.co_names:
        return True
    is_long = item.get_closest_marker("slow") is not None
    return not is_long and bool(OWN_CONTEXTS & set(item.fixturenames))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    others = [item for item in items if not draws(item)]
    items[:] = [item for item in items if draws(item)]
    config.hook.pytest_deselected(items=others)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    report = (yield).get_result()
    outcomes = item.config.stash[OUTCOMES]
    known = outcomes.setdefault(item.nodeid, {"outcome": "passed", "why": ""})
    if report.outcome != "passed" and known["outcome"] == "passed":
        crash = getattr(report.longrepr, "reprcrash", None)
        why = crash.message if crash is not None else str(report.longrepr)
        known.update(outcome=report.outcome, why=why)


def pytest_sessionfinish(session):
    out = os.environ.get("GL_WITNESS_OUT")
    if out:
        outcomes = session.config.stash[OUTCOMES]
        Path(out).write_text(json.dumps(outcomes, indent=1), encoding="utf-8")
