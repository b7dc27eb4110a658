"""Where a refinement starts: a table's eye, the network's guess, or the nearer of both.

Random eyes of the paper's Table 2, each refined from every kind of start in turn, so
that what else the machine does falls on all alike.
"""

from dataclasses import dataclass

import numpy as np

from estimator.estimate.bounded_fit import FitFailed
from estimator.estimate.estimation import POOR_FIT_UM, EstimatedEye, estimate_eye
from tests.benchmarks import eye_ways
from tests.benchmarks.harness import Row, memory_mb
from tests.numerical.eye_cases import random_eye_profiles

STARTS = (("table",), ("network",), ("table", "network"))
SEED = 132


@dataclass(frozen=True)
class GuessRow(Row):
    """Refinements from one kind of start; ``error`` is the median one.

    Attributes
    ----------
    p95_error_um : float
    median_iterations, p95_iterations : float
    median_traced : float
        Eyes traced for one refinement, start and Jacobians included.
    n_failed : int
        Mean error above `estimation.POOR_FIT_UM`, or no answer at all.
    n_from_network : int
        Refinements that started at the network's guess.
    n_outside : int
        Eyes whose wavefront the network was not trained for.
    """

    p95_error_um: float
    median_iterations: float
    p95_iterations: float
    median_traced: float
    n_failed: int
    n_from_network: int
    n_outside: int


def guess_rows(count: int) -> list[GuessRow]:
    """One row for each kind of start."""
    profiles = [p for p, _ in random_eye_profiles(count, np.random.default_rng(SEED))]
    found: dict[tuple[str, ...], list[EstimatedEye | None]] = {s: [] for s in STARTS}
    for starts in STARTS:  # compiled and loaded before the clock
        _refined(profiles[0], starts)
    for profile in profiles:
        for starts in STARTS:
            found[starts].append(_refined(profile, starts))
    return [guess_row(starts, eyes) for starts, eyes in found.items()]


def _refined(profile, starts) -> EstimatedEye | None:
    try:
        return estimate_eye(profile, starts=starts)
    except FitFailed:
        return None


def guess_row(starts: tuple[str, ...], eyes: list[EstimatedEye | None]) -> GuessRow:
    """Summarise refinements; None is one without an answer."""
    answered = [eye for eye in eyes if eye is not None]

    def values(name: str):
        return np.array([getattr(eye, name) for eye in answered], dtype=np.float64)

    errors_um, times_ms = values("mean_abs_error_um"), values("time_ms")
    iterations = values("n_iterations")
    n_poor = int(np.sum(errors_um > POOR_FIT_UM))
    return GuessRow(
        *("networks", "refined", "random eyes", "from " + " or ".join(starts)),
        *(len(eyes), float(np.median(times_ms)), float(np.percentile(times_ms, 95))),
        *(memory_mb(), eye_ways.ERROR_NAME, float(np.median(errors_um))),
        eye_ways.REFERENCE,
        p95_error_um=float(np.percentile(errors_um, 95)),
        median_iterations=float(np.median(iterations)),
        p95_iterations=float(np.percentile(iterations, 95)),
        median_traced=float(np.median(values("n_evaluations"))),
        n_failed=n_poor + len(eyes) - len(answered),
        n_from_network=sum(eye.start == "network" for eye in answered),
        n_outside=sum(bool(eye.network_reason) for eye in answered),
    )
