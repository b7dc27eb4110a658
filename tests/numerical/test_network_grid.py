"""Grids by network: with a perfect network they are the traced ones, or are refused.

The network here traces each row that it is given, so what is tested is everything
around it: columns, axes, pupils, focus, checks.
"""

from dataclasses import fields, replace

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.eye.parameters import RetinaShape
from estimator.field import grid_source
from estimator.field.aberration_grid import aberration_grid
from estimator.field.grid_source import GridSource, network_pays
from estimator.field.network_grid import network_focused, network_grid
from estimator.field.traced_eye import TracedEye
from estimator.networks.card import NetworkUnfit, OutOfDomain
from estimator.profiles.parse import parse_profile
from tests.numerical.traced_networks import (
    TracedNetwork,
    put_in_place,
    trace_aberrations,
    trace_focus,
)

AXES = {
    "pupil_diameters_mm": (3.0, 5.0),
    "wavelengths_nm": (464.0, 612.0),
    "h_deg": (-20.0, 0.0, 30.0),
    "v_deg": (-15.0, 10.0),
}


@pytest.fixture(scope="module")
def eye():
    body = {"kind": "prescription", "sphere_dpt": -1.0, "cylinder_dpt": -1.0}
    return estimate_eye(
        parse_profile(body | {"axis_deg": 30, "higher_order": "none"}),
        starts=("table",),
    )


def aberration(**more):
    return TracedNetwork("aberration", trace_aberrations, **more)


def focus(**more):
    return TracedNetwork("focus", trace_focus, **more)


def test_a_perfect_network_fills_the_traced_grid(monkeypatch, eye):
    put_in_place(monkeypatch, aberration())
    used_dpt = np.array([0.0, 1.5, 4.0])
    traced = aberration_grid(eye, accommodations_dpt=used_dpt, **AXES)
    states = eye.accommodating.states_at(used_dpt)
    found = network_grid(eye, states, accommodations_dpt=used_dpt, **AXES)
    assert found.grid.zernike_um.shape == (3, 2, 2, 3, 2, 28)
    # the network knows the plane at the cornea, and what is carried from there to the
    # pupil has lost what its sixth order did not hold
    tolerance = {"zernike_um": 0.03, "zernike_radius_mm": 0.01, "ellipse_mm": 0.01}
    for name in (field.name for field in fields(traced)):
        ours, theirs = getattr(found.grid, name), getattr(traced, name)
        if name == "rms_residual_um":
            assert np.isnan(ours).all() and ours.shape == theirs.shape
        elif name == "ellipse_mm":  # the axis of a circle is any
            np.testing.assert_allclose(
                ours[..., :4], theirs[..., :4], rtol=0, atol=tolerance[name]
            )
        else:
            np.testing.assert_allclose(
                ours, theirs, rtol=0, atol=tolerance.get(name, 1e-7), err_msg=name
            )
    assert found.n_checked == 8
    assert found.checked_error_um < 3e-3


def test_a_perfect_network_focuses_as_tracing_does(monkeypatch, eye):
    put_in_place(monkeypatch, focus())
    used_dpt = np.array([0.0, 0.7, 3.0, 6.0])
    exact = eye.accommodating.states_at(used_dpt)
    found = network_focused(eye, used_dpt)
    for ours, theirs in zip(found, exact, strict=True):
        np.testing.assert_allclose(
            ours.parameters.to_vector(), theirs.parameters.to_vector(), atol=1e-6
        )
        assert ours.focus_dpt == pytest.approx(theirs.focus_dpt)
    assert found[0].lens_diameter_change_mm == 0.0
    source = GridSource(focus="network")
    for used, asked in (([0.0, 3.0], True), ([0.0], False)):
        source(eye, accommodations_dpt=used, pupil_diameters_mm=4, wavelengths_nm=549)
        assert source.focus_by_network == asked


def test_through_a_worn_correction_the_bare_eye_is_focused(monkeypatch):
    body = {"kind": "prescription", "sphere_dpt": -4.0, "higher_order": "none"}
    worn = estimate_eye(
        parse_profile(body | {"correction": {"sphere_dpt": -4.0}}), starts=("table",)
    )
    put_in_place(monkeypatch, focus())
    (ours,) = network_focused(worn, [2.0])
    (exact,) = worn.accommodating.states_at([2.0])
    assert ours.lens_diameter_change_mm < -0.05
    assert ours.lens_diameter_change_mm == pytest.approx(
        exact.lens_diameter_change_mm, abs=1e-6
    )


def traced_eye(eye, source):
    return TracedEye.trace(
        eye,
        pupil_diameters_mm=(3.0, 5.0),
        focus_range_dpt=(0.0, 3.0),
        wavelengths_nm=(549.0,),
        field_range_deg=((-15.0, 15.0), (0.0, 10.0)),
        make_grid=source,
    )


