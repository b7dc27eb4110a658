"""The picture whose images through linear operators are nearest to their targets.

With operators A, targets t and a weight W, the solver minimizes the mean over the
operators of ||W (A x - t)||² / 2 for pictures x between black and white.

The method is greedy FISTA (Liang, Luo & Schönlieb, SIAM J. Sci. Comput. 44:A1069,
2022), an accelerated projected gradient: each step starts from the last picture
extrapolated by its full change, and the momentum restarts when it points uphill.  It
needs 20 to 25 % fewer iterations than FISTA with the same restarts: 14 to 81 instead of
20 to 104 to 0.01 of the distance to the minimum, for letters and a photograph, and
discs of 2 to 10 px.  Images of extrapolated pictures are extrapolated images, so that
an iteration takes one forward and one adjoint call of each operator.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage
from filter_service.validation import show

Image = NDArray[np.float32]

MAX_POWER_STEPS, POWER_CHANGE = 10, 0.01
"""The power iteration ends when the norm changes by a smaller ratio.  It then is a
lower bound, which the solver raises when a step meets a greater curvature."""

LEAST_SCALE_RATIO = 0.1
"""Smallest scale of a pixel, relative to the mean."""

CURVATURE_MARGIN = 1.02
ROUNDING_RATIO = 1e-12
"""Squares of differences below this ratio of the targets' squares are rounding."""

LONG_STEP = 1.3
"""First step, relative to the greatest that makes plain projected gradients descend."""

FAR_RATIO, STEP_SHRINKAGE = 3.0, 0.96
"""Long steps shrink when a change of the picture exceeds the first by this ratio."""

HALVES_RATIO = 1.0
"""Errors within c / k² of the least after k iterations fall in the second half by three
times the remaining distance; 1 leaves a margin."""

MIN_ITERATIONS, MAX_ITERATIONS = 10, 100_000
TOLERANCE_LIMITS = 0.0, 1.0


class PictureOperator(Protocol):
    """A linear map from pictures to images, such as `EyeFilter.operator` returns."""

    @property
    def color_shape(self) -> tuple[int, ...]:
        """The shape of pictures."""

    @property
    def image_shape(self) -> tuple[int, ...]:
        """The shape of images."""

    def forward(self, color: Image, /) -> Image:
        """Return the image of a picture, linear light."""

    def adjoint(self, image: Image, /) -> Image:
        """Return the transpose of the map, applied to an image."""


class Weight(Protocol):
    """A linear filter W of differences between images, as W = T with a transpose."""

    def forward(self, image: Image, /) -> Image:
        """Return T applied to an image; its sum of squares is the weighted error."""

    def adjoint(self, values: Image, /) -> Image:
        """Return the transpose of T applied to such values."""


@dataclass(frozen=True)
class PictureSolution:
    """A picture and the course of the solution.

    Attributes
    ----------
    color : float32
        The picture, linear light.
    errors : tuple of float
        Weighted mean square difference from the targets: of the start, and after each
        iteration.
    lower_bound : float
        Proven lower bound of that error for any picture within the limits.
    has_converged : bool
        Whether the stopping rule ended the iterations, not their limit.
    """

    color: Image
    errors: tuple[float, ...]
    lower_bound: float
    has_converged: bool

    @property
    def iteration_count(self) -> int:
        """Return the number of iterations."""
        return len(self.errors) - 1


