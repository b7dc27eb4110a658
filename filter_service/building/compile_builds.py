"""Has the loops that trace and integrate compiled before the worker's first build.

numba compiles them at their first call on a machine and keeps them on disk: most of a
minute of one core, then 0.5 s to read them.  Both are done while the worker is idle.
"""

from estimator.profiles.parse import parse_profile
from filter_service.building.from_profile import build
from filter_service.building.jobs import BuildJob
from filter_service.camera import Camera
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


def build_a_few() -> None:
    """Build some 200 PSFs, which takes every compiled loop of a build; 0.2 s."""
    for _ in build(FEW_PSFS, progress=lambda *_: None, cancelled=lambda: False):
        pass
