"""Eyes, foci and aberrations: networks and exact methods, with ray tracing.

Rows of the paper's tables 4 and 5, by condition.  ``step`` is ``eye`` (the estimated
eye), ``focus`` (42 states), ``on-axis`` (126 wavefronts) or ``off-axis`` (627).  Every
step starts from the same exact answer of the step before it (the refined eye, its
traced focus), so a row's error is that of its own step.  Times are those of a whole
step, not of a node.  The references are one rung above what is compared: the traced eye
itself, bracketed roots of its refraction, and four times the rays.  ``fewer rays`` are
those with which the service traces the field.  Where a network was not trained for some
nodes of an eye, its row is of the others; for none of them it holds how many there are
instead of an error.

``random eyes`` (the paper's Table 2) and wavefronts of the ``population`` are refined
from the table's eye, from the network's guess, and from the nearer of both, in turn:
median, 95th percentile and largest error of the 25 terms without piston and tilt.
``failed``: refinements with a mean error above `estimation.POOR_FIT_UM`, or no answer.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.bounded_fit import FitFailed
from estimator.estimate.estimation import POOR_FIT_UM, EstimatedEye, estimate_eye
from estimator.field.interpolation import FIELD_AZIMUTHS, FIELD_RINGS, OPEN_RATIO
from estimator.networks.inference import DamagedWeights, WeightsMissing, load_network
from estimator.profiles.parse import EyeProfile, parse_profile
from estimator.wavefront.nodes import N_AZIMUTHS, N_RINGS
from tests.benchmarks import network_nodes
from tests.benchmarks.harness import Row, Run, memory_mb, time_calls
from tests.benchmarks.published_figures import CONDITIONS
from tests.numerical.eye_cases import population_profiles, random_eye_profiles

MINUTES = 4
REPEATS, QUICK_REPEATS = 10, 3
SEARCH_S, QUICK_SEARCH_S = 8.0, 1.0
N_EYES, N_QUICK_EYES = {"random eyes": 500, "population": 100}, 20
QUICK_CONDITIONS = ("emmetropia", "keratoconus")
SEED = 132
STARTS = (("table",), ("network",), ("table", "network"))
ASKED = ("eye", "focus", "aberration")
"""Networks that are measured; the discriminator only serves the training."""

EXACT_WAY = {"method": "refined", "starts": ("table",)}
EYE_WAYS = {
    "network": {"method": "network", "starts": ("table",)},
    "network + refined": {"method": "refined", "starts": ("network",)},
    "exact": EXACT_WAY,
}
EYE_REFERENCE, FOCUS_REFERENCE = "exact ray trace, 25 terms", "bracketed roots"
REFERENCE_RAYS = {"n_rings": 2 * N_RINGS, "n_azimuths": 2 * N_AZIMUTHS}
RAYS = {
    "exact": {"n_rings": N_RINGS, "n_azimuths": N_AZIMUTHS},
    "fewer rays": {"n_rings": FIELD_RINGS, "n_azimuths": FIELD_AZIMUTHS},
}
N_OUTSIDE = "n_outside"
"""Name of the error of a row without one: nodes a network was not trained for."""


@dataclass(frozen=True)
class StepRow(Row):
    """A row of one step, method and condition.

    Attributes
    ----------
    step : str
    n_nodes : int
        Answers that the time and the error are of; ``n`` counts repeats.
    n_outside : int
        Further nodes of the step that the network was not trained for.
    target : float
        Mean absolute value that was to be found, in the error's unit: of the 27 terms,
        or of the two changes of lens and chamber; of the focus distance in dpt.
    """

    step: str
    n_nodes: int
    n_outside: int
    target: float


@dataclass(frozen=True)
class Answer:
    """What a method says of the nodes ``inside`` its domain, and how fast."""

    method: str
    setting: str
    inside: NDArray[np.bool_]
    n: int = 0
    times_ms: tuple[float, float] = (0.0, 0.0)
    values: NDArray[np.float64] | None = None

    def row(self, step: str, case: str, name, error, target, reference) -> StepRow:
        """Return the row of an error."""
        n_outside = int((~self.inside).sum())
        if not self.inside.any():
            name, error = N_OUTSIDE, n_outside
        return StepRow(
            *("networks", self.method, case, self.setting, self.n, *self.times_ms),
            *(memory_mb(), name, float(error), reference),
            *(step, int(self.inside.sum()), n_outside, float(target)),
        )


def answer(
    method: str,
    setting: str,
    nodes: NDArray[np.float64],
    evaluate: Callable[[NDArray], NDArray],
    *,
    repeats: int,
    inside: NDArray[np.bool_] | None = None,
) -> Answer:
    """Evaluate the nodes ``inside`` (n,), by default all."""
    inside = np.ones(len(nodes), bool) if inside is None else inside
    chosen = nodes[inside]
    if not inside.any():
        return Answer(method, setting, inside)
    times_ms = time_calls(lambda: evaluate(chosen), repeats=repeats)
    return Answer(method, setting, inside, repeats, times_ms, evaluate(chosen))


def network_answer(step, nodes, evaluate, *, repeats: int, usable=True) -> Answer:
    """Answer by network what it was trained for, of the ``usable`` nodes (n,)."""
    inside, reason = network_nodes.in_domain(step, nodes)
    if not np.all(usable):
        reason = reason or "light passes only a part of the pupil"
    inside &= usable
    setting = "all inside" if inside.all() else f"outside: {reason}"
    return answer("network", setting, nodes, evaluate, repeats=repeats, inside=inside)


def eye_rows(case: str, profile: EyeProfile, repeats: int, search_s: float):
    """Yield the eye of one condition by every method."""
    target_um = np.mean(np.abs(profile.zernike_um[1:]))
    for method, way in EYE_WAYS.items():
        found = estimate_eye(profile, **way)
        setting, inside = f"{found.n_evaluations} traced", np.array([True])
        if method.startswith("network") and found.network_reason:
            setting, inside = f"outside: {found.network_reason}", ~inside
            times_ms, n = (0.0, 0.0), 0
        else:
            times_ms = time_calls(
                lambda way=way: estimate_eye(profile, **way), repeats=repeats
            )
            n = repeats
        yield Answer(method, setting, inside, n, times_ms).row(
            *("eye", case, "mean_abs_um", found.mean_abs_error_um),
            *(target_um, EYE_REFERENCE),
        )
    found = estimate_eye(profile, method="search", max_time_s=search_s)
    setting = f"stopped at {search_s:g} s, {found.n_evaluations} traced"
    yield Answer("search", setting, np.array([True]), 1, (found.time_ms,) * 2).row(
        *("eye", case, "mean_abs_um", found.mean_abs_error_um),
        *(target_um, EYE_REFERENCE),
    )


def _mean_abs(values: NDArray[np.float64]) -> float:
    return float(np.nanmean(np.abs(values)))


def focus_rows(case, vector, *, repeats: int, with_search: bool = True):
    """Yield rows of a relaxed eye (45,) at 42 nodes: by method, in mm and in dpt."""
    nodes = network_nodes.focus_nodes(vector)
    exact_mm = network_nodes.reference_focus(nodes)
    exact_dpt = network_nodes.reached_dpt(nodes, exact_mm)
    answers = [
        network_answer("focus", nodes, network_nodes.network_focus, repeats=repeats),
        answer("exact", "secant", nodes, network_nodes.traced_focus, repeats=repeats),
    ]
    if with_search:
        spot = ("search", "smallest spot", nodes, network_nodes.spot_focus)
        answers.append(answer(*spot, repeats=1))
    for found in answers:
        off_mm = off_dpt = np.zeros(1)
        if found.values is not None:
            off_mm = found.values - exact_mm[found.inside]
            off_dpt = network_nodes.reached_dpt(nodes[found.inside], found.values)
            off_dpt = off_dpt - exact_dpt[found.inside]
        for unit, off, exact in (
            ("mm", off_mm, exact_mm),
            ("dpt", off_dpt, nodes[:, -1]),
        )[: 2 if found.inside.any() else 1]:
            errors = (f"mean_abs_{unit}", _mean_abs(off), _mean_abs(exact))
            yield found.row("focus", case, *errors, FOCUS_REFERENCE)


def aberration_rows(step: str, case: str, vector, *, repeats: int):
    """Yield rows of the aberrations of an eye (45,) on or off the axis, by method."""
    nodes = network_nodes.NODES[step](vector)
    dense = network_nodes.traced_aberrations(nodes, **REFERENCE_RAYS)
    passes = dense.open_ratio > OPEN_RATIO
    exact_um = np.where(passes[:, None], dense.zernike_um[:, 1:], np.nan)
    answers = [
        network_answer(
            *(step, nodes),
            lambda rows: network_nodes.network_aberrations(rows).zernike_um[:, 1:],
            repeats=repeats,
            usable=np.isfinite(exact_um).all(axis=-1),
        )
    ]
    for method, rays in RAYS.items():
        setting = f"{np.prod(list(rays.values()))} rays"
        answers.append(
            answer(
                *(method, setting, nodes),
                lambda rows, rays=rays: network_nodes.traced_aberrations(
                    rows, **rays
                ).zernike_um[:, 1:],
                repeats=repeats,
            )
        )
    for found in answers:
        error_um = 0.0
        if found.values is not None:
            error_um = _mean_abs(found.values - exact_um[found.inside])
        yield found.row(
            *(step, case, "mean_abs_um", error_um, _mean_abs(exact_um)),
            f"traced, {np.prod(list(REFERENCE_RAYS.values()))} rays",
        )


def condition_rows(case: str, *, repeats: int, search_s: float):
    """Yield all four steps of one condition."""
    profile = parse_profile({"kind": "preset", "name": case})
    vector = estimate_eye(profile, **EXACT_WAY).parameters.to_vector()
    yield from eye_rows(case, profile, repeats, search_s)
    yield from focus_rows(case, vector, repeats=repeats)
    for step in ("on-axis", "off-axis"):
        yield from aberration_rows(step, case, vector, repeats=repeats)


def many_rows(case: str, count: int):
    """Yield rows of refinements of random eyes, or of wavefronts of the population."""
    rng = np.random.default_rng(SEED)
    if case == "random eyes":
        profiles = [profile for profile, _ in random_eye_profiles(count, rng)]
    else:
        profiles = population_profiles(count, rng)
    found: dict[tuple[str, ...], list[EstimatedEye | None]] = {s: [] for s in STARTS}
    for starts in STARTS:  # compiled and loaded before the clock
        _refined(profiles[0], starts)
    for profile in profiles:
        for starts in STARTS:
            found[starts].append(_refined(profile, starts))
    for starts, eyes in found.items():
        yield from refined_rows(case, starts, eyes)


def _refined(profile: EyeProfile, starts: tuple[str, ...]) -> EstimatedEye | None:
    try:
        return estimate_eye(profile, starts=starts)
    except FitFailed:
        return None


def refined_rows(case: str, starts, eyes: list[EstimatedEye | None]) -> list[Row]:
    """Return the errors of refinements; None is one without an answer."""
    answered = [eye for eye in eyes if eye is not None]
    errors_um = np.array([eye.mean_abs_error_um for eye in answered])
    times_ms = np.percentile([eye.time_ms for eye in answered], (50, 95)).tolist()
    n_failed = int(np.sum(errors_um > POOR_FIT_UM)) + len(eyes) - len(answered)
    setting = "from " + " or ".join(starts)
    return [
        Row(
            *("networks", "refined", case, setting, len(eyes), *times_ms, memory_mb()),
            *(name, float(value), EYE_REFERENCE),
        )
        for name, value in (
            ("median_um", np.median(errors_um)),
            ("p95_um", np.percentile(errors_um, 95)),
            ("largest_um", errors_um.max()),
            ("failed", n_failed),
        )
    ]


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return rows, and which networks were measured."""
    try:
        cards = {name: load_network(name).card for name in ASKED}
    except (WeightsMissing, DamagedWeights) as error:
        sys.exit(f"bench networks: {error}")
    rows: list[Row] = []
    for case in QUICK_CONDITIONS if run.is_quick else CONDITIONS:
        rows += condition_rows(
            case,
            repeats=QUICK_REPEATS if run.is_quick else REPEATS,
            search_s=QUICK_SEARCH_S if run.is_quick else SEARCH_S,
        )
    for case, count in N_EYES.items():
        rows += many_rows(case, N_QUICK_EYES if run.is_quick else count)
    networks = [
        {
            "name": name,
            "n_parameters": card.n_parameters,
            "precision": card.precision,
            "commit": card.commit,
            "expected_error": f"{card.error}",
        }
        for name, card in cards.items()
    ]
    return rows, {"networks": networks}
