"""Warm-up: compiles the numba loops of builds before the first one.

numba compiles loops at their first call on a machine, which takes a minute on one core,
and caches them on disk; reading them takes 0.5 s.  The worker does this while idle.
"""

from dataclasses import replace

from estimator.profiles.parse import parse_profile
from filter_service.building.from_profile import build
from filter_service.building.helper_process import HelperProcess
from filter_service.building.jobs import BuildJob
from filter_service.camera import Camera
from filter_service.psfs.store import PsfStore
from filter_service.settings import FilterSettings

SAMPLE_JOB = BuildJob(
    profile=parse_profile({"kind": "prescription", "sphere_dpt": -2.0}),
    # Blurred and sharp distances: PSFs by ray tracing and by diffraction.
    settings=FilterSettings(
        pupil_range_mm=(3.0, 5.0),
        focus_range_dpt=(2.0, 2.0),
        object_range_dpt=(0.0, 2.0),
    ),
    camera=Camera(32, 18, (-0.02, 0.02, 0.01, -0.01)),
)

HELPER = ("filter_service.filtering.compile_loops", "psfs", "frames")
"""Module and arguments of the helper process, which compiles in another order than
`build_sample`."""

HELP_AFTER_S = 1.0
"""Delay before the helper starts; reading compiled code takes less."""


def build_sample() -> None:
    """Estimate an eye and compute about 200 PSFs, with every compiled loop; 0.3 s."""
    _built(SAMPLE_JOB).fill()


def _built(job: BuildJob) -> PsfStore:
    found = build(job, progress=lambda *_: None, cancelled=lambda: False).store
    assert isinstance(found, PsfStore)
    return found


def warm_up() -> None:
    """Run `build_sample`; if it has to compile, a second process helps.

    The helper starts with the last loops; each process reads what the other compiled.
    """
    with HelperProcess(*HELPER, after_s=HELP_AFTER_S):
        build_sample()


def compile_tracing() -> None:
    """Estimate and plan one traced eye, which compiles the first half of the loops."""
    _built(SAMPLE_JOB).plan_all()


def compile_psfs() -> None:
    """Build PSFs of a given wavefront, which compiles the second half of the loops."""
    settings = replace(SAMPLE_JOB.settings, eye_model="wavefront", mode="on-axis")
    job = replace(SAMPLE_JOB, settings=settings)
    _built(job).fill()
