"""Has the loops that trace and integrate compiled before the worker's first build.

numba compiles them at their first call on a machine and keeps them on disk: most of a
minute of one core, then 0.5 s to read them.  Both are done while the worker is idle.
"""

from filter_service.messages import Camera, ProfileSettings
from filter_service.service.build_job import BuildJob
from filter_service.service.profile_build import build

FEW_PSFS = BuildJob(
    body={"kind": "prescription", "sphere_dpt": -2.0},
    # blurred and sharp distances: PSFs by rays and by waves
    settings=ProfileSettings(
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
