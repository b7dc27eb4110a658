"""Choice of the PSFs in a cache, and prediction of their cost, before computing any.

At the neighboring nodes of pupil and accommodation, a frame reads the total defocus of
its objects, focus and channels.  Nodes cover only that range, and a stream plans the
nodes of a state when a frame first reads it.

The blending error is the same in all intervals, and the number of nodes is the smallest
that meets the axis's share of the tolerance.  The error of each axis falls with the
same power of its number of nodes, so equal shares minimize the number of PSFs.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.field.traced_fields import scaled_progress
from filter_service.planning.cost import predicted_cost
from filter_service.planning.defocus_nodes import (
    EXACT_DPT,
    DefocusNodes,
    GroupRays,
    defocus_nodes,
    node_blur_px,
    paper_axes,
    paper_defocus,
)
from filter_service.planning.grid import (
    GREEN,
    GridSpec,
    defocus_nodes_dpt,
    nodes_through_foci_dpt,
    pupil_nodes_mm,
)
from filter_service.planning.node_wavefronts import (
    NodeWavefronts,
    PupilStates,
    WavefrontsOf,
    main_foci_dpt,
    node_evaluator,
)
from filter_service.planning.nodes import (
    CachePlan,
    PlanAxes,
    PlanNodes,
    PlanPrediction,
    RaggedNodes,
    ReadableDefocus,
    accommodation_range_dpt,
    check_plan_defocus,
    joined_ranges,
    readable_defocus,
    usable_pupils_mm,
)
from filter_service.planning.state_samples import (
    AXES,
    StateSample,
    allowed_difference_px,
    axis_error,
    axis_errors,
    combined_error,
    defocus_error,
    equal_share,
    focus_light,
    focus_slopes_px,
    half_way_error,
    mean_square,
    moved,
    psnr_db,
    sample_states,
    spot_covariance,
)
from filter_service.settings import TOLERANCES

TOLERANCE_DB = {"loose": 47.0, "normal": 53.0, "fine": 56.0}
"""Lowest PSNR after interpolation, predicted by the error law as a mean over states,
but for the mode "quality", see `QUALITY_DB`.  `state_samples.FLOOR` is 57.4 dB.  In
encoded images of the mode "dynamic", 95 % of blocks of 32x32 pixels keep 39.0, 44.1 and
46.3 dB, and the median block 45.2, 49.9 and 52.3 dB (`bench_levels`, six eyes,
320x180)."""

QUALITY_DB = {"loose": 50.0, "normal": 56.0, "fine": 57.0}
"""The same for the mode "quality".  A single state at 640x360 has 2.4 to 3 times the
PSFs of 53 dB, 5 to 12 MB, and its pictures a PSNR that is 2 to 4 dB higher (six eyes).
Beyond `state_samples.FLOOR`, ten times the PSFs add 1 dB.
"""

MAX_NODES = 64
"""Largest number of nodes on one axis, except defocus."""

COUNTS_AT_ONCE = 3
"""Number of node counts evaluated per call of the eye, which takes at least 12 ms."""

STATE_AXES = ("pupil", "accommodation")
"""Axes that may have a single node, in the middle of a narrow range.  Frames read it at
their own defocus.  Each axis of the field has at least two nodes."""

_SAMPLES = 33
_STATES_PER_SAMPLE = 16


def target_error(spec: GridSpec) -> float:
    """Return the mean square error that interpolation may cause in total."""
    settings = spec.settings
    wanted_db = QUALITY_DB if settings.mode == "quality" else TOLERANCE_DB
    return 10.0 ** (-wanted_db[settings.tolerance] / 10.0)


def axis_nodes(
    sample: StateSample, axis: str, range_: tuple[float, float], *, allowed_error: float
) -> tuple[NDArray[np.float64], float]:
    """Return the nodes (n,) of one axis over its range, and their mean square error.

    Parameters
    ----------
    range_ : (low, high)
        Range of the axis; low < high.
    allowed_error : float
        Largest mean square error.
    """
    low, high = range_
    samples = np.linspace(low, high, _SAMPLES)
    needed = _needed_intervals(sample, axis, samples, allowed_error)
    if axis in STATE_AXES:
        middle = np.interp([0.5 * needed[-1]], needed, samples)
        error = axis_error(sample, axis, middle)
        if error <= allowed_error:
            return middle, error
    count = 1 + min(max(1, math.floor(0.8 * needed[-1])), MAX_NODES - 1)
    while True:
        counts = range(count, min(count + COUNTS_AT_ONCE, MAX_NODES + 1))
        choices = [
            np.interp(np.linspace(0.0, needed[-1], n), needed, samples) for n in counts
        ]
        errors = axis_errors(sample, axis, choices)
        for nodes, error in zip(choices, errors, strict=True):
            if error <= allowed_error or nodes.size >= MAX_NODES:
                return nodes, error
        # The error falls with the fourth power of the number of intervals, and slightly
        # slower where rays do not move in proportion.  0.9 avoids too many nodes.
        grown = (counts[-1] - 1) * (errors[-1] / allowed_error) ** 0.25
        count = min(max(counts[-1] + 1, 1 + math.floor(0.9 * grown)), MAX_NODES)


def _needed_intervals(
    sample: StateSample, axis: str, samples: NDArray[Any], allowed_error: float
) -> NDArray[np.float64]:
    """Return the number of intervals needed up to each sample of the axis."""
    count = min(_STATES_PER_SAMPLE, sample.vergence_dpt.size)
    some = sample.select(np.arange(count))
    repeated = sample.select(np.tile(np.arange(count), samples.size))
    states = moved(repeated, axis, np.repeat(samples, count))
    power = np.zeros((samples.size - 1, count))
    for light_ratio, added_dpt in focus_light(some):
        slopes = focus_slopes_px(some, states, np.tile(added_dpt, samples.size))
        slopes = slopes.reshape(samples.size, count, *slopes.shape[1:])
        difference_px = np.sqrt(mean_square(np.diff(slopes, axis=0)))
        allowed_px = allowed_difference_px(
            spot_covariance(0.5 * (slopes[1:] + slopes[:-1])),
            unit_px=some.unit_px,
            half_way_error=half_way_error(axis, allowed_error),
        )
        # The mean square error grows with the fourth power of the difference.
        power += light_ratio**2 * (difference_px / allowed_px) ** 4
    dense = power.mean(axis=1) ** 0.25
    return np.concatenate([[0.0], np.cumsum(dense + 0.1 * dense.mean() + 1e-12)])


__all__ = [
    "CachePlan",
    "NodePlanner",
    "PlanPrediction",
    "PlanTooLarge",
    "RaggedNodes",
    "plan_axes",
    "plan_cache",
    "unchecked_plan",
]

STATE_SAMPLES = 96
"""Number of states for which errors are predicted."""

AXES_SHARE = 0.4
"""Share of the axes in the duration of a plan; the rest are the nodes of states."""

OWN_SHARE = 0.9
"""Progress of a finished plan; the rest are smaller plans if it is too large."""

Progress = Callable[[float], None]


class PlanTooLarge(ValueError):
    """A cache would need more memory than its budget.

    Attributes
    ----------
    prediction : PlanPrediction
    budget_mb : float
    """

    def __init__(self, spec: GridSpec, prediction: PlanPrediction, advice: str):
        super().__init__(
            f"the planned PSFs need {_needs(prediction)}; memory_budget_mb allows "
            f"{_mb(spec.memory_budget_mb)}: {advice}"
        )
        self.prediction = prediction
        self.budget_mb = spec.memory_budget_mb


def plan_cache(
    eye: EyeOptics, spec: GridSpec, *, progress: Progress | None = None
) -> CachePlan:
    """Plan the nodes of all axes for the frames of a spec, and predict their cost.

    Parameters
    ----------
    progress : callable, optional
        Callback with the completed fraction; may raise to cancel.

    Raises
    ------
    ProfileError
        If the defocus is beyond the defocus of any eye.
    GridTooLarge
        If a single group needs too many PSFs.
    PlanTooLarge
        If the kernels exceed ``spec.memory_budget_mb``; the message proposes a change.
    """
    own = scaled_progress(progress, 0.0, OWN_SHARE)
    plan = unchecked_plan(eye, spec, predict=False, progress=own)
    prediction = _prediction(eye, spec, plan)
    if prediction.memory_mb > spec.memory_budget_mb:
        advice = _advice(eye, spec, scaled_progress(progress, OWN_SHARE, 1.0))
        raise PlanTooLarge(spec, prediction, advice)
    return replace(plan, prediction=prediction)


def unchecked_plan(
    eye: EyeOptics,
    spec: GridSpec,
    *,
    target_db: float | None = None,
    predict: bool = True,
    progress: Progress | None = None,
) -> CachePlan:
    """Plan like `plan_cache`, without a limit on memory.

    Parameters
    ----------
    target_db : float, optional
        Lowest PSNR after interpolation; by default from the spec's tolerance.
    predict : bool
        Predict the cost of the plan.
    progress : callable, optional
        Callback with the completed fraction; may raise to cancel.
    """
    of_axes = scaled_progress(progress, 0.0, AXES_SHARE)
    axes = plan_axes(eye, spec, target_db=target_db, progress=of_axes)
    of_nodes = scaled_progress(progress, AXES_SHARE, 1.0)
    plan = CachePlan(
        *(axes.h_deg, axes.v_deg, axes.pupils_mm, axes.accommodations_dpt),
        defocus_error=axes.defocus_error,
        nodes=NodePlanner(eye, spec, axes).all_nodes(of_nodes),
    )
    if not predict:
        return plan
    return replace(plan, prediction=_prediction(eye, spec, plan))


def _prediction(eye: EyeOptics, spec: GridSpec, plan: CachePlan) -> PlanPrediction:
    """Predict the cost of a plan and its interpolation errors."""
    errors = _errors(sample_states(eye, spec, STATE_SAMPLES), plan)
    return PlanPrediction(
        **predicted_cost(eye, spec, plan),
        interpolation_db=psnr_db(combined_error(list(errors.values()))),
        error_db_by_axis={name: psnr_db(error) for name, error in errors.items()},
    )


def plan_axes(
    eye: EyeOptics,
    spec: GridSpec,
    *,
    target_db: float | None = None,
    progress: Progress | None = None,
) -> PlanAxes:
    """Plan the nodes of field, pupil and accommodation.

    Parameters
    ----------
    target_db : float, optional
        Lowest PSNR after interpolation; by default from the spec's tolerance.
    progress : callable, optional
        Callback with the completed fraction; may raise to cancel.

    Raises
    ------
    ProfileError
        If the defocus is beyond the defocus of any eye.
    """
    allowed_error = target_error(spec)
    if target_db is not None:
        allowed_error = 10.0 ** (-target_db / 10.0)
    if spec.settings.grid == "paper":
        axes = paper_axes(eye, spec)
    elif spec.follows_field:
        sample = sample_states(eye, spec, STATE_SAMPLES)
        axes = _field_axes(sample, allowed_error, progress)
    else:
        axes = _central_axes(eye, spec)
    check_plan_defocus(eye, spec, axes)
    return axes


class NodePlanner:
    """Planner of the nodes of total defocus, state by state.

    The nodes of a state do not depend on the states planned before.

    Parameters
    ----------
    eye : EyeOptics
    spec : GridSpec
    axes : PlanAxes
    """

    def __init__(self, eye: EyeOptics, spec: GridSpec, axes: PlanAxes) -> None:
        self.eye, self.spec, self.axes = eye, spec, axes
        self._cached_dpt: dict[tuple[float, float], NDArray[np.float64]] = {}

    def all_nodes(self, progress: Progress | None = None) -> PlanNodes:
        """Return the nodes of all states, in C order [pupil, accommodation].

        Parameters
        ----------
        progress : callable, optional
            Callback with the completed fraction; may raise to cancel.
        """
        counts = len(self.axes.pupils_mm), len(self.axes.accommodations_dpt)
        found = []
        for pupil, accommodation in np.ndindex(counts):
            found.append(self.nodes(pupil, accommodation))
            if progress is not None:
                progress(len(found) / math.prod(counts))
        return PlanNodes.joined(found)

    def nodes(self, pupil: int, accommodation: int) -> PlanNodes:
        """Return the nodes of one state.

        Parameters
        ----------
        pupil, accommodation : int
            Indices of the nodes of the state.

        Raises
        ------
        GridTooLarge
            If a group needs too many PSFs.
        """
        eye, spec, axes = self.eye, self.spec, self.axes
        groups = self._groups(pupil, accommodation)
        wavefronts = NodeWavefronts.of(eye, spec, groups, self._wavefronts_of)
        rays = GroupRays.of(wavefronts)
        if spec.settings.grid == "paper":
            found = paper_defocus(eye, spec, groups)
        else:
            readable = readable_defocus(
                *(eye, spec, axes, self._ranges, self._defocus_dpt),
                *(pupil, accommodation),
            )
            found = (
                defocus_nodes(
                    *(eye, spec, groups, rays, readable),
                    allowed_error=axes.defocus_error,
                )
                if spec.follows_field
                else _central_defocus(eye, spec, readable, axes.pupils_mm[pupil])
            )
        if np.any(found.shrink_ratio != 1.0):
            wavefronts = wavefronts.scaled(found.shrink_ratio)
        if spec.settings.lateral_color and spec.settings.chromatic:
            wavefronts = wavefronts.with_lateral_color(eye, spec, groups)
        return PlanNodes(
            defocus=found.nodes,
            channel_shift_dpt=found.channel_shift_dpt,
            blur_px=node_blur_px(
                *(eye, spec, rays, found.nodes),
                *(found.channel_shift_dpt, found.shrink_ratio),
            ),
            is_limited=found.is_limited,
            shrink_ratio=found.shrink_ratio,
            wavefronts=wavefronts,
        )

    @cached_property
    def widest_pupils(self) -> NodeWavefronts:
        """Wavefronts of the field nodes through the widest pupil."""
        groups = self._groups(-1, 0)
        return NodeWavefronts.of(self.eye, self.spec, groups, self._wavefronts_of)

    def _groups(self, pupil: int, accommodation: int) -> PupilStates:
        """Return the field nodes of a state, in green light without defocus."""
        h_deg, v_deg = self.axes.field_nodes_deg
        return PupilStates.of(
            h_deg=h_deg,
            v_deg=v_deg,
            pupil_diameter_mm=self.axes.pupils_mm[pupil],
            accommodation_dpt=self.axes.accommodations_dpt[accommodation],
            wavelength_nm=self.spec.channel_wavelengths_nm[GREEN],
            total_defocus_dpt=0.0,
        )

    @cached_property
    def _ranges(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Ranges of pupils and accommodations that frames read."""
        return (
            usable_pupils_mm(self.eye, self.spec),
            accommodation_range_dpt(self.eye, self.spec),
        )

    def _defocus_dpt(
        self, pupil_mm: float, accommodation_dpt: float
    ) -> NDArray[np.float64]:
        """Return the total defocus (n_v, n_h, 3) for objects at infinity, memoized."""
        state = pupil_mm, accommodation_dpt
        if state not in self._cached_dpt:
            self._cached_dpt[state] = self._defocus_of(
                pupil_diameter_mm=pupil_mm, accommodation_dpt=accommodation_dpt
            ).reshape(len(self.axes.v_deg), len(self.axes.h_deg), -1)
        return self._cached_dpt[state]

    @cached_property
    def _wavefronts_of(self) -> WavefrontsOf:
        return node_evaluator(self.eye, self.spec, *self.axes.field_nodes_deg)

    @cached_property
    def _defocus_of(self) -> Callable[..., NDArray[np.float64]]:
        return self.eye.defocus_at(
            h_deg=self.axes.h_deg[:, None],
            v_deg=self.axes.v_deg[:, None, None],
            wavelength_nm=self.spec.channel_wavelengths_nm,
        )


