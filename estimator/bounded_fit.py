"""Least squares with bounds and a unit prior, for a model that is cheap in batches.

Gauss-Newton in a trust region: the Jacobian's finite differences are one batch, and
each linear step is solved exactly within the bounds.  scipy's own `least_squares` calls
its model once per parameter and keeps off the bounds; here a bound is reached and stays
known as such.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dposv
from scipy.optimize import lsq_linear

DIFFERENCE_STEP = 1e-4
"""Of the Jacobian, in prior deviations; the model is smooth to 1e-9 of its values."""

FIRST_REACH, SMALLEST_REACH, LARGEST_REACH = 8.0, 1e-4, 20.0
"""Longest step of any one parameter, in prior deviations (a box trust region)."""

SMALLEST_DECREASE = 0.1
"""Relative decrease of the cost by one Jacobian below which the fit has ended."""

MET_UM = 1e-4
"""Misfit of every coefficient at which the fit has ended: a hundredth of what
instruments repeat to."""

BOX_TOLERANCE = 1e-10
"""Of the box problem, in prior deviations."""

BLOCK_TRIES = 3
MAX_PASSES = 150
"""Of the box problem: how long whole blocks may change in vain, and all passes."""

MAX_STEPS_PER_JACOBIAN = 4
GOOD_SHARE = 0.5
"""A step that leaves more of the cost than this asks for a new Jacobian."""

Model = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""(P, N) unit parameters to (P, K) values; NaN rows where there is no answer."""


@dataclass(frozen=True)
class BoundedFit:
    """Where the fit ended.

    ``position_ratio`` (N,) is in prior deviations; ``values_um`` (K,) and
    ``jacobian_um`` (K, N) are the model and its derivatives there.
    """

    position_ratio: NDArray[np.float64]
    values_um: NDArray[np.float64]
    jacobian_um: NDArray[np.float64]
    n_iterations: int
    n_evaluations: int
    converged: bool


class FitFailed(ValueError):
    """The model has no answer at the start."""


class _State(NamedTuple):
    position: NDArray[np.float64]
    value_um: NDArray[np.float64]
    cost: float


class _Descent:
    """One fit under way: where it stands, its Jacobian and its trust region."""

    def __init__(self, model: Model, target_um, bounds, noise_um: float):
        self.model, self.target_um, self.noise_um = model, target_um, noise_um
        self.low, self.high = bounds
        self.n_evaluations, self.reach = 0, FIRST_REACH

    def start(self, position) -> None:
        self.state = self.state_at(position)
        if not np.isfinite(self.state.cost):
            raise FitFailed("light does not pass the start eye at this pupil")
        self.differentiate()

    def values_um(self, positions):
        self.n_evaluations += len(positions)
        return self.model(positions)

    def state_at(self, position):
        position = np.clip(position, self.low, self.high)
        value_um = self.values_um(position[None])[0]
        misfit = (value_um - self.target_um) / self.noise_um
        cost = float(misfit @ misfit + position @ position)
        return _State(position, value_um, cost if np.isfinite(cost) else np.inf)

    @property
    def is_met(self) -> bool:
        return np.max(np.abs(self.state.value_um - self.target_um)) < MET_UM

    def differentiate(self) -> None:
        """Jacobian (K, N) by differences, in one batch."""
        position, value_um, _ = self.state
        # differences go inwards at an upper bound: beyond it the model may not trace
        inwards = position + DIFFERENCE_STEP > self.high
        steps = np.where(inwards, -DIFFERENCE_STEP, DIFFERENCE_STEP)
        values_um = self.values_um(position + np.diag(steps))
        jacobian_um = ((values_um - value_um) / steps[:, None]).T
        self.jacobian_um = np.where(np.isfinite(jacobian_um), jacobian_um, 0.0)

    def learn(self, old, new) -> None:
        """Broyden's update: what a step showed, the Jacobian now says."""
        step = new.position - old.position
        length = step @ step
        if np.isfinite(new.cost) and length > 0.0:
            change_um = new.value_um - old.value_um
            surprise_um = change_um - self.jacobian_um @ step
            self.jacobian_um = self.jacobian_um + np.outer(surprise_um, step / length)

    def linear_step(self, state):
        """Step of the linearised problem in bounds and reach; the cost promised."""
        scaled = self.jacobian_um / self.noise_um
        misfit = (state.value_um - self.target_um) / self.noise_um
        hessian = scaled.T @ scaled + np.eye(state.position.size)
        downhill = -(scaled.T @ misfit + state.position)
        room = (
            np.maximum(self.low - state.position, -self.reach),
            np.minimum(self.high - state.position, self.reach),
        )
        step = box_minimum(hessian, downhill, room)
        left = np.concatenate([scaled @ step + misfit, step + state.position])
        return step, float(left @ left)

    def advance(self) -> bool:
        """Try one step, and a second that takes its curvature back out.

        Returns whether the Jacobian served well enough to be used again.
        """
        before = self.state
        step, promised = self.linear_step(before)
        tried = self.state_at(before.position + step)
        self.learn(before, tried)
        promise = max(before.cost - promised, 1e-30)
        if before.cost - tried.cost < 0.75 * promise and np.isfinite(tried.cost):
            back, _ = self.linear_step(tried)
            again = self.state_at(tried.position + back)
            self.learn(tried, again)
            if again.cost < tried.cost:
                tried = again
        gain = (before.cost - tried.cost) / promise
        length = float(np.max(np.abs(step)))
        if gain < 0.25:
            self.reach = 0.25 * length
        elif gain > 0.75 and length > 0.99 * self.reach:
            self.reach = min(2.0 * self.reach, LARGEST_REACH)
        if tried.cost < before.cost:
            self.state = tried
        return tried.cost < GOOD_SHARE * before.cost


