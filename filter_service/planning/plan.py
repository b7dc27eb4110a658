"""Decides which PSFs a cache holds, and predicts their cost, before any is computed.

A frame reads total defocus t within the range that its objects, focus and channels can
reach, at the two neighbouring nodes of pupil and accommodation; only that is planned.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.constants import RGB
from filter_service.planning.axis_nodes import (
    axis_nodes,
    defocus_groups,
    limited_ranges_dpt,
    target_error,
)
from filter_service.planning.cost import predicted_cost
from filter_service.planning.error_law import combined_error, equal_share, psnr_db
from filter_service.planning.grid import (
    GREEN,
    GridSpec,
    defocus_nodes_dpt,
    pupil_nodes_mm,
)
from filter_service.planning.nodes import (
    CachePlan,
    PlanPrediction,
    RaggedNodes,
)
from filter_service.planning.paper_grid import paper_axes, paper_defocus
from filter_service.planning.sampled_use import (
    AXES,
    Use,
    axis_error,
    defocus_error,
    sample_use,
    unit_px,
)
from filter_service.planning.slopes import PupilStates
from filter_service.settings import TOLERANCES

__all__ = [
    "CachePlan",
    "PlanPrediction",
    "PlanTooLarge",
    "RaggedNodes",
    "plan_cache",
    "unchecked_plan",
]

USE_SAMPLES = 96
"""States at which errors are predicted."""


MAX_FIELD_STEP_DPT = 1.5
"""Change of defocus to the next field node that a node's range follows.  Only where an
eye hardly sees, as at the edge of a cataract, is it more; there the nodes' own ranges
end the blend at equal blur, and far objects are read a little nearer."""


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


@dataclass(frozen=True)
class PlanAxes:
    """Nodes of a plan but those of defocus."""

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    pupils_mm: NDArray[np.float64]
    accommodations_dpt: NDArray[np.float64]


def plan_cache(eye: EyeOptics, spec: GridSpec) -> CachePlan:
    """Nodes over field, pupil, accommodation and defocus that frames can read.

    Raises
    ------
    PlanTooLarge
        The kernels would exceed ``spec.memory_budget_mb``; the message proposes what
        to change.
    """
    plan = unchecked_plan(eye, spec)
    check_budget(eye, spec, plan)
    return plan


def check_budget(eye: EyeOptics, spec: GridSpec, plan: CachePlan) -> None:
    """Refuse a plan whose kernels would exceed ``spec.memory_budget_mb``.

    Raises
    ------
    PlanTooLarge
    """
    if plan.prediction.memory_mb > spec.memory_budget_mb:
        raise PlanTooLarge(spec, plan.prediction, _advice(eye, spec))


def unchecked_plan(
    eye: EyeOptics, spec: GridSpec, *, target_db: float | None = None
) -> CachePlan:
    """Plan like `plan_cache`, however large.

    Parameters
    ----------
    target_db : float, optional
        What interpolation may cost; the spec's tolerance says where it is None.
    """
    allowed_error = target_error(spec)
    if target_db is not None:
        allowed_error = 10.0 ** (-target_db / 10.0)
    use = sample_use(eye, spec, USE_SAMPLES)
    is_limited, shrink_ratio = None, None
    if spec.settings.grid == "paper":
        axes = PlanAxes(*paper_axes(eye, spec))
        defocus, shift_dpt = paper_defocus(eye, spec, tuple(vars(axes).values()))
    else:
        if spec.follows_field:
            axes, left = _field_axes(use, allowed_error)
            defocus, is_limited, shrink_ratio = _field_defocus(eye, spec, axes, left)
        else:
            axes = _central_axes(eye, spec)
            defocus = _central_defocus(eye, spec, axes)
        shift_dpt = np.zeros((len(defocus.starts) - 1, RGB))
    if is_limited is None:
        is_limited = np.zeros(len(defocus.starts) - 1, bool)
    plan = CachePlan(
        **vars(axes),
        defocus=defocus,
        channel_shift_dpt=shift_dpt,
        prediction=PlanPrediction(0, 0.0, 0.0, 0, 0.0, {}),
        is_limited=is_limited,
        shrink_ratio=shrink_ratio,
    )
    errors = _errors(use, plan)
    prediction = PlanPrediction(
        **predicted_cost(eye, spec, plan),
        interpolation_db=psnr_db(combined_error(list(errors.values()))),
        error_db_by_axis={name: psnr_db(error) for name, error in errors.items()},
    )
    return replace(plan, prediction=prediction)


def _errors(use: Use, plan: CachePlan) -> dict[str, float]:
    nodes = dict(
        zip(
            AXES,
            (plan.h_deg, plan.v_deg, plan.pupils_mm, plan.accommodations_dpt),
            strict=False,
        )
    )
    errors = {
        axis: axis_error(use, axis, own) for axis, own in nodes.items() if len(own) > 1
    }
    return errors | {"defocus": defocus_error(use, plan)}


def usable_pupils_mm(eye: EyeOptics, spec: GridSpec) -> tuple[float, float]:
    """Smallest and largest pupil of a spec that the eye knows."""
    low_mm, high_mm = spec.settings.pupil_range_mm
    return eye.usable_pupil_mm(low_mm), eye.usable_pupil_mm(high_mm)


def _accommodations_dpt(eye: EyeOptics, spec: GridSpec) -> NDArray[np.float64]:
    return eye.accommodation_nodes_dpt(
        spec.settings.focus_range_dpt, pupil_range_mm=usable_pupils_mm(eye, spec)
    )


def _central_axes(eye: EyeOptics, spec: GridSpec) -> PlanAxes:
    return PlanAxes(
        h_deg=np.zeros(1),
        v_deg=np.zeros(1),
        pupils_mm=pupil_nodes_mm(usable_pupils_mm(eye, spec)),
        accommodations_dpt=_accommodations_dpt(eye, spec),
    )


def _field_axes(use: Use, allowed_error: float) -> tuple[PlanAxes, float]:
    """Nodes but those of defocus, and the mean square error left to defocus.

    Axes with few nodes meet their share with some to spare; it goes to the others.
    """
    eye, spec = use.eye, use.spec
    used_dpt = _accommodations_dpt(eye, spec)
    ranges = {
        "accommodation": (used_dpt[0], used_dpt[-1]),
        "pupil": usable_pupils_mm(eye, spec),
        "v": spec.field_range_deg[1],
        "h": spec.field_range_deg[0],
    }
    nodes, spent = {}, []
    open_ = [axis for axis, (low, high) in ranges.items() if high - low > 1e-9]
    for axis, range_ in ranges.items():
        if axis not in open_:
            nodes[axis] = np.array([range_[0]])
            continue
        share = equal_share(
            allowed_error, spent=spent, count=1 + len(open_) - len(spent)
        )
        nodes[axis], error = axis_nodes(use, axis, range_, allowed_error=share)
        spent.append(error)
    left = equal_share(allowed_error, spent=spent, count=1)
    return PlanAxes(*(nodes[axis] for axis in AXES[:-1])), left


def _central_defocus(eye: EyeOptics, spec: GridSpec, axes: PlanAxes) -> RaggedNodes:
    """Nodes on axis: by blur radius alone, far closer than any tolerance asks for."""
    ranges_dpt = readable_ranges_dpt(eye, spec, axes)
    of_group = np.broadcast_to(axes.pupils_mm[:, None], ranges_dpt.shape[:-1])
    return RaggedNodes.of(
        [
            defocus_nodes_dpt(
                float(low_dpt),
                float(high_dpt),
                blur_px_per_dpt=spec.blur_px_per_dpt(pupil_mm),
                max_blur_step_px=spec.max_blur_step_px,
            )
            for pupil_mm, (low_dpt, high_dpt) in zip(
                of_group.ravel(), ranges_dpt.reshape(-1, 2), strict=True
            )
        ]
    )


def _field_defocus(
    eye: EyeOptics, spec: GridSpec, axes: PlanAxes, allowed_error: float
) -> tuple[RaggedNodes, NDArray[np.bool_], NDArray[np.float64]]:
    """Nodes, which groups end where kernels may not grow, and which have to shrink."""
    groups = PupilStates.of(
        h_deg=axes.h_deg[:, None, None],
        v_deg=axes.v_deg[:, None, None, None],
        pupil_diameter_mm=axes.pupils_mm[:, None],
        accommodation_dpt=axes.accommodations_dpt,
        wavelength_nm=spec.channel_wavelengths_nm[GREEN],
        total_defocus_dpt=0.0,
    )
    ranges_dpt = readable_ranges_dpt(eye, spec, axes).reshape(-1, 2)
    limited_dpt, shrink_ratio = limited_ranges_dpt(eye, spec, groups, ranges_dpt)
    nodes = defocus_groups(
        eye,
        spec,
        groups,
        limited_dpt,
        allowed_error=allowed_error,
        unit_px=unit_px(spec, groups),
    )
    return nodes, np.any(limited_dpt != ranges_dpt, axis=1), shrink_ratio


def _neighbours(index: int, count: int) -> list[int]:
    return list(range(max(index - 1, 0), min(index + 2, count)))


def _over_neighbours(values: NDArray, axis: int, extreme) -> NDArray:
    """Extreme over a node and those beside it along an axis."""
    count = values.shape[axis]
    beside = [_neighbours(i, count) for i in range(count)]
    return np.stack(
        [extreme(values.take(own, axis), axis=axis) for own in beside], axis=axis
    )


def readable_ranges_dpt(
    eye: EyeOptics, spec: GridSpec, axes: PlanAxes
) -> NDArray[np.float64]:
    """Smallest and largest total defocus (n_v, n_h, n_pupils, n_accommodations, 2).

    Over objects and channels, and over every accommodation and pupil that reads a node.
    """
    at_infinity_dpt = eye.total_defocus_dpt(
        h_deg=axes.h_deg[:, None, None, None],
        v_deg=axes.v_deg[:, None, None, None, None],
        pupil_diameter_mm=axes.pupils_mm[:, None, None],
        accommodation_dpt=axes.accommodations_dpt[:, None],
        wavelength_nm=spec.channel_wavelengths_nm,
    )
    lows, highs = at_infinity_dpt.min(axis=-1), at_infinity_dpt.max(axis=-1)
    used_dpt = axes.accommodations_dpt
    if len(used_dpt) == 1:  # one shape for all: accommodation is defocus alone
        least_dpt, most_dpt = eye.accommodation_range_dpt(
            spec.settings.focus_range_dpt, pupil_range_mm=usable_pupils_mm(eye, spec)
        )
        lows, highs = lows - (most_dpt - used_dpt[0]), highs - (least_dpt - used_dpt[0])
    else:
        beside = [_neighbours(j, len(used_dpt)) for j in range(len(used_dpt))]
        lows = np.stack([lows[..., j].min(axis=-1) for j in beside], axis=-1)
        highs = np.stack([highs[..., j].max(axis=-1) for j in beside], axis=-1)
    if spec.blends_at_equal_blur:  # nodes are read at the defocus between them
        own_lows, own_highs = lows, highs
        for axis in (0, 1):
            lows = _over_neighbours(lows, axis, np.min)
            highs = _over_neighbours(highs, axis, np.max)
        lows = np.maximum(lows, own_lows - MAX_FIELD_STEP_DPT)
        highs = np.minimum(highs, own_highs + MAX_FIELD_STEP_DPT)
    far_dpt, near_dpt = map(eye.vergence.vergence_dpt, spec.settings.object_range_dpt)
    near_far = np.stack([lows + far_dpt, highs + near_dpt], axis=-1)
    # A pupil between two nodes reads both at equal blur, up to the other's own.
    scaled = near_far * axes.pupils_mm[:, None, None]
    ranges = np.empty_like(near_far)
    for i, pupil_mm in enumerate(axes.pupils_mm):
        beside = scaled[:, :, _neighbours(i, len(axes.pupils_mm))]
        ranges[:, :, i, :, 0] = beside[..., 0].min(axis=2) / pupil_mm
        ranges[:, :, i, :, 1] = beside[..., 1].max(axis=2) / pupil_mm
    return ranges


def _advice(eye: EyeOptics, spec: GridSpec) -> str:
    """Say which one setting makes the plan fit, and what it then needs."""
    for words, smaller in _smaller_specs(spec):
        found = unchecked_plan(eye, smaller).prediction
        if found.memory_mb <= spec.memory_budget_mb:
            return f"{words} needs {_needs(found)}"
    return f"even {words} needs {_needs(found)}; use a smaller image"


def _needs(prediction: PlanPrediction) -> str:
    return f"{_mb(prediction.memory_mb)} for {prediction.psf_count} PSFs"


def _mb(memory_mb: float) -> str:
    return f"{memory_mb:.0f} MB" if memory_mb >= 10.0 else f"{memory_mb:.2g} MB"


def _smaller_specs(spec: GridSpec) -> list[tuple[str, GridSpec]]:
    """List changes that make a plan smaller, least painful first, each on top."""
    steps, words = [], []

    def step(text: str, **settings) -> None:
        words.append(text)
        last = steps[-1][1] if steps else spec
        steps.append((" and ".join(words), last.with_settings(**settings)))

    if spec.settings.grid == "paper":
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
