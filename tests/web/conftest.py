"""A real browser and a real page: Debian's Chromium, and the program."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from playwright.sync_api import sync_playwright

from clients.openxr_layer.wire import SOCKET_VARIABLE
from tests.source_tree import ROOT
from tests.web.browser import BROWSERS, PageUnderTest, open_browser


@pytest.fixture(scope="session")
def layer_socket(tmp_path_factory):
    """Return the path at which the page looks for the helper of a layer."""
    return tmp_path_factory.mktemp("layer") / "layer.sock"


@pytest.fixture(scope="session")
def address(layer_socket):
    """Start `ocufilter web`; return the address that it prints."""
    command = [sys.executable, "-m", "ocufilter", "web"]
    command += ["--no-browser", "--port", "0", "--json"]
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=os.environ | {SOCKET_VARIABLE: str(layer_socket)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        yield json.loads(program.stdout.readline())["address"]
        program.terminate()
        _, said = program.communicate(timeout=20)
    assert "Traceback" not in said, said


@pytest.fixture(scope="session")
def browser():
    """Start the browser, without a window."""
    if not any(map(shutil.which, BROWSERS)):
        pytest.fail("no Chromium here; sh setup.sh web installs it")
    with sync_playwright() as playwright, open_browser(playwright) as browser:
        yield browser


@pytest.fixture
def page(browser, address):
    """Open the page, in a profile of its own; nothing may go wrong in it."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    under_test = PageUnderTest(context.new_page())
    under_test.open(address)
    yield under_test
    assert under_test.errors == []
    context.close()
