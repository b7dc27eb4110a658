"""Where the layers of a frame are, against the formulas."""

import importlib

import numpy as np
import pytest

from filter_service.constants import RGB
from filter_service.native import loops
from filter_service.planning.nodes import PlanNodes, RaggedNodes
from filter_service.psfs.pack import StateReads, StoreTables, layer_blur_px
from tests.reference import layers as reference

module = importlib.import_module("filter_service.psfs.frame_layers")


def test_steps_are_those_of_the_blur_that_changes_most(rng):
    """Where blur hardly changes, the gap to the next layer decides."""
    n_groups, n_nodes = 2, 12
    values_dpt = np.sort(rng.uniform(-6.0, 6.0, (n_groups, n_nodes)), axis=1)
    blur_px = 3.0 + rng.uniform(0.0, 0.02, (n_groups, n_nodes, RGB))
    blur_px[:, n_nodes // 2 :] += rng.uniform(0.0, 20.0, (n_groups, n_nodes // 2, RGB))
    nodes = PlanNodes(
        RaggedNodes.of(list(values_dpt)),
        np.zeros((n_groups, RGB)),
        blur_px.ravel().astype(np.float32),
        *(3 * [np.zeros(0)]),
    )
    tables = StoreTables.empty().grown(nodes)
    reads = StateReads(np.zeros(1, np.int64), np.ones(1), np.ones(1))
    zero_dpt = rng.uniform(-1.0, 1.0, (n_groups, RGB))
    at_dpt = np.arange(-8.0, 8.0, 0.25)
    found = np.empty((4, at_dpt.size))
    loops().call(
        "step_curve",
        *(tables.record(), reads.record(), zero_dpt, at_dpt, found),
        *(n_groups, at_dpt.size, 0.1, 0.25, 0.2, 1.0, 0.25),
    )
    of_layers_px = np.stack(
        [
            np.interp(at_dpt + zero_dpt[group, c], values_dpt[group], blur[:, c])
            for group, blur in enumerate(blur_px)
            for c in range(RGB)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(
        layer_blur_px(tables, reads, zero_dpt, at_dpt), of_layers_px.T, rtol=1e-6
    )
    expected = reference.step_curve(
        of_layers_px, at_dpt, blur_ratio=0.1, px_per_dpt=1.0
    )
    steps = np.diff(expected)
    assert (steps > 0.5).any() and (steps < 0.45).any()
    np.testing.assert_allclose(found[0], expected, rtol=1e-5)


@pytest.mark.parametrize("n_corners", [1, 3])
@pytest.mark.parametrize(
    ("range_dpt", "ends_dpt"),
    [
        ((-2.0, 3.0), [0.3, -0.7, 0.3, 9.0]),
        ((1.0, 1.1), [1.0]),
        ((-30.0, 1.0), []),  # beyond the curves
        ((2.0, 2.0), [2.0]),
    ],
)
def test_layers_are_at_whole_steps_and_ends(rng, n_corners, range_dpt, ends_dpt):
    curves = step_curves(rng, n_corners)
    reads = StateReads(
        np.zeros(n_corners, np.int64),
        rng.uniform(0.8, 1.2, n_corners),
        rng.dirichlet(np.ones(n_corners)),
    )
    in_focus_dpt = np.array([-0.4, 0.9])
    found_dpt = module._layer_distances_dpt(
        curves, reads, 0.4, range_dpt, np.array(ends_dpt), in_focus_dpt, 0.7
    )
    expected_dpt = (
        reference.layer_distances_dpt(
            lambda at_dpt: steps_at(curves, reads, at_dpt, zero_dpt=0.4, pace=0.7),
            *(range_dpt, ends_dpt, in_focus_dpt),
        )
        if range_dpt[0] < range_dpt[1]
        else range_dpt[:1]
    )
    np.testing.assert_allclose(found_dpt, expected_dpt, rtol=1e-12, atol=1e-12)


def step_curves(rng, n_corners):
    return [
        np.stack(
            [
                np.linspace(-8.0, 8.0, 60 + k),
                np.cumsum(rng.uniform(0.1, 0.9, 60 + k)) - 13.0,
            ]
        )
        for k in range(n_corners)
    ]


def steps_at(curves, reads, at_dpt, *, zero_dpt, pace):
    total = np.zeros(at_dpt.size)
    for (known_dpt, steps), scale, weight in zip(
        curves, reads.scales, reads.weights, strict=True
    ):
        t = (at_dpt + zero_dpt) * scale
        beyond_dpt = np.minimum(t - known_dpt[0], 0.0)
        slope = (steps[1] - steps[0]) / (known_dpt[1] - known_dpt[0])
        total += weight * (np.interp(t, known_dpt, steps) + beyond_dpt * slope)
    return total / pace


def test_layers_move_continuously_with_the_state(rng):
    """What is interpolated between the layers changes by little for a small step.

    The walk passes the corner of a triangle of nodes, where their weights change, foci
    that enter and leave the range, and a range that grows.
    """
    curves = step_curves(rng, 3)
    vergences_dpt = np.linspace(-1.9, 2.9, 500)
    found, counts = [], set()
    for k in range(801):
        part = k / 800
        weights = np.array([1.0 - part, max(part - 0.5, 0.0), min(part, 0.5)])
        reads = StateReads(np.zeros(3, np.int64), 1.0 + 0.1 * part * weights, weights)
        layer_dpt = module._layer_distances_dpt(
            curves,
            reads,
            0.4 + 2.0 * part,
            (-2.0 - 0.3 * part, 3.0),
            np.array([0.4, 0.8]),
            np.array([-2.3 + part, 2.9 + part]),
            0.7,
        )
        counts.add(layer_dpt.size)
        # A parabola shows the distances: with equal parts, it changes by 0.04 or more.
        found.append(np.interp(vergences_dpt, layer_dpt, layer_dpt**2))
    assert len(counts) > 1
    assert np.abs(np.diff(found, axis=0)).max() < 0.01
