"""Rows of the paper's tables 4 and 5: every step of an eye, by network and exactly.

Every step starts from the same exact answer of the step before it (the refined eye, its
traced focus), so a row's error is that of its own step.  Times are those of a whole
step, not of a node.  Errors are against a rung above everything compared: the traced
eye itself, bracketed roots of its refraction, and four times the rays.

Where a network was not trained for some nodes of an eye, its row is of the others; for
none of them it holds how many there are instead of an error.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.estimation import estimate_eye
from estimator.field.interpolation import FIELD_AZIMUTHS, FIELD_RINGS, OPEN_RATIO
from estimator.wavefront.nodes import N_AZIMUTHS, N_RINGS
from tests.benchmarks import eye_ways, network_nodes
from tests.benchmarks.harness import Row, memory_mb, time_calls
from tests.benchmarks.published_networks import published_step

N_OUTSIDE = "n_outside"
"""Name of the error of a row without one: nodes a network was not trained for."""

OWN_EYE = "network, its eye"
"""The networks one after the other, as the paper has them: of the eye network's eye,
which lies within the ranges of Table 2 where an exact one need not."""

FEWER_RAYS = "fewer rays"
"""Traced as the service traces the field: a third of the rays of the exact method."""

REFERENCE_RINGS, REFERENCE_AZIMUTHS = 2 * N_RINGS, 2 * N_AZIMUTHS

EXACT_WAY = {"method": "refined", "starts": ("table",)}
EYE_WAYS = {
    "network": {"method": "network", "starts": ("table",)},
    "network + refined": {"method": "refined", "starts": ("network",)},
    "exact": EXACT_WAY,
}


@dataclass(frozen=True)
class StepRow(Row):
    """A row of one step, method and condition.

    Attributes
    ----------
    step : str
        One of `published_networks.STEPS`.
    n_nodes : int
        Answers that the time and the error are of; ``n`` counts repeats.
    n_outside : int
        Further nodes of the step that the network was not trained for.
    target : float
        Mean absolute value that was to be found, in the error's unit: of the 27 terms,
        or of the two changes of lens and chamber; of the focus distance in dpt.
    published : dict or None
        The paper's figures, with their hardware.
    """

    step: str
    n_nodes: int
    n_outside: int
    target: float
    published: dict | None


@dataclass(frozen=True)
class Answer:
    """One method's answer to a step: what it is compared by, and what it took."""

    method: str
    setting: str
    times_ms: tuple[float, float]
    n: int
    inside: NDArray[np.bool_]
    values: NDArray[np.float64] | None


def step_row(
    step: str, case: str, method: str, setting: str, *, times_ms, n: int, **more
) -> StepRow:
    """Make a row; ``more`` are its other fields."""
    theirs = published_step(step, case, method)
    return StepRow(
        *("networks", method, case, setting, n, *times_ms, memory_mb()),
        step=step,
        published=asdict(theirs) if theirs else None,
        **more,
    )


def eye_rows(case: str, *, repeats: int, search_s: float) -> list[StepRow]:
    """The eye of one condition by every method."""
    profile = eye_ways.preset_profile(case)
    target_um = float(np.mean(np.abs(profile.zernike_um[1:])))
    common = {"target": target_um, "reference": eye_ways.REFERENCE}
    rows = []
    for method, way in EYE_WAYS.items():
        timed = eye_ways.timed_eye(profile, repeats=repeats, **way)
        rows.append(_eye_row(case, method, timed, common))
    timed = eye_ways.timed_search(profile, max_time_s=search_s)
    setting = f"stopped at {search_s:g} s, {timed.found.n_evaluations} traced"
    rows.append(_eye_row(case, "search", timed, common, setting=setting))
    return rows


def _eye_row(case, method, timed, common, *, setting: str = "") -> StepRow:
    found = timed.found
    fell_back = method.startswith("network") and bool(found.network_reason)
    error = (eye_ways.ERROR_NAME, found.mean_abs_error_um)
    if fell_back:
        setting, error = f"outside: {found.network_reason}", (N_OUTSIDE, 1.0)
        timed = replace(timed, times_ms=(0.0, 0.0), n=0)
    return step_row(
        *("eye", case, method, setting or f"{found.n_evaluations} traced"),
        times_ms=timed.times_ms,
        n=timed.n,
        error_name=error[0],
        error=error[1],
        n_nodes=0 if fell_back else 1,
        n_outside=int(fell_back),
        **common,
    )