def nearest_picture(
    operators: Sequence[PictureOperator],
    targets: Sequence[NDArray[Any]],
    *,
    start: NDArray[Any] | None = None,
    weight: Weight | None = None,
    limits: tuple[float, float] = (0.0, 1.0),
    tolerance: float = 0.01,
    max_iterations: int = 200,
    on_iteration: Callable[[int, float], None] | None = None,
) -> PictureSolution:
    """Return the picture whose images are nearest to their targets.

    Parameters
    ----------
    operators : sequence
        Objects with ``forward``, ``adjoint``, ``color_shape`` and ``image_shape``, such
        as of `EyeFilter.operator`.  All have the same shape of pictures.
    targets : sequence of arrays
        Target of each operator, linear light, in the shape of its images.
    start : array, optional
        First picture, in the shape of pictures; by default the mean of the limits.
    weight : object, optional
        Linear filter of differences with ``forward`` and ``adjoint``, such as
        `SensitivityWeight`; by default all differences count alike.
    limits : (low, high)
        Black and white of the display, linear light.
    tolerance : float, 0 to 1
        Remaining error, relative to the whole reduction, at which the solver stops: by
        the proven bound, or by the course of the last half of the iterations.  0 uses
        all iterations.
    max_iterations : int
    on_iteration : callable, optional
        Called with the number of iterations and the error.

    Returns
    -------
    PictureSolution

    Raises
    ------
    BadMessage
        If shapes differ, an array is not finite, or a number is out of range (a
        ValueError, too).
    """
    problem = _Problem(operators, targets, weight)
    low, high = _checked_limits(limits)
    check_number("tolerance", tolerance, TOLERANCE_LIMITS)
    check_number("max_iterations", max_iterations, (1, MAX_ITERATIONS))
    if start is None:
        x = np.full(problem.color_shape, 0.5 * (low + high), np.float32)
    else:
        x = _as_image("start", start, problem.color_shape).clip(low, high)
    scales = problem.scales()
    curvature, long_step = problem.curvature(scales), LONG_STEP
    values = problem.values(x)
    y, at_y = x, values
    errors = [problem.error(values)]
    best, lower_bound, first_change = x, 0.0, 0.0
    has_converged = False
    for k in range(1, max_iterations + 1):
        slope = problem.gradient(at_y)
        bound = problem.error(at_y) - 2.0 * problem.per_value * _gap(
            y, slope, low, high
        )
        lower_bound = min(max(lower_bound, bound), errors[-1])
        while True:
            x_new = np.clip(y - slope * (long_step / curvature / scales), low, high)
            new = problem.values(x_new)
            step = x_new - y
            scaled = scales * step
            length, bent = _dot(scaled, step), problem.squared_distance(new, at_y)
            limit = CURVATURE_MARGIN * curvature * length
            if bent <= limit + problem.rounding or length == 0.0:
                break
            curvature = CURVATURE_MARGIN * bent / length
        change = x_new - x
        if _dot(scaled, change) <= 0.0:
            y, at_y = x_new, new
        else:
            y = x_new + change
            at_y = [2.0 * a - b for a, b in zip(new, values, strict=True)]
        changed = _dot(change, change)
        first_change = first_change or changed
        if changed > FAR_RATIO**2 * first_change:
            long_step = max(STEP_SHRINKAGE * long_step, 1.0)
        x, values = x_new, new
        errors.append(problem.error(values))
        if errors[-1] <= min(errors[:-1]):
            best = x
        if on_iteration is not None:
            on_iteration(k, errors[-1])
        if _is_near(errors, lower_bound, tolerance):
            has_converged = True
            break
    return PictureSolution(best, tuple(errors), lower_bound, has_converged)


