"""Nodes of total defocus and their blur in C, against the formulas."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from filter_service.planning.defocus_nodes import (
    _SAMPLES,
    GroupRays,
    _Rays,
    _spread,
    node_blur_px,
)
from filter_service.planning.node_wavefronts import WEIGHTS
from filter_service.planning.nodes import RaggedNodes
from filter_service.planning.state_samples import half_way_error, mean_square
from filter_service.planning.state_samples import spot_covariance as covariance
from tests.reference import defocus_nodes as reference

N_GROUPS = 4


def random_rays(rng, n_foci):
    zero_px, per_dpt = rng.normal(0.0, 3.0, (2, N_GROUPS, WEIGHTS.size, 2))
    at_zero, at_one, spread = map(covariance, (zero_px, zero_px + per_dpt, per_dpt))
    polynomials = np.zeros((N_GROUPS, 4, 3))
    polynomials[:, :3] = np.stack([at_zero, at_one - at_zero - spread, spread], -1)
    polynomials[:, 3, 0] = mean_square(per_dpt)
    return _Rays(
        zero_px,
        per_dpt,
        polynomials,
        rng.uniform(0.1, 2.0, N_GROUPS),
        half_way_error("defocus", 1e-8),
        np.append(0.0, rng.uniform(1.0, 3.0, n_foci - 1)),
        rng.uniform(0.1, 1.0, (n_foci, N_GROUPS)),
        np.zeros(N_GROUPS),
    )


@pytest.mark.parametrize(("n_foci", "n_shifts"), [(1, 1), (2, 3)])
def test_nodes_are_those_of_the_law(rng, n_foci, n_shifts):
    """The loop in C ends its iteration sooner."""
    rays = random_rays(rng, n_foci)
    groups = np.array([2, 0, 0, 3])
    lows, highs = np.array([[-3.0, -1.0], [0.5, 0.5], [1.0, 4.0], [-2.0, 7.0]]).T
    shifts_dpt = rng.normal(0.0, 0.4, (n_shifts, groups.size))
    needed = rays._needed_intervals(groups, lows, highs, shifts_dpt)
    for k, group in enumerate(groups):
        expected = reference.needed_intervals(
            rays, group, lows[k], highs[k], shifts_dpt[:, k], _SAMPLES
        )
        np.testing.assert_allclose(needed[k], expected, rtol=1e-4, atol=1e-12)
    nodes, sizes = _spread(lows, highs, needed)
    parts = np.split(nodes, np.cumsum(sizes)[:-1])
    assert [part.size for part in parts][1] == 1
    for k in (0, 2, 3):
        expected_dpt = reference.spread_nodes(lows[k], highs[k], needed[k])
        assert expected_dpt.size > 2
        np.testing.assert_allclose(parts[k], expected_dpt, atol=1e-12)


@given(
    low_dpt=st.floats(-20.0, 20.0),
    width_dpt=st.floats(0.0, 30.0),
    steps=st.lists(st.floats(0.0, 5.0), min_size=_SAMPLES - 1, max_size=_SAMPLES - 1),
)
def test_nodes_ascend_from_end_to_end(low_dpt, width_dpt, steps):
    needed = np.append(0.0, np.cumsum(steps))
    high_dpt = low_dpt + width_dpt
    nodes, sizes = _spread(np.array([low_dpt]), np.array([high_dpt]), needed[None])
    assert sizes == [nodes.size]
    assert nodes[0] == low_dpt
    assert (np.diff(nodes) > 0.0).all()
    if width_dpt >= 1e-9:
        assert nodes[-1] == high_dpt


class Foci:
    """A lens with as many foci as a wavelength asks for."""

    def main_dpt(self, nm):
        return np.arange(round(nm / 200.0)) - 0.5


@pytest.mark.parametrize("rings", [None, Foci()])
@pytest.mark.parametrize("n_rays", [1, 4, 7])
def test_blur_is_that_of_the_farthest_ray(rng, n_rays, rings):
    groups = [np.sort(rng.uniform(-4.0, 4.0, count)) for count in (1, 5, 2)]
    rays = GroupRays(*rng.normal(0.0, 3.0, (2, len(groups), n_rays, 2)))
    shift_dpt = rng.normal(0.0, 0.3, (len(groups), 3))
    shrink_ratio = np.array([1.0, 0.5, 1.0])
    nm = np.array([420.0, 600.0, 640.0])
    found_px = node_blur_px(
        SimpleNamespace(rings=rings),
        SimpleNamespace(channel_wavelengths_nm=nm),
        rays,
        RaggedNodes.of(groups),
        shift_dpt,
        shrink_ratio,
    )
    expected_px = [
        shrink_ratio[group]
        * reference.node_blur_px(
            rays.zero_px[group],
            rays.per_dpt[group],
            node_dpt + shift_dpt[group, channel],
            np.zeros(1) if rings is None else rings.main_dpt(nm[channel]),
        )
        for group, nodes_dpt in enumerate(groups)
        for node_dpt in nodes_dpt
        for channel in range(3)
    ]
    np.testing.assert_allclose(found_px, expected_px, rtol=1e-6)