def _errors(sample: StateSample, plan: CachePlan) -> dict[str, float]:
    nodes = dict(
        zip(
            AXES,
            (plan.h_deg, plan.v_deg, plan.pupils_mm, plan.accommodations_dpt),
            strict=False,
        )
    )
    errors = {
        axis: axis_error(sample, axis, own)
        for axis, own in nodes.items()
        if len(own) > 1
    }
    return errors | {"defocus": defocus_error(sample, plan)}


def _central_axes(eye: EyeOptics, spec: GridSpec) -> PlanAxes:
    return PlanAxes(
        h_deg=np.zeros(1),
        v_deg=np.zeros(1),
        pupils_mm=pupil_nodes_mm(usable_pupils_mm(eye, spec)),
        accommodations_dpt=eye.accommodation_nodes_dpt(
            spec.settings.focus_range_dpt, pupil_range_mm=usable_pupils_mm(eye, spec)
        ),
    )


def _field_axes(
    sample: StateSample, allowed_error: float, progress: Progress | None
) -> PlanAxes:
    """Return the nodes of all axes but defocus, and the error that is left to it.

    An axis with few nodes stays below its share; the other axes share the remainder.
    """
    eye, spec = sample.eye, sample.spec
    ranges = {
        "accommodation": accommodation_range_dpt(eye, spec),
        "pupil": usable_pupils_mm(eye, spec),
        "v": spec.field_range_deg[1],
        "h": spec.field_range_deg[0],
    }
    nodes: dict[str, NDArray[np.float64]] = {}
    spent: list[float] = []
    open_ = [axis for axis, (low, high) in ranges.items() if high - low > 1e-9]
    for axis, range_ in ranges.items():
        if axis not in open_:
            nodes[axis] = np.array([range_[0]])
            continue
        share = equal_share(
            allowed_error, spent=spent, count=1 + len(open_) - len(spent)
        )
        nodes[axis], error = axis_nodes(sample, axis, range_, allowed_error=share)
        spent.append(error)
        if progress is not None:
            progress(len(spent) / len(open_))
    left = equal_share(allowed_error, spent=spent, count=1)
    h_deg, v_deg, pupils_mm, accommodations_dpt = (nodes[axis] for axis in AXES[:-1])
    return PlanAxes(h_deg, v_deg, pupils_mm, accommodations_dpt, left)