def network_answer(
    step: str,
    method: str,
    nodes: NDArray[np.float64],
    evaluate: Callable[[NDArray], NDArray],
    usable: NDArray[np.bool_],
    *,
    repeats: int,
) -> Answer:
    """Answer by network what it was trained for, of the ``usable`` nodes (n,)."""
    inside, reason = network_nodes.in_domain(step, nodes)
    if not usable.all():
        reason = reason or "light passes only a part of the pupil"
    inside &= usable
    chosen = nodes[inside]
    if not inside.any():
        return Answer(method, f"outside: {reason}", (0.0, 0.0), 0, inside, None)
    values = evaluate(chosen)
    times_ms = time_calls(lambda: evaluate(chosen), repeats=repeats)
    setting = "all inside" if inside.all() else f"some outside: {reason}"
    return Answer(method, setting, times_ms, repeats, inside, values)


def traced_answer(
    method: str,
    setting: str,
    nodes: NDArray[np.float64],
    evaluate: Callable[[NDArray], NDArray],
    *,
    repeats: int,
) -> Answer:
    """Answer all nodes without a network."""
    if repeats == 1:  # what takes seconds is run once more, for the compiler
        evaluate(nodes[:1])
        start_s = time.perf_counter()
        values = evaluate(nodes)
        times_ms = (1e3 * (time.perf_counter() - start_s),) * 2
    else:
        values = evaluate(nodes)
        times_ms = time_calls(lambda: evaluate(nodes), repeats=repeats)
    return Answer(method, setting, times_ms, repeats, np.ones(len(nodes), bool), values)


def _answer_row(step, case, answer: Answer, *, error_name, error, **more) -> StepRow:
    """Make the row of an answer; without any it holds the number of nodes instead."""
    n_nodes, n_outside = int(answer.inside.sum()), int((~answer.inside).sum())
    if n_nodes == 0:
        error_name, error = N_OUTSIDE, float(n_outside)
    return step_row(
        *(step, case, answer.method, answer.setting),
        times_ms=answer.times_ms,
        n=answer.n,
        error_name=error_name,
        error=error,
        n_nodes=n_nodes,
        n_outside=n_outside,
        **more,
    )


def focus_rows(
    case: str,
    vector: NDArray[np.float64],
    *,
    repeats: int,
    own_eye: NDArray[np.float64] | None = None,
    with_search: bool = True,
) -> list[StepRow]:
    """Focus a relaxed eye (45,) at 42 nodes; each method in mm and in dioptres.

    ``own_eye`` (45,) is the eye network's, ``with_search`` the smallest spot.
    """
    nodes = network_nodes.focus_nodes(vector)
    answers = [
        _network_focus("network", nodes, repeats),
        traced_answer(
            *("exact", "secant", nodes, network_nodes.traced_focus), repeats=repeats
        ),
    ]
    if with_search:
        spot = ("search", "smallest spot", nodes, network_nodes.spot_focus)
        answers.append(traced_answer(*spot, repeats=1))
    rows = _focus_rows(case, nodes, answers)
    if own_eye is not None:
        nodes = network_nodes.focus_nodes(own_eye)
        rows += _focus_rows(case, nodes, [_network_focus(OWN_EYE, nodes, repeats)])
    return rows


def _network_focus(method: str, nodes: NDArray[np.float64], repeats: int) -> Answer:
    usable = np.ones(len(nodes), dtype=bool)
    evaluate = network_nodes.network_focus
    return network_answer("focus", method, nodes, evaluate, usable, repeats=repeats)


def _focus_rows(
    case: str, nodes: NDArray[np.float64], answers: list[Answer]
) -> list[StepRow]:
    """Make the rows of answers for nodes of one eye."""
    exact_mm = network_nodes.reference_focus(nodes)
    exact_dpt = network_nodes.reached_dpt(nodes, exact_mm)
    rows = []
    for answer in answers:
        errors = {N_OUTSIDE: (0.0, _mean_abs(exact_mm))}
        if answer.inside.any():
            off_mm = answer.values - exact_mm[answer.inside]
            found_dpt = network_nodes.reached_dpt(nodes[answer.inside], answer.values)
            off_dpt = found_dpt - exact_dpt[answer.inside]
            errors = {
                "mean_abs_mm": (_mean_abs(off_mm), _mean_abs(exact_mm)),
                "mean_abs_dpt": (_mean_abs(off_dpt), _mean_abs(nodes[:, -1])),
            }
        rows += [
            _answer_row(
                *("focus", case, answer),
                error_name=name,
                error=error,
                target=target,
                reference="bracketed roots of the traced refraction",
            )
            for name, (error, target) in errors.items()
        ]
    return rows