def test_an_eye_from_networks_answers_as_the_traced_one(monkeypatch, eye):
    put_in_place(monkeypatch, aberration(p95_um=0.01), focus())
    source = GridSource(aberrations="network", focus="network")
    by_network = traced_eye(eye, source)
    assert [use.by_network for use in source.uses] == [True, True]
    assert source.focus_by_network
    assert source.uses[1].is_field and source.uses[1].n_checked == 8
    state = {
        **{"h_deg": 9.0, "v_deg": 4.0, "pupil_diameter_mm": 4.2},
        **{"accommodation_dpt": 1.3, "wavelength_nm": 549.0, "total_defocus_dpt": 0.5},
    }
    ours = by_network.wavefronts(**state)
    exact = traced_eye(eye, GridSource()).wavefronts(**state)
    np.testing.assert_allclose(ours.zernike_um, exact.zernike_um, atol=2e-3)
    np.testing.assert_allclose(ours.pupil_ellipse, exact.pupil_ellipse, atol=2e-3)


def test_an_input_out_of_range_is_traced_with_the_reason(monkeypatch, eye):
    ranges = {"h_deg": (-10.0, 10.0)}
    put_in_place(
        monkeypatch,
        aberration(ranges=ranges),
        focus(ranges={"focus_dpt": (-1, 1)}),
    )
    states = eye.accommodating.states_at([0.0])
    with pytest.raises(OutOfDomain, match=r"h_deg 30 \(trained for -10 to 10\)"):
        network_grid(eye, states, accommodations_dpt=[0.0], **AXES)
    source = GridSource(aberrations="network", focus="network")
    found = traced_eye(eye, source)
    axis, field = source.uses
    assert axis.by_network and not axis.reason
    assert not field.by_network and "h_deg" in field.reason
    assert not source.focus_by_network and "focus_dpt" in source.focus_reason
    assert found.traced_range_deg == ((-15.0, 15.0), (0.0, 10.0))


def test_a_network_far_off_in_this_eye_is_found_out(monkeypatch, eye):
    put_in_place(monkeypatch, aberration(p95_um=0.05, offset_um=0.2))
    states = eye.accommodating.states_at([0.0])
    with pytest.raises(NetworkUnfit, match=r"error of 0\.\d+ um at the corners"):
        network_grid(eye, states, accommodations_dpt=[0.0], **AXES)
    put_in_place(monkeypatch, aberration(p95_um=0.05, offset_um=0.02))
    found = network_grid(eye, states, accommodations_dpt=[0.0], **AXES)
    # an error in all terms at once is steep, and grows on the way to the pupil
    assert 0.02 <= found.checked_error_um < 0.04


def test_a_pupil_that_is_cut_off_is_traced(monkeypatch):
    put_in_place(monkeypatch, aberration(p95_um=1.0))
    cone = {"kind": "preset", "name": "keratoconus"}
    eye = estimate_eye(parse_profile(cone), starts=("table",))
    states = eye.accommodating.states_at([0.0])
    wide = AXES | {"h_deg": (-72.0, 72.0), "pupil_diameters_mm": (8.0,)}
    with pytest.raises(NetworkUnfit, match="passes only a part of the 8 mm pupil"):
        network_grid(eye, states, accommodations_dpt=[0.0], **wide)


def test_an_eye_with_a_retina_of_its_own_is_traced(monkeypatch, eye):
    put_in_place(monkeypatch, aberration(), focus())
    profile = replace(eye.profile, retina=RetinaShape(12.0, -0.2))
    other = replace(eye, profile=profile)
    source = GridSource(aberrations="network", focus="network")
    traced_eye(other, source)
    assert not any(use.by_network for use in source.uses)
    assert "retina" in source.uses[0].reason and "retina" in source.focus_reason


def test_a_network_pays_for_many_nodes_and_few_weights(monkeypatch):
    monkeypatch.setattr(grid_source, "relative_core_time", lambda: 1.0)
    monkeypatch.setattr(grid_source, "thread_count", lambda: 2)
    assert network_pays(5000, n_rays=70, n_weights=100_000)
    assert not network_pays(20, n_rays=70, n_weights=100_000)
    assert not network_pays(5000, n_rays=70, n_weights=10**8)
    few = [network_pays(500, n_rays=n, n_weights=100_000) for n in (70, 192)]
    assert few == [False, True]
    monkeypatch.setattr(grid_source, "thread_count", lambda: 16)
    assert not network_pays(500, n_rays=192, n_weights=100_000), "tracing is fast here"
    monkeypatch.setattr(grid_source, "relative_core_time", lambda: 10.0)
    assert network_pays(500, n_rays=192, n_weights=100_000)


def test_cheaper_traces_few_nodes_and_asks_the_network_for_many(monkeypatch, eye):
    put_in_place(monkeypatch, aberration(p95_um=0.01))
    monkeypatch.setattr(
        "estimator.field.grid_source.network_pays",
        lambda n_nodes, **sizes: n_nodes > 50,
    )
    source = GridSource(aberrations="cheaper")
    traced_eye(eye, source)
    assert [(use.is_field, use.by_network) for use in source.uses] == [
        (False, False),
        (True, True),
    ]
    assert not any(use.reason for use in source.uses)
    # one that would be seen does not count as cheap, though it is within its card
    put_in_place(monkeypatch, aberration(p95_um=0.1, offset_um=0.08))
    for aberrations, by_network in (("cheaper", False), ("network", True)):
        source = GridSource(aberrations=aberrations)
        traced_eye(eye, source)
        assert source.uses[1].by_network == by_network
        assert ("error of 0." in source.uses[1].reason) != by_network
