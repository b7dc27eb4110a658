"""Warm-up that compiles the loops of tracing and integration before the first build.

numba compiles them at their first call on a machine and caches them on disk: a minute
of one core, then 0.5 s to read them.  Both happen while the worker is idle.
"""

from dataclasses import replace

from estimator.profiles.parse import parse_profile
from filter_service.building.from_profile import build
from filter_service.building.helper_process import HelperProcess
from filter_service.building.jobs import BuildJob
from filter_service.camera import Camera
from filter_service.psfs.store import PsfStore
from filter_service.settings import FilterSettings

FEW_PSFS = BuildJob(
    profile=parse_profile({"kind": "prescription", "sphere_dpt": -2.0}),
    # blurred and sharp distances: PSFs by rays and by waves
    settings=FilterSettings(
        pupil_range_mm=(3.0, 5.0),
        focus_range_dpt=(2.0, 2.0),
        object_range_dpt=(0.0, 2.0),
    ),
    camera=Camera(32, 18, (-0.02, 0.02, 0.01, -0.01)),
)

HELPER = ("filter_service.filtering.compile_loops", "psfs", "frames")
"""Module and arguments of the process that helps compiling, in another order than
`build_a_few`."""

HELP_AFTER_S = 1.0
"""Delay before the helper starts; reading compiled code takes less."""


def build_a_few() -> None:
    """Estimate an eye and compute some 200 PSFs, with every compiled loop; 0.2 s."""
    _built(FEW_PSFS).fill()


def _built(job: BuildJob) -> PsfStore:
    found = build(job, progress=lambda *_: None, cancelled=lambda: False).store
    assert isinstance(found, PsfStore)
    return found


def build_a_few_with_help() -> None:
    """Run `build_a_few`; if it has to compile, a second process helps from the end.

    The two processes meet, as each reads what the other has compiled.
    """
    with HelperProcess(*HELPER, after_s=HELP_AFTER_S):
        build_a_few()


def trace_an_eye() -> None:
    """Estimate, trace and plan for one eye: compiles the first half of the loops."""
    _built(FEW_PSFS).plan_all()


def build_without_tracing() -> None:
    """Build PSFs of a given wavefront: compiles the second half of the loops."""
    settings = replace(FEW_PSFS.settings, eye_model="wavefront", mode="on-axis")
    job = replace(FEW_PSFS, settings=settings)
    _built(job).fill()
