"""The part of a plan that some of its frames read: a stream needs little at a time.

All parts have the nodes of the whole, so that a frame is the same through any of them,
and PSFs once computed serve again.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.planning.cost import predicted_cost
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan, RaggedNodes
from filter_service.planning.plan import PlanAxes, readable_ranges_dpt, usable_pupils_mm

Part = tuple[CachePlan, NDArray[np.int64]]


def part_of_plan(whole: CachePlan, eye: EyeOptics, spec: GridSpec) -> Part:
    """Return the nodes that frames within a spec's ranges read, and their numbers (n,).

    Parameters
    ----------
    whole : CachePlan
        For ranges that hold those of the spec, with the same camera.
    """
    pupil_range_mm = usable_pupils_mm(eye, spec)
    used_dpt = eye.accommodation_range_dpt(
        spec.settings.focus_range_dpt, pupil_range_mm=pupil_range_mm
    )
    pupils = _around(whole.pupils_mm, *pupil_range_mm)
    states = _around(whole.accommodations_dpt, *used_dpt)
    axes = PlanAxes(
        whole.h_deg,
        whole.v_deg,
        whole.pupils_mm[pupils],
        whole.accommodations_dpt[states],
    )
    numbers = np.arange(len(whole.defocus.starts) - 1).reshape(whole.group_shape)
    groups = numbers[:, :, pupils, states].ravel()
    ranges_dpt = readable_ranges_dpt(eye, spec, axes).reshape(-1, 2)
    kept = [
        start + np.arange(nodes.size)[_around(nodes, *range_dpt)]
        for start, nodes, range_dpt in zip(
            whole.defocus.starts[groups].tolist(),
            _groups_of(whole, groups),
            ranges_dpt.tolist(),
            strict=True,
        )
    ]
    shrink_ratio = whole.shrink_ratio
    plan = CachePlan(
        **vars(axes),
        defocus=RaggedNodes.of([whole.defocus.values_dpt[own] for own in kept]),
        channel_shift_dpt=whole.channel_shift_dpt[groups],
        prediction=whole.prediction,
        is_limited=whole.is_limited[groups],
        shrink_ratio=None if shrink_ratio is None else shrink_ratio[groups],
    )
    cost = predicted_cost(eye, spec, plan)
    prediction = replace(whole.prediction, **cost)
    return replace(plan, prediction=prediction), np.concatenate(kept)


def _groups_of(plan: CachePlan, groups: NDArray[np.int64]) -> list[NDArray]:
    starts, values = plan.defocus.starts, plan.defocus.values_dpt
    return [values[starts[g] : starts[g + 1]] for g in groups.tolist()]


def _around(nodes: NDArray[np.float64], low: float, high: float) -> slice:
    """Nodes from the last at or below a range to the first at or above it."""
    margin = 1e-9
    first = max(int(np.searchsorted(nodes, low + margin, side="right")) - 1, 0)
    last = int(np.searchsorted(nodes, high - margin, side="left"))
    return slice(first, max(min(last, nodes.size - 1), first) + 1)