def _mean_abs(values: NDArray[np.float64]) -> float:
    """Mean over what is not nan."""
    return float(np.nanmean(np.abs(values)))


def aberration_rows(
    step: str,
    case: str,
    vector: NDArray[np.float64],
    *,
    repeats: int,
    own_eye: NDArray[np.float64] | None = None,
) -> list[StepRow]:
    """Aberrations of an eye (45,) on or off the axis by every method."""
    nodes = network_nodes.NODES[step](vector)
    exact_um = _exact_um(nodes)
    answers = [
        _network_wavefronts(step, "network", nodes, exact_um, repeats),
        _traced("exact", nodes, N_RINGS, N_AZIMUTHS, repeats),
        _traced(FEWER_RAYS, nodes, FIELD_RINGS, FIELD_AZIMUTHS, repeats),
    ]
    rows = _aberration_rows(step, case, exact_um, answers)
    if own_eye is not None:
        nodes = network_nodes.NODES[step](own_eye)
        exact_um = _exact_um(nodes)
        answer = _network_wavefronts(step, OWN_EYE, nodes, exact_um, repeats)
        rows += _aberration_rows(step, case, exact_um, [answer])
    return rows


def _exact_um(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients (n, 27) of the reference; nan where light passes not all."""
    dense = network_nodes.traced_aberrations(
        nodes, n_rings=REFERENCE_RINGS, n_azimuths=REFERENCE_AZIMUTHS
    )
    passes = dense.open_ratio > OPEN_RATIO
    return np.where(passes[:, None], dense.zernike_um[:, 1:], np.nan)


def _network_wavefronts(step, method, nodes, exact_um, repeats: int) -> Answer:
    usable = np.isfinite(exact_um).all(axis=-1)
    return network_answer(step, method, nodes, _network_um, usable, repeats=repeats)


def _aberration_rows(
    step: str, case: str, exact_um: NDArray[np.float64], answers: list[Answer]
) -> list[StepRow]:
    """Make the rows of answers for nodes whose coefficients are known."""
    rows = []
    for answer in answers:
        error_um = 0.0
        if answer.inside.any():
            error_um = _mean_abs(answer.values - exact_um[answer.inside])
        rows.append(
            _answer_row(
                *(step, case, answer),
                error_name="mean_abs_um",
                error=error_um,
                target=_mean_abs(exact_um),
                reference=f"traced, {REFERENCE_RINGS * REFERENCE_AZIMUTHS} rays",
            )
        )
    return rows


def _network_um(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    return network_nodes.network_aberrations(nodes).zernike_um[:, 1:]


def _traced(method, nodes, n_rings: int, n_azimuths: int, repeats: int) -> Answer:
    rays = {"n_rings": n_rings, "n_azimuths": n_azimuths}

    def evaluate(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        return network_nodes.traced_aberrations(rows, **rays).zernike_um[:, 1:]

    setting = f"{n_rings * n_azimuths} rays"
    return traced_answer(method, setting, nodes, evaluate, repeats=repeats)


def condition_rows(case: str, *, repeats: int, search_s: float) -> list[StepRow]:
    """All four steps of one condition."""
    profile = eye_ways.preset_profile(case)
    vector = estimate_eye(profile, **EXACT_WAY).parameters.to_vector()
    found = estimate_eye(profile, **EYE_WAYS["network"])
    by_network = found.method == "network"
    own_eye = found.parameters.to_vector() if by_network else None
    common = {"repeats": repeats, "own_eye": own_eye}
    return [
        *eye_rows(case, repeats=repeats, search_s=search_s),
        *focus_rows(case, vector, **common),
        *aberration_rows("on-axis", case, vector, **common),
        *aberration_rows("off-axis", case, vector, **common),
    ]
