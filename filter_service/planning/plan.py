"""Decides which PSFs a cache holds, and predicts their cost, before any is computed.

A frame reads total defocus t within the range that its objects, focus and channels can
reach, at the two neighbouring nodes of pupil and accommodation; only that is planned.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.planning.axis_nodes import (
    axis_nodes,
    target_error,
)
from filter_service.planning.cost import predicted_cost
from filter_service.planning.defocus_nodes import (
    EXACT_DPT,
    DefocusNodes,
    defocus_nodes,
)
from filter_service.planning.error_law import combined_error, equal_share, psnr_db
from filter_service.planning.grid import (
    GridSpec,
    defocus_nodes_dpt,
    nodes_through_foci_dpt,
    pupil_nodes_mm,
)
from filter_service.planning.node_blur import GroupRays, groups_of, node_blur_px
from filter_service.planning.nodes import (
    CachePlan,
    PlanPrediction,
    RaggedNodes,
)
from filter_service.planning.paper_grid import paper_axes, paper_defocus
from filter_service.planning.readable import (
    PlanAxes,
    check_central_defocus,
    joined_ranges,
    readable_defocus,
    usable_pupils_mm,
    used_accommodations_dpt,
)
from filter_service.planning.sampled_use import (
    AXES,
    Use,
    axis_error,
    defocus_error,
    sample_use,
)
from filter_service.planning.slopes import main_foci_dpt
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


def plan_cache(eye: EyeOptics, spec: GridSpec) -> CachePlan:
    """Nodes over field, pupil, accommodation and defocus that frames can read.

    Raises
    ------
    ProfileError
        The eye is out of focus as no eye is.
    GridTooLarge
        One place, pupil and accommodation alone would need too many PSFs.
    PlanTooLarge
        The kernels would exceed ``spec.memory_budget_mb``; the message proposes what
        to change.
    """
    plan = unchecked_plan(eye, spec)
    if plan.prediction.memory_mb > spec.memory_budget_mb:
        raise PlanTooLarge(spec, plan.prediction, _advice(eye, spec))
    return plan


def unchecked_plan(
    eye: EyeOptics,
    spec: GridSpec,
    *,
    target_db: float | None = None,
    predict: bool = True,
) -> CachePlan:
    """Plan like `plan_cache`, however large.

    Parameters
    ----------
    target_db : float, optional
        What interpolation may cost; the spec's tolerance says where it is None.
    predict : bool
        Say what all of it would cost.
    """
    allowed_error = target_error(spec)
    if target_db is not None:
        allowed_error = 10.0 ** (-target_db / 10.0)
    check_central_defocus(eye, spec)
    use = sample_use(eye, spec, USE_SAMPLES)
    if spec.settings.grid == "paper":
        axes = PlanAxes(*paper_axes(eye, spec))
        defocus = paper_defocus(eye, spec, tuple(vars(axes).values()))
    elif spec.follows_field:
        axes, left = _field_axes(use, allowed_error)
        defocus = None
    else:
        axes = _central_axes(eye, spec)
        defocus = _central_defocus(eye, spec, axes)
    groups = groups_of(spec, axes)
    rays = GroupRays.of(eye, spec, groups)
    if defocus is None:
        defocus = defocus_nodes(
            *(eye, spec, groups, rays, readable_defocus(eye, spec, axes)),
            allowed_error=left,
        )
    plan = CachePlan(
        **vars(axes),
        defocus=defocus.nodes,
        channel_shift_dpt=defocus.channel_shift_dpt,
        prediction=None,
        is_limited=defocus.is_limited,
        blur_px=node_blur_px(
            *(eye, spec, rays, defocus.nodes),
            *(defocus.channel_shift_dpt, defocus.shrink_ratio),
        ),
        shrink_ratio=defocus.shrink_ratio,
    )
    if not predict:
        return plan
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


def _central_axes(eye: EyeOptics, spec: GridSpec) -> PlanAxes:
    return PlanAxes(
        h_deg=np.zeros(1),
        v_deg=np.zeros(1),
        pupils_mm=pupil_nodes_mm(usable_pupils_mm(eye, spec)),
        accommodations_dpt=eye.accommodation_nodes_dpt(
            spec.settings.focus_range_dpt, pupil_range_mm=usable_pupils_mm(eye, spec)
        ),
    )


def _field_axes(use: Use, allowed_error: float) -> tuple[PlanAxes, float]:
    """Nodes but those of defocus, and the mean square error left to defocus.

    Axes with few nodes meet their share with some to spare; it goes to the others.
    """
    eye, spec = use.eye, use.spec
    ranges = {
        "accommodation": used_accommodations_dpt(eye, spec),
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


def _central_defocus(eye: EyeOptics, spec: GridSpec, axes: PlanAxes) -> DefocusNodes:
    """Nodes on axis: by blur radius alone, far closer than any tolerance asks for.

    One distance seen in one state needs no more than the exact PSF of each channel.
    """
    found = readable_defocus(eye, spec, axes)
    pupils_mm = np.repeat(axes.pupils_mm, len(axes.accommodations_dpt))
    exact_dpt = joined_ranges(found.beside_shift_dpt)
    is_exact = np.array([np.ptp(ranges_dpt) < EXACT_DPT for ranges_dpt in exact_dpt])
    nodes = [
        own_dpt[:1, 0] if exact else _nodes_by_blur(eye, spec, pupil_mm, ranges_dpt)
        for exact, own_dpt, ranges_dpt, pupil_mm in zip(
            is_exact,
            exact_dpt,
            joined_ranges(found.of_any_channel_dpt),
            pupils_mm.tolist(),
            strict=True,
        )
    ]
    return DefocusNodes.unlimited(
        RaggedNodes.of(nodes), np.where(is_exact[:, None], found.shift_dpt, 0.0)
    )


def _nodes_by_blur(
    eye: EyeOptics, spec: GridSpec, pupil_mm: float, ranges_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Nodes over ranges (n, 2) of total defocus."""
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