def _central_defocus(
    eye: EyeOptics, spec: GridSpec, readable: ReadableDefocus, pupil_mm: float
) -> DefocusNodes:
    """Return the nodes of the on-axis mode, spaced by blur radius alone.

    They are far denser than any tolerance requires.  A single distance seen in a single
    state needs only the exact PSF of each channel.
    """
    (exact_dpt,) = joined_ranges(readable.without_shift_dpt)
    if np.ptp(exact_dpt) < EXACT_DPT:
        exact = RaggedNodes.of([exact_dpt[:1, 0]])
        return DefocusNodes.unlimited(exact, readable.shift_dpt)
    (ranges_dpt,) = joined_ranges(readable.all_channels_dpt)
    nodes = RaggedNodes.of([_nodes_by_blur(eye, spec, pupil_mm, ranges_dpt)])
    return DefocusNodes.unlimited(nodes, np.zeros_like(readable.shift_dpt))


def _nodes_by_blur(
    eye: EyeOptics, spec: GridSpec, pupil_mm: float, ranges_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return nodes over ranges (n, 2) of total defocus."""
    steps = {
        "blur_px_per_dpt": spec.blur_px_per_dpt(pupil_mm),
        "max_blur_step_px": spec.max_blur_step_px,
    }
    if eye.rings is None:
        nodes = partial(defocus_nodes_dpt, **steps)
    else:
        foci_dpt = main_foci_dpt(eye, spec)
        nodes = partial(nodes_through_foci_dpt, foci_dpt=foci_dpt, **steps)
    pieces = [nodes(*range_dpt) for range_dpt in ranges_dpt.tolist()]
    return np.unique(np.concatenate(pieces))


def _advice(eye: EyeOptics, spec: GridSpec, progress: Progress | None) -> str:
    """Return a change of settings with which the plan fits, as text with its memory."""
    steps = _smaller_specs(spec)
    for number, (words, smaller) in enumerate(steps):
        shares = number / len(steps), (number + 1) / len(steps)
        own = scaled_progress(progress, *shares)
        plan = unchecked_plan(eye, smaller, predict=False, progress=own)
        found = _prediction(eye, smaller, plan)
        if found.memory_mb <= spec.memory_budget_mb:
            return f"{words} needs {_needs(found)}"
    return f"even {words} needs {_needs(found)}; use a smaller image"


def _needs(prediction: PlanPrediction) -> str:
    return f"{_mb(prediction.memory_mb)} for {prediction.psf_count} PSFs"


def _mb(memory_mb: float) -> str:
    return f"{memory_mb:.0f} MB" if memory_mb >= 10.0 else f"{memory_mb:.2g} MB"


def _smaller_specs(spec: GridSpec) -> list[tuple[str, GridSpec]]:
    """Return cumulative changes that make a plan smaller, the least harmful first."""
    steps: list[tuple[str, GridSpec]] = []
    words: list[str] = []

    def step(text: str, **settings: Any) -> None:
        words.append(text)
        last = steps[-1][1] if steps else spec
        steps.append((" and ".join(words), last.with_settings(**settings)))

    if spec.settings.pipeline == "published":
        step('pipeline "exact"', pipeline="exact", grid="planned")
    elif spec.settings.grid == "paper":
        step('grid "planned"', grid="planned")
    if spec.settings.mode == "quality":
        step('mode "dynamic"', mode="dynamic")
    for tolerance in reversed(TOLERANCES[: TOLERANCES.index(spec.settings.tolerance)]):
        step(f'tolerance "{tolerance}"', tolerance=tolerance)
    for most_mm in (6.0, 5.0, 4.0):
        if spec.settings.pupil_range_mm[0] <= most_mm < spec.settings.pupil_range_mm[1]:
            step(
                f"pupils up to {most_mm:g} mm",
                pupil_range_mm=(spec.settings.pupil_range_mm[0], most_mm),
            )
    if spec.settings.mode != "on-axis":
        step('mode "on-axis"', mode="on-axis")
    if not steps:
        step("the same plan")
    return steps