def _is_near(errors: list[float], lower_bound: float, tolerance: float) -> bool:
    """Return whether the least error is reached, by the bound or by the course."""
    least, n_done = min(errors), len(errors) - 1
    if tolerance == 0.0:
        return False
    if least - lower_bound <= tolerance * (errors[0] - lower_bound):
        return True
    if n_done < MIN_ITERATIONS:
        return False
    reduction = min(errors[: n_done // 2 + 1]) - least
    return reduction <= HALVES_RATIO * tolerance * (errors[0] - least)


class _Problem:
    """The sum of squares over operators: values T (A x - t), and its gradient."""

    def __init__(
        self,
        operators: Sequence[PictureOperator],
        targets: Sequence[NDArray[Any]],
        weight: Weight | None,
    ) -> None:
        if not operators or len(operators) != len(targets):
            raise BadMessage(
                f"there are {len(targets)} for {len(operators)} operators",
                field="targets",
                allowed="one for each of at least one operator",
            )
        shapes = {tuple(operator.color_shape) for operator in operators}
        if len(shapes) > 1:
            raise BadMessage(
                f"their pictures have shapes {sorted(shapes)}",
                field="operators",
                allowed="the same shape",
            )
        (self.color_shape,) = shapes
        self._operators, self._weight = operators, weight
        self._targets = [
            _as_image(f"targets[{k}]", target, tuple(operator.image_shape))
            for k, (operator, target) in enumerate(zip(operators, targets, strict=True))
        ]
        n_values = sum(target.size for target in self._targets)
        self.per_value = 1.0 / n_values
        self.rounding = ROUNDING_RATIO * sum(_dot(t, t) for t in self._targets)

    def values(self, x: Image) -> list[Image]:
        """Return the weighted differences of each operator's image from its target."""
        pairs = zip(self._operators, self._targets, strict=True)
        return [self._weighted(operator.forward(x) - t) for operator, t in pairs]

    def _weighted(self, image: Image) -> Image:
        return image if self._weight is None else self._weight.forward(image)

    def error(self, values: list[Image]) -> float:
        """Return the mean square of the weighted differences."""
        return self.per_value * sum(_dot(each, each) for each in values)

    def gradient(self, values: list[Image]) -> Image:
        """Return the gradient of half the sum of squares."""
        total: Image | None = None
        for operator, each in zip(self._operators, values, strict=True):
            image = each if self._weight is None else self._weight.adjoint(each)
            slope = operator.adjoint(image)
            total = slope if total is None else total + slope
        assert total is not None
        return total

    def squared_distance(self, first: list[Image], second: list[Image]) -> float:
        """Return the square of the distance between two lists of values."""
        pairs = zip(first, second, strict=True)
        return sum(_dot(d, d) for d in (a - b for a, b in pairs))

    def scales(self) -> Image:
        """Return scales of pixels in which the curvature varies less.

        Without a weight, no curvature exceeds 1 in them: the sums of rows of A'A, which
        has no negative entries.  They are 1 but near edges, where they are 0.4 to 1.5.
        """
        ones = np.ones(self.color_shape, np.float32)
        images = [operator.forward(ones) for operator in self._operators]
        pairs = zip(self._operators, images, strict=True)
        sums = np.sum([operator.adjoint(image) for operator, image in pairs], axis=0)
        least = LEAST_SCALE_RATIO * float(sums.mean())
        return np.maximum(sums, np.float32(least)) if least > 0.0 else ones

    def curvature(self, scales: Image) -> float:
        """Return the greatest curvature, by a power iteration from positive noise."""
        noise = np.random.default_rng(0).random(self.color_shape, np.float32)
        found = 0.0
        for _ in range(MAX_POWER_STEPS):
            noise /= np.float32(math.sqrt(_dot(noise, scales * noise)))
            images = [self._weighted(op.forward(noise)) for op in self._operators]
            before, found = found, sum(_dot(each, each) for each in images)
            if found == 0.0:
                return 1.0
            if found - before <= POWER_CHANGE * found:
                break
            noise = self.gradient(images) / scales
        return found


def _gap(y: Image, slope: Image, low: float, high: float) -> float:
    """Return the greatest decrease of a linear function from y within the limits."""
    farthest = np.where(slope > 0.0, np.float32(low), np.float32(high))
    return _dot(slope, y - farthest)


def _dot(a: Image, b: Image) -> float:
    return float(np.vdot(a, b))


def _as_image(field: str, given: NDArray[Any], shape: tuple[int, ...]) -> Image:
    image = np.asarray(given, np.float32)
    if image.shape != shape:
        raise BadMessage(f"it has shape {image.shape}", field=field, allowed=f"{shape}")
    if not np.isfinite(image).all():
        n_bad = int(np.count_nonzero(~np.isfinite(image)))
        raise BadMessage(
            f"{n_bad} values are not finite", field=field, allowed="finite values"
        )
    return image


def _checked_limits(limits: tuple[float, float]) -> tuple[float, float]:
    low, high = (float(value) for value in limits)
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise BadMessage(
            f"they are {show(list(limits))}", field="limits", allowed="low < high"
        )
    return low, high


def check_number(field: str, value: float, limits: tuple[float, float]) -> None:
    """Raise BadMessage unless a number is within limits."""
    low, high = limits
    is_number = isinstance(value, numbers.Real)
    if not (is_number and low <= value <= high):
        raise BadMessage(
            f"it is {show(value)}", field=field, allowed=f"{low:g} to {high:g}"
        )
