"""What is compiled ahead, in two halves, is all that builds of profiles need."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.tools

SCRIPT = """
import sys
from dataclasses import replace
import numpy as np
from numba.core.registry import CPUDispatcher
from estimator.profiles.parse import parse_profile
from filter_service.messages import Camera, FilterSettings
from filter_service.building.from_profile import build
from filter_service.building.compile_builds import SAMPLE_JOB, build_sample
from filter_service.filtering.compile_loops import compile_part

def compiled():
    modules = [m for name, m in sys.modules.items()
               if name.startswith(("estimator", "filter_service"))]
    found = {id(f): f for m in modules for f in vars(m).values()
             if isinstance(f, CPUDispatcher)}
    return {(f.__module__, f.__name__, str(s)) for f in found.values()
            for s in f.signatures}

compile_part("tracing")
compile_part("psfs")
before = compiled()
assert len(before) > 8, before
build_sample()
camera = Camera(160, 90, (-0.5, 0.5, 0.28, -0.28))
for sphere_dpt in (0.0, -6.0):
    body = {"kind": "prescription", "sphere_dpt": sphere_dpt, "cylinder_dpt": -1.0,
            "axis_deg": 30.0}
    for settings in (dict(), dict(mode="on-axis", eye_model="wavefront"),
                     dict(mode="quality", lateral_color=True), dict(diffraction=False),
                     dict(chromatic=False),
                     dict(stiles_crawford=True),
                     dict(gaze_range_deg=(5.0, 5.0))):
        settings = FilterSettings(**dict(tolerance="loose") | settings)
        job = replace(SAMPLE_JOB, profile=parse_profile(body), settings=settings,
                      camera=camera)
        found = build(job, progress=lambda *_: None, cancelled=lambda: False)
        found.store.plan_all()
        found.store.fill(np.arange(0, found.store.psf_count, 40))
for missed in sorted(compiled() - before):
    print(*missed)
"""


def test_builds_after_either_warm_up_compile_nothing():
    ran = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == ""
