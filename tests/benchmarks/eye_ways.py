"""Ways to estimate an eye, timed: what the benchmarks of estimation and networks share.

A found eye carries its own error: it is traced, and compared with the measurement over
the 25 terms without piston and tilt.
"""

from dataclasses import dataclass

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.profiles.parse import EyeProfile, parse_profile
from tests.benchmarks.harness import time_calls

REFERENCE = "exact ray trace, 25 terms"
ERROR_NAME = "mean_abs_um"


@dataclass(frozen=True)
class TimedEye:
    """An eye, and how long finding it took: median and 95th percentile, ms."""

    found: EstimatedEye
    times_ms: tuple[float, float]
    n: int


def preset_profile(name: str) -> EyeProfile:
    """One of the six conditions."""
    return parse_profile({"kind": "preset", "name": name})


def timed_eye(profile: EyeProfile, *, repeats: int, **way) -> TimedEye:
    """Estimate repeatedly; ``way`` is as `estimation.estimate_eye` takes it."""
    found = estimate_eye(profile, **way)
    times_ms = time_calls(lambda: estimate_eye(profile, **way), repeats=repeats)
    return TimedEye(found, times_ms, repeats)


def timed_search(profile: EyeProfile, *, max_time_s: float) -> TimedEye:
    """Estimate once by the earlier work's pattern search, cut short."""
    found = estimate_eye(profile, method="search", max_time_s=max_time_s)
    return TimedEye(found, (found.time_ms, found.time_ms), 1)
