"""What a start of the service loads before it says that it is ready, and after."""

import json
import subprocess
import sys

import pytest

from tests.source_tree import ROOT

UP_TO_READY = """
import json, sys
from filter_service.service import render_worker_process, supervisor
from filter_service.service.config import load_config
from filter_service.service.process_channel import Link

near, end = Link.pair()
near.send(("config", load_config(bind="tcp://127.0.0.1:*", engine="native")))
sys.argv[1:] = [str(end.detach()), supervisor.OPEN_BUILDER, supervisor.RENDER]
send = Link.send

def report(link, message, descriptors=()):
    if message[0] != "ready":
        return send(link, message, descriptors)
    print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
    raise SystemExit

Link.send = report
render_worker_process.main()
"""

LIGHT = """
import json, sys
import filter_service.{module}
print(json.dumps(sorted({{name.partition(".")[0] for name in sys.modules}})))
"""

STOPPED_DURING_THE_START = """
import sys
from filter_service.service import {module}
from filter_service.service.config import load_config
from filter_service.service.process_channel import Link

near, end = Link.pair()
near.send(("config", load_config(bind="tcp://127.0.0.1:*", engine="native")))
near.send(("stop",))
double = "tests.end_to_end.double_service:open_builder"
sys.argv[1:] = [str(end.detach()), double, "render"]
{module}.main()
print("true")
"""

NOT_BEFORE_READY = {"scipy", "matplotlib", "rich", "PIL"}
"""By the native engine; that of GL plans frames when it compiles its shaders."""


def _printed(script, *, timeout_s=120):
    ran = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_a_service_is_ready_before_it_loads_scipy():
    loaded = set(_printed(UP_TO_READY))
    assert {"msgspec", "numpy"} <= loaded, "it has not come to the end"
    assert not loaded & (NOT_BEFORE_READY | {"zmq"})


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("service.front_end", NOT_BEFORE_READY | {"moderngl", "OpenGL"}),
        ("service.supervisor", NOT_BEFORE_READY | {"moderngl", "OpenGL", "zmq"}),
        ("building.from_profile", NOT_BEFORE_READY | {"zmq"}),
    ],
)
def test_what_stands_before_the_frames_is_light(module, heavy):
    assert not set(_printed(LIGHT.format(module=module))) & heavy


@pytest.mark.parametrize("module", ["front_end", "render_worker_process"])
def test_a_process_that_is_stopped_during_its_start_ends(module, monkeypatch):
    monkeypatch.setenv("OCUFILTER_TEST_FILTER_MS", "0")
    assert _printed(STOPPED_DURING_THE_START.format(module=module), timeout_s=20)
