"""What a start of the service loads before it says that it is ready, and after."""

import json
import subprocess
import sys

from tests.source_tree import ROOT

UP_TO_READY = """
import importlib, json, sys
from filter_service import __main__
from filter_service.service import launch
from filter_service.service.config import load_config

passes = importlib.import_module("filter_service.rendering.gl.compile_passes")
passes.compile_passes = lambda renderer: 0.0  # GL's own warm-up plans frames

def report(config, endpoint):
    print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
    raise SystemExit

launch._announce = report
launch.run(load_config(bind="tcp://127.0.0.1:*"))
"""

AFTER_READY = """
import json, sys
from filter_service.rendering.plan_once import plan_once
from numba.core.registry import CPUDispatcher

def compiled():
    loops = [f for name, module in sys.modules.items()
             if name.startswith("filter_service")
             for f in vars(module).values() if isinstance(f, CPUDispatcher)]
    return {(f.__module__, f.__name__, str(s)) for f in loops for s in f.signatures}

plan_once()
before, libraries = compiled(), {m for m in sys.modules if m.startswith("scipy.")}
assert len(before) > 8, before
assert {"scipy.interpolate", "scipy.ndimage"} <= libraries, libraries

from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.compile_passes import compile_passes
from filter_service.rendering.gl.renderer import FilterRenderer
compile_passes(FilterRenderer(Gpu()))
print(json.dumps(sorted(compiled() - before)))
"""

NOT_BEFORE_READY = {"numba", "llvmlite", "scipy", "matplotlib", "rich", "PIL"}


def _printed(script):
    ran = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_a_service_is_ready_before_it_loads_numba_or_scipy():
    loaded = set(_printed(UP_TO_READY))
    assert {"zmq", "moderngl", "numpy"} <= loaded, "it has not come to the end"
    assert not loaded & NOT_BEFORE_READY


def test_what_is_loaded_ahead_is_all_that_frames_need():
    assert _printed(AFTER_READY) == []
