"""Where a network is worth having: the time it saves against the error it costs.

Judged by the bounds that the service itself judges by (`grid_source`): what saves less
than a tenth of the second in which a new eye should be seen, or costs an error that is
seen, is not worth it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.estimate.estimation import POOR_FIT_UM
from estimator.field.grid_source import LARGEST_CHEAP_UM, LEAST_GAIN_MS
from estimator.optics.units import SPHERE_PER_C20
from estimator.optics.zernike import N_TERMS
from tests.benchmarks.accuracy_rows import AccuracyRow
from tests.benchmarks.first_guess import STARTS, GuessRow
from tests.benchmarks.harness import Row
from tests.benchmarks.network_steps import FEWER_RAYS, N_OUTSIDE, StepRow

LARGEST_RADIUS_MM = 3.5
LARGEST_CHEAP_DPT = (
    SPHERE_PER_C20 * LARGEST_CHEAP_UM * math.sqrt(N_TERMS - 1) / LARGEST_RADIUS_MM**2
)
"""Defocus of the same RMS over a 7 mm pupil as `LARGEST_CHEAP_UM` in all 27 terms."""

BOUNDS = {  # error name: largest error of a network's answer
    "mean_abs_um": LARGEST_CHEAP_UM,
    "mean_abs_dpt": LARGEST_CHEAP_DPT,
}


@dataclass(frozen=True)
class Pair:
    """One case by a method and by the exact one.

    ``rival_ms`` is the time without a network where that is less than the exact one's:
    of the fewest rays whose error is within the bound, too.
    """

    time_ms: float
    exact_ms: float
    error: float
    rival_ms: float | None = None

    @property
    def saved_ms(self) -> float:
        """Time against the rival, or else the exact one."""
        return (self.rival_ms or self.exact_ms) - self.time_ms


@dataclass(frozen=True)
class Verdict:
    """One method of one step over all conditions.

    Attributes
    ----------
    time_ratio : float
        Exact over method, at the same nodes: median.
    saved_ms : float
        Against the quickest way without a network that is good enough: median.
    error, worst_error : float
        Median and largest of the conditions that it answers.
    n_answered, n_cases : int
        Conditions with at least a part of their nodes answered.
    """

    step: str
    method: str
    time_ratio: float
    saved_ms: float
    error_name: str
    error: float
    worst_error: float
    largest_error: float
    n_answered: int
    n_cases: int
    is_worth: bool
    text: str


def judge(
    step: str,
    method: str,
    pairs: Sequence[Pair],
    *,
    n_cases: int,
    error_name: str,
    largest_error: float,
) -> Verdict:
    """Judge a method by the cases that it answers."""
    if not pairs:
        nothing = (0.0, 0.0, error_name, 0.0, 0.0, largest_error, 0, n_cases, False)
        return Verdict(step, method, *nothing, "no answer: outside of its training")
    ratio = float(np.median([pair.exact_ms / pair.time_ms for pair in pairs]))
    saved_ms = float(np.median([pair.saved_ms for pair in pairs]))
    errors = [pair.error for pair in pairs]
    error, worst = float(np.median(errors)), max(errors)
    against = []
    if saved_ms < LEAST_GAIN_MS:
        against.append(f"saves less than {LEAST_GAIN_MS:g} ms")
    if error > largest_error:
        against.append(f"error above {largest_error:.2g}")
    unit = error_name.rsplit("_", 1)[-1]
    word = f"not worth it: {', '.join(against)}" if against else "worth it"
    text = (
        f"{ratio:.3g} x as fast, saves {saved_ms:.0f} ms, error {error:.2g} {unit} "
        f"(worst {worst:.2g}) in {len(pairs)} of {n_cases}: {word}"
    )
    return Verdict(
        *(step, method, ratio, saved_ms, error_name, error, worst, largest_error),
        *(len(pairs), n_cases, not against, text),
    )


def step_verdicts(rows: Sequence[StepRow]) -> list[Verdict]:
    """Every method of every step beside the exact one; focus in dioptres."""
    judged = [row for row in rows if row.error_name in (*BOUNDS, N_OUTSIDE)]
    n_cases = len({row.case for row in judged})
    methods = dict.fromkeys((row.step, row.method) for row in judged)
    found = []
    for step, method in methods:
        if method in ("exact", "search"):
            continue
        name = "mean_abs_dpt" if step == "focus" else "mean_abs_um"
        # a refined eye is to be as good as the exact one
        largest = POOR_FIT_UM if method == "network + refined" else BOUNDS[name]
        own = [row for row in judged if row.step == step]
        pairs = [
            _pair(row, own, largest)
            for row in own
            if row.method == method and row.error_name != N_OUTSIDE
        ]
        bounds = {"error_name": name, "largest_error": largest}
        found.append(judge(step, method, pairs, n_cases=n_cases, **bounds))
    return found


def _pair(row: StepRow, rows: Sequence[StepRow], largest_error: float) -> Pair:
    """Set a row beside the others of its step and case, at as many nodes."""
    others = {other.method: other for other in rows if other.case == row.case}

    def at_its_nodes_ms(method: str) -> float:
        other = others[method]
        return other.median_ms * row.n_nodes / other.n_nodes

    rival = others.get(FEWER_RAYS)
    has_rival = rival is not None and rival is not row and rival.error <= largest_error
    rival_ms = at_its_nodes_ms(FEWER_RAYS) if has_rival else None
    return Pair(row.median_ms, at_its_nodes_ms("exact"), row.error, rival_ms)


def guess_verdicts(rows: Sequence[GuessRow]) -> list[Verdict]:
    """The network's starts beside the table's; the error is the 95th percentile."""
    table = "from " + STARTS[0][0]
    (exact,) = (row for row in rows if row.setting == table)
    bounds = {"error_name": "mean_abs_um", "largest_error": POOR_FIT_UM}
    return [
        judge(
            *("first guess", row.setting),
            [Pair(row.median_ms, exact.median_ms, row.p95_error_um)],
            n_cases=1,
            **bounds,
        )
        for row in rows
        if row is not exact
    ]


def accuracy_verdicts(rows: Sequence[AccuracyRow]) -> list[Verdict]:
    """The service's settings beside the exact one."""
    exact = {row.case: row for row in rows if row.method == "accuracy exact"}
    methods = dict.fromkeys(r.method for r in rows if r.method != "accuracy exact")
    bounds = {"error_name": "mean_abs_um", "largest_error": LARGEST_CHEAP_UM}
    return [
        judge(
            *("service", method),
            [
                Pair(row.median_ms, exact[row.case].median_ms, row.error)
                for row in rows
                if row.method == method
            ],
            n_cases=len(exact),
            **bounds,
        )
        for method in methods
    ]


def verdicts(rows: Sequence[Row]) -> list[Verdict]:
    """Judge whatever of a benchmark's rows is there."""
    kinds = (
        (StepRow, step_verdicts),
        (GuessRow, guess_verdicts),
        (AccuracyRow, accuracy_verdicts),
    )
    found = []
    for kind, judged_by in kinds:
        own = [row for row in rows if isinstance(row, kind)]
        found += judged_by(own) if own else []
    return found