def fit_bounded(
    model: Model,
    *,
    target_um: NDArray[np.float64],
    start: NDArray[np.float64],
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]],
    noise_um: float,
    max_iterations: int = 25,
) -> BoundedFit:
    """Minimise |(model(q) - target) / noise|² + |q|² over low <= q <= high.

    An iteration is one Jacobian and as many steps as it serves well: a step costs one
    evaluation or two, a Jacobian N of them.

    Raises
    ------
    FitFailed
        The model has no answer at the start.
    """
    descent = _Descent(model, target_um, bounds, noise_um)
    descent.start(start)
    iteration, ended = 0, False
    while iteration < max_iterations and not ended:
        iteration += 1
        before = descent.state
        for _ in range(MAX_STEPS_PER_JACOBIAN):
            served_well = descent.advance()
            ended = descent.is_met or descent.reach < SMALLEST_REACH
            if ended or (not served_well and descent.state is not before):
                break
        decrease = before.cost - descent.state.cost
        ended = ended or 0.0 < decrease < SMALLEST_DECREASE * before.cost
        if descent.state is not before:
            descent.differentiate()
    return BoundedFit(
        position_ratio=descent.state.position,
        values_um=descent.state.value_um,
        jacobian_um=descent.jacobian_um,
        n_iterations=iteration,
        n_evaluations=descent.n_evaluations,
        converged=ended,
    )


def box_minimum(
    hessian: NDArray[np.float64],
    downhill: NDArray[np.float64],
    room: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Minimise x H x / 2 - g x over a box: block principal pivoting (Portugal 1994).

    Every pass solves for the free unknowns, ties all that leave the box to its wall
    and frees all that a wall holds back from descending.  Where that stops paying, one
    unknown changes at a time (Murty's rule), which cannot cycle.
    """
    low, high = room
    side = np.zeros(downhill.size, dtype=np.int64)  # -1 on low, 1 on high, 0 free
    pull = BOX_TOLERANCE * np.diag(hessian)  # what moves an unknown by the tolerance
    fewest, tries = downhill.size + 1, BLOCK_TRIES
    for _ in range(MAX_PASSES):
        step = np.where(side < 0, low, np.where(side > 0, high, 0.0))
        free = side == 0
        right = (downhill - hessian @ step)[free]
        if right.size:
            step[free] = dposv(hessian[np.ix_(free, free)], right)[1]
        slope = downhill - hessian @ step
        above, below = step > high + BOX_TOLERANCE, step < low - BOX_TOLERANCE
        wanted = np.where(free, above * 1 - below * 1, side)
        wanted[~free & (side * slope < -pull)] = 0
        wrong = np.flatnonzero(wanted != side)
        if wrong.size == 0:
            return np.clip(step, low, high)
        if wrong.size < fewest:
            fewest, tries = wrong.size, BLOCK_TRIES
        elif tries > 0:
            tries -= 1
        else:
            wrong = wrong[-1:]
        side[wrong] = wanted[wrong]
    factor = cholesky(hessian)  # rounding can still defeat the rule
    right = solve_triangular(factor, downhill, trans="T")
    return lsq_linear(factor, right, bounds=room, method="bvls").x
