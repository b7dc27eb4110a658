"""The network benchmark's own parts: nodes, references, errors, domains.

Networks here trace each row, see `traced_networks`: their answers are perfect, or off
by a known amount, whatever weights there are.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.eye.assembly import eye_surfaces
from estimator.eye.parameters import EyeParameters, mean_vector
from estimator.networks.inference import WeightsMissing
from estimator.profiles.parse import parse_profile
from estimator.wavefront.aberrations import wavefront_grid
from tests.benchmarks import bench_networks, network_nodes
from tests.benchmarks.harness import Run
from tests.benchmarks.paper_page.published import table
from tests.numerical.traced_networks import (
    TracedNetwork,
    put_in_place,
    trace_aberrations,
    trace_focus,
)

pytestmark = pytest.mark.tools

OFF_UM = 0.1
FOCUSES_DPT = np.array([0.125, 4.125])
PUPILS_MM = np.array([3.0, 5.0])


@pytest.fixture(scope="module")
def vector():
    """Give a myope of 1.5 dpt on average."""
    body = {"kind": "prescription", "sphere_dpt": -1.0, "cylinder_dpt": -1.0}
    profile = parse_profile(body | {"axis_deg": 30, "higher_order": "none"})
    return estimate_eye(profile, starts=("table",)).parameters.to_vector()


@pytest.fixture
def few_nodes(monkeypatch):
    """Cut the axes, and with them the time: 4 foci, 12 nodes on the axis, 4 off it."""
    for name, values in (
        ("PUPILS_MM", PUPILS_MM),
        ("FOCUSES_DPT", FOCUSES_DPT),
        ("H_DEG", np.array([-45.0, 20.0])),
        ("V_DEG", np.array([-10.0, 25.0])),
    ):
        monkeypatch.setattr(network_nodes, name, values)


def test_steps_have_the_nodes_of_the_paper():
    vector = mean_vector()
    counts = {step: len(make(vector)) for step, make in network_nodes.NODES.items()}
    assert counts == {"focus": 42, "on-axis": 126, "off-axis": 627}
    for make in network_nodes.NODES.values():
        nodes = make(vector)
        assert len(np.unique(nodes, axis=0)) == len(nodes)
    fields_deg = network_nodes.off_axis_nodes(vector)[:, -2:]
    assert np.abs(fields_deg).max(axis=0) == pytest.approx([45.0, 25.0])


def test_traced_nodes_are_those_of_a_grid_of_the_same_eye(vector):
    nodes = network_nodes.off_axis_nodes(vector)[::37]
    found = network_nodes.traced_aberrations(nodes)
    for row, zernike_um in zip(nodes, found.zernike_um, strict=True):
        grid = wavefront_grid(
            eye_surfaces(EyeParameters.from_vector(row[:45])),
            fields_deg=[row[-2:]],
            wavelengths_nm=[row[-3]],
            pupil_diameters_mm=[row[-4]],
        )
        np.testing.assert_allclose(
            zernike_um[1:], grid.zernike_um[0, 0, 0, 1:], 0, 1e-9
        )


def test_the_reference_of_focus_is_focused_or_out_of_reach(vector):
    nodes = network_nodes.focus_nodes(vector)
    changes_mm = network_nodes.reference_focus(nodes)
    reached_dpt = network_nodes.reached_dpt(nodes, changes_mm)
    is_relaxed = changes_mm[:, 0] == 0.0
    np.testing.assert_allclose(
        reached_dpt[~is_relaxed], nodes[~is_relaxed, -1], 0, 1e-8
    )
    # its far point is at 1.5 dpt: beyond it lie two of the seven distances
    assert is_relaxed.sum() == 2 * 6
    assert np.all(reached_dpt[is_relaxed] >= nodes[is_relaxed, -1])
    np.testing.assert_allclose(network_nodes.traced_focus(nodes), changes_mm, 0, 1e-7)


def aberration(**more):
    return TracedNetwork("aberration", trace_aberrations, **more)


@pytest.mark.parametrize("step", ["on-axis", "off-axis"])
def test_errors_of_wavefronts_are_the_networks_own(
    monkeypatch, few_nodes, vector, step
):
    for offset_um in (0.0, OFF_UM):
        put_in_place(monkeypatch, aberration(offset_um=offset_um))
        rows = bench_networks.aberration_rows(step, "myopia", vector, repeats=2)
        found = {row.method: row for row in rows}
        assert found["network"].n_nodes == found["exact"].n_nodes == 12
        assert found["network"].error == pytest.approx(offset_um, abs=1e-6)
        assert found["exact"].error < 1e-6 < found["fewer rays"].error * 1e3
        assert found["exact"].error < found["fewer rays"].error < 1e-2
        assert found["exact"].target > 0.05


def test_errors_of_focus_are_the_networks_own(monkeypatch, few_nodes, vector):
    found = {}
    for offset_mm in (0.0, -0.01):
        put_in_place(
            monkeypatch, TracedNetwork("focus", trace_focus, offset_um=offset_mm)
        )
        rows = bench_networks.focus_rows("myopia", vector, repeats=2, with_search=False)
        for row in rows:
            found[row.method, row.error_name, offset_mm] = row.error
    assert found["network", "mean_abs_mm", 0.0] < 1e-6
    assert found["network", "mean_abs_dpt", 0.0] < 1e-5
    assert found["exact", "mean_abs_dpt", 0.0] < 1e-6
    # A wrong diameter also changes the conic constant that the network is given.
    assert found["network", "mean_abs_mm", -0.01] == pytest.approx(0.01, rel=0.01)
    (nearer,) = np.flatnonzero(PUPILS_MM == 5.0) * 2 + 1
    nodes = network_nodes.focus_nodes(vector)[[nearer]]
    change_mm = network_nodes.reference_focus(nodes)
    gain_dpt = nodes[0, -1] - network_nodes.reached_dpt(nodes, np.zeros((1, 2)))[0]
    dpt_per_mm = gain_dpt / -change_mm[0, 0]
    assert found["network", "mean_abs_dpt", -0.01] == pytest.approx(
        0.01 * dpt_per_mm, rel=0.15
    )


def test_nodes_outside_of_the_training_are_counted(monkeypatch, few_nodes, vector):
    put_in_place(monkeypatch, aberration(ranges={"h_deg": (-30.0, 30.0)}))
    some, *_ = bench_networks.aberration_rows("off-axis", "myopia", vector, repeats=2)
    assert (some.n_nodes, some.n_outside, some.error_name) == (6, 6, "mean_abs_um")
    assert "h_deg -45" in some.setting
    assert some.error < 1e-6
    put_in_place(monkeypatch, aberration(ranges={"eye_length_mm": (30.0, 31.0)}))
    none, *_ = bench_networks.aberration_rows("off-axis", "myopia", vector, repeats=2)
    assert (none.n_nodes, none.error_name, none.error) == (0, "n_outside", 12.0)
    assert none.median_ms == 0.0
    assert "eye_length_mm" in none.setting


def test_our_conditions_are_theirs_by_their_mean_target():
    for case in ("emmetropia", "myopia", "astigmatism", "post_lasik"):
        theirs = table(5)["eye"]["target"][case]
        zernike_um = parse_profile({"kind": "preset", "name": case}).zernike_um
        assert np.abs(zernike_um[1:]).mean() == pytest.approx(theirs, abs=1e-3), case


def test_a_refinement_that_ends_badly_or_not_at_all_has_failed():
    eyes = [
        SimpleNamespace(mean_abs_error_um=error_um, time_ms=8.0)
        for error_um in (1e-5, 2e-5, 0.02)
    ]
    rows = bench_networks.refined_rows("all", ("table", "network"), [*eyes, None])
    assert {row.n for row in rows} == {4}
    assert {row.setting for row in rows} == {"from table or network"}
    errors = {row.error_name: row.error for row in rows}
    assert (errors["median_um"], errors["failed"]) == (2e-5, 2)


def test_without_weights_the_bench_says_what_to_do(monkeypatch):
    def missing(name):
        raise WeightsMissing(f"weights of {name} are missing")

    monkeypatch.setattr(bench_networks, "load_network", missing)
    with pytest.raises(SystemExit, match="weights of eye are missing"):
        bench_networks.measure(Run(is_quick=True))
