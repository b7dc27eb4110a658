"""What a frame plans, against the plain statement of it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from filter_service.constants import MAX_LEVEL, RECIPE_TAPS, RGB
from filter_service.native import loops, records
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.pack import PackedKernels, box_sizes, layer_blur_px
from filter_service.psfs.store import PsfStore
from filter_service.rendering import frame_kernels
from filter_service.rendering.image_cells import CellMaps, image_cells
from filter_service.view_state import State
from tests.numerical import plan_twin
from tests.numerical.plan_cases import spec_for, traced_eye

RTOL = 1e-12
"""Sums of up to eight numbers in another order."""

FIELD = {"mode": "dynamic", "tolerance": "loose", "object_range_dpt": (0.0, 4.0)}
MOVING = {"pupil_range_mm": (3.0, 5.0), "focus_range_dpt": (0.0, 6.0)}
BREATHING = {"pupil_range_mm": (4.0, 4.4), "focus_range_dpt": (0.0, 0.5)}
STILL = {"pupil_range_mm": (4.0, 4.0), "focus_range_dpt": (1.0, 1.0)}
AXIS = {"mode": "on-axis", "object_range_dpt": (0.0, 4.0)}


@cache
def store_for(name, model="traced", **settings):
    """A store with a real plan and made-up kernels, of which no plan reads a texel."""
    spec = spec_for(320, 180, **settings)
    profile = parse_profile({"kind": "preset", "name": name})
    measured = MeasuredWavefront.from_profile(profile)
    eye = traced_eye(name, spec) if model == "traced" else measured
    plan = unchecked_plan(eye, spec)
    count = RGB * plan.nodes.defocus.values_dpt.size
    rng = np.random.default_rng(count)
    node_px = np.abs(np.repeat(plan.nodes.defocus.values_dpt, RGB)) * 4.0
    packed = PackedKernels(
        weights=np.zeros(1, np.uint16),
        offsets=np.cumsum(rng.integers(1, 900, count)),
        reach_px=rng.integers(0, 40, (count, 4)),
        radius_px=rng.integers(0, 60, count),
        spread_px=rng.uniform(0.3, 30.0, count),
        peak_ratio=rng.uniform(1e-4, 1.0, count),
        lost_energy_ratio=np.zeros(count),
    )
    blur_px = (node_px + rng.random(count)).astype(np.float32)
    plan = replace(plan, nodes=replace(plan.nodes, blur_px=blur_px))
    return PsfStore.of_kernels(eye, spec, plan, packed)


CASES = {
    # name: store's settings, pupil, focus, share of used pairs, gaze
    "between all nodes": (("keratoconus", FIELD | MOVING), 3.7, 1.3, 0.3, None),
    "pupil on a node": (("keratoconus", FIELD | MOVING), 5.0, 1.3, 0.3, None),
    "lowest end": (("keratoconus", FIELD | MOVING), 3.0, 0.0, 0.3, None),
    "highest end": (("emmetropia", FIELD | MOVING), 9.0, 6.0, 0.3, None),
    "several accommodations": (("emmetropia", FIELD | MOVING), 3.2, 1.3, 0.3, None),
    "accommodation on a node": (("emmetropia", FIELD | MOVING), 3.7, 0.0, 0.3, None),
    "beside single nodes": (("emmetropia", FIELD | BREATHING), 4.0, 0.5, 0.3, None),
    "two planes": (
        ("emmetropia", FIELD | BREATHING | {"object_planes_dpt": (0.0, 3.0)}),
        *(4.4, 0.2, 0.3, None),
    ),
    "gaze turned": (
        ("emmetropia", FIELD | STILL | {"gaze_range_deg": (12.0, 6.0)}),
        *(4.0, 1.0, 0.3, (-12.0, 5.0)),
    ),
    "one used pair": (("emmetropia", FIELD | MOVING), 3.2, 1.3, 0.0, None),
    "every pair": (("emmetropia", FIELD | MOVING), 3.2, 1.3, 1.0, None),
    "a single layer": (
        ("emmetropia", AXIS | STILL | {"object_range_dpt": (1.0, 1.0)}),
        *(4.0, 1.0, 1.0, None),
    ),
    "on axis": (("astigmatism", AXIS | MOVING), 3.7, 1.3, 0.5, None),
    "the paper's grid": (
        ("emmetropia", FIELD | STILL | {"grid": "paper"}),
        *(4.0, 1.0, 0.3, None),
    ),
}


@pytest.fixture(scope="module")
def stores():
    """Make the stores of all cases, some of which several cases share."""
    for (name, settings), *_ in CASES.values():
        store_for(name, **settings)


@pytest.fixture(params=CASES)
def case(request, rng, stores):
    """Store, layers, image cells and used pairs."""
    (name, settings), pupil_mm, focus_dpt, share, gaze_deg = CASES[request.param]
    store = store_for(name, **settings)
    state = {"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt}
    layers = frame_layers(store, State(**state))
    image = image_cells(store.spec, store.plan, gaze_deg)
    used = rng.random((image.count, frame_kernels.interval_count(layers))) < share
    used[image.count // 2, used.shape[1] // 2] = True
    return store, layers, image, used


def test_the_cases_read_one_two_and_three_neighbors(stores):
    found = set()
    for (name, settings), pupil_mm, focus_dpt, *_ in CASES.values():
        store = store_for(name, **settings)
        state = {"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt}
        found.add(frame_layers(store, State(**state)).reads.weights.size)
    assert found == {1, 2, 3}


def test_layers_are_those_of_the_plain_statement_or_as_close(case):
    store, layers, _, _ = case
    reads, zero_dpt = layers.reads, layers.layer_zero_dpt
    at_dpt = layers.layer_dpt
    np.testing.assert_allclose(
        layer_blur_px(store.tables, reads, zero_dpt, at_dpt).T,
        plan_twin.layer_blur_px(store, reads, zero_dpt, at_dpt),
        rtol=RTOL,
    )
    h_deg, v_deg = store.plan.field_nodes_deg
    gaze = np.argmin(np.hypot(h_deg, v_deg))
    ends_dpt = [
        store.eye.vergence.vergence_dpt(end) + change_dpt
        for range_dpt in store.spec.object_ranges_dpt
        for end, change_dpt in zip(range_dpt, layers.field.range_dpt, strict=True)
    ]
    expected_dpt = plan_twin.layer_distances_dpt(
        tuple(np.add(layers.vergence_range_dpt, layers.field.range_dpt)),
        ends_dpt=ends_dpt,
        in_focus_dpt=-zero_dpt[gaze],
        blur_radius_px=lambda d: plan_twin.layer_blur_px(store, reads, zero_dpt, d),
        blur_px_per_dpt=layers.blur_px_per_dpt,
        blur_ratio=0.1 if store.spec.settings.mode == "dynamic" else 0.05,
    )
    assert np.isin(expected_dpt[[0, -1]].round(9), at_dpt.round(9)).all()
    assert abs(len(at_dpt) - len(expected_dpt)) <= 1 + 0.06 * len(expected_dpt)
    assert largest_steps(store, layers) < max(
        1.1, 1.02 * largest_steps(store, replace(layers, layer_dpt=expected_dpt))
    )
    blur_px = plan_twin.layer_blur_px(store, reads, zero_dpt, at_dpt).max(axis=1)
    np.testing.assert_allclose(layers.layer_blur_px, blur_px, rtol=RTOL)
    assert reads.weights.sum() == pytest.approx(1.0, rel=RTOL)
    assert (reads.weights > 0.0).all()


def largest_steps(store, layers):
    """Largest number of blur steps between layers, of any node and channel."""
    ratio = 0.1 if store.spec.settings.mode == "dynamic" else 0.05
    blur_px = plan_twin.layer_blur_px(
        store, layers.reads, layers.layer_zero_dpt, layers.layer_dpt
    )
    least_px = np.minimum(blur_px[:-1], blur_px[1:])
    steps = np.abs(np.diff(blur_px, axis=0)) / np.maximum(ratio * least_px, 0.25)
    return steps.max(initial=0.0)


def test_defocus_is_the_eyes(case, request):
    store, layers, _, _ = case
    eye, spec = store.eye, store.spec
    h_deg, v_deg = store.plan.field_nodes_deg
    state = {
        "pupil_diameter_mm": layers.state.pupil_diameter_mm,
        "accommodation_dpt": eye.accommodation_dpt(
            CASES[request.node.callspec.params["case"]][2],  # the focus asked for
            pupil_diameter_mm=layers.state.pupil_diameter_mm,
        ),
    }
    own_dpt = eye.total_defocus_dpt(
        h_deg=h_deg[:, None],
        v_deg=v_deg[:, None],
        wavelength_nm=spec.channel_wavelengths_nm,
        **state,
    )
    change_dpt = layers.field.at(h_deg, v_deg)[:, None]
    found_dpt = layers.layer_zero_dpt + change_dpt
    np.testing.assert_allclose(found_dpt, own_dpt, rtol=RTOL, atol=1e-12)


def test_kernels_equal_the_plain_statement(case):
    store, layers, image, used = case
    kernels = frame_kernels.frame_kernels(store, layers, image, used)
    nodes, expected = plan_twin.frame_kernels(store, layers, image, used)
    recipes, plain = kernels.nodes.recipes, nodes.pop("recipes")
    words = slice(0, 2 * RECIPE_TAPS)
    np.testing.assert_array_equal(recipes[..., words], plain[..., words])
    shares, plain = (
        r[..., 2 * RECIPE_TAPS :].view(np.float32) for r in (recipes, plain)
    )
    np.testing.assert_allclose(shares, plain, rtol=1e-7)  # of a rounded float32
    for made, twin in ((kernels.nodes, nodes), (kernels, expected)):
        for name, values in twin.items():
            found = getattr(made, name)
            if values.dtype == np.float64:
                np.testing.assert_allclose(found, values, RTOL, RTOL, err_msg=name)
            else:
                np.testing.assert_array_equal(found, values, err_msg=name)
    pairs = expected["cells"], expected["intervals"]
    numbers = np.zeros(used.shape)
    numbers[pairs] = np.arange(kernels.count)
    np.testing.assert_array_equal(kernels.kernel_of, numbers)


def test_shapes_of_kernels(rng):
    """Sizes, spreads, and the highest level that a spread allows, at its limits too."""
    limits_px = 0.95 * 2.0 * 2.0 ** np.arange(-1, 5)
    spread_px = np.concatenate(
        [rng.uniform(0.0, 40.0, (500, 2)), np.stack([limits_px, limits_px], axis=1)]
    )
    n = len(spread_px)
    reach_px, radius_px = rng.integers(0, 256, (n, 4)), rng.integers(0, 400, n)
    shapes = np.empty(n, records.KERNEL_SHAPE)
    n_texels = loops().call(
        *("fill_shapes", spread_px, radius_px, reach_px, n, 2.0, shapes.view(np.uint8))
    )
    assert n_texels == np.prod(box_sizes(reach_px), axis=0).sum()
    steps = np.floor(np.log2(spread_px.max(axis=1) / (0.95 * 2.0))) + 1
    highest = np.clip(steps, 0, MAX_LEVEL)
    highest[500:] = 0, 1, 2, 3, 3, 3
    np.testing.assert_array_equal(shapes["highest_level"], highest)
    np.testing.assert_array_equal(shapes["spread_px"], spread_px.astype(np.float32))
    np.testing.assert_array_equal(shapes["reach_px"], reach_px)
    np.testing.assert_array_equal(shapes["radius_px"], radius_px)
    assert not shapes["levels_used"].any()


def test_a_measured_wavefront_has_one_defocus_over_the_field():
    store = store_for("myopia", model="measured", **FIELD, **MOVING)
    layers = frame_layers(store, State(pupil_diameter_mm=3.3, focus_dpt=1.0))
    own_dpt = store.eye.total_defocus_dpt(
        pupil_diameter_mm=3.3,
        accommodation_dpt=store.eye.accommodation_dpt(1.0, pupil_diameter_mm=3.3),
        wavelength_nm=store.spec.channel_wavelengths_nm,
    )
    expected_dpt = np.broadcast_to(own_dpt, layers.layer_zero_dpt.shape)
    np.testing.assert_array_almost_equal_nulp(layers.layer_zero_dpt, expected_dpt, 4)
    assert layers.field.range_dpt == (0.0, 0.0)


def test_maps_and_their_ratios(rng):
    """Any map but those that fold."""
    maps = rng.normal(size=(50, 4, 2, 2))
    maps[np.abs(np.linalg.det(maps)) < 0.05] = np.diag([2.0, 3.0])
    maps[0] = np.eye(2)
    found = CellMaps(maps).tables
    np.testing.assert_array_equal(found.node_from_cell, maps)
    for made, plain in zip(found[1:], plan_twin.map_tables(maps), strict=True):
        np.testing.assert_allclose(made, plain, rtol=1e-11, atol=1e-13)


def maps_of_kernels(maps, spread_px):
    """Maps (n, 2, 3, 2, 2) of kernels, each of one cell and of parts of one spread."""
    n = len(maps)
    tables = CellMaps(maps).tables
    inputs = {
        "cell_weight_ratio": np.full((n, 3), 1.0 / 3.0),
        "cells": np.arange(n),
        "parts": np.repeat(np.arange(n)[:, None], 3, axis=1),
        "node_reach_px": np.full((n, 4), 5),
        "node_radius_px": np.full(n, 5),
        "node_peak_ratio": np.ones(n),
        "near": np.arange(n),
        "far": np.arange(n, 2 * n),
        "recipe_spread_px": np.append(spread_px, spread_px + 0.5),
    }
    found = {
        "weight_ratio": np.empty((n, 2, 3)),
        "maps": np.empty((n, 2, 3, 2, 2)),
        "reach_px": np.zeros((n, 4), np.int64),
        "radius_px": np.zeros(n, np.int64),
        "peak_ratio": np.zeros(n),
        "spread_px": np.zeros((n, 2)),
    }
    inputs = {name: np.ascontiguousarray(values) for name, values in inputs.items()}
    job = records.SizeJob(
        cell_maps=records.MapTables(**records.pointers(**tables._asdict())),
        count=n,
        **records.pointers(**inputs, **found),
    )
    loops().call("fill_sizes", job)
    return found["maps"]


@pytest.mark.parametrize("by", ["spread", "map"])
def test_maps_fade_in(by):
    """Over the spread of the kernels, and over the size of the map."""
    share = np.linspace(0.0, 1.0, 4001)
    change = np.full_like(share, 0.2) if by == "spread" else 0.4 * share
    maps = np.eye(2) + np.einsum("n,ij->nij", change, [[1.0, 0.0], [0.0, 0.0]])
    maps = np.repeat(maps[:, None], 3, axis=1)
    spread_px = 10.0 * share if by == "spread" else np.full_like(share, 10.0)
    found = maps_of_kernels(maps, spread_px)
    is_whole = (found == maps[:, None]).all(axis=(2, 3, 4))
    is_unmoved = (found == np.eye(2)).all(axis=(2, 3, 4))
    assert is_unmoved.any()
    assert is_whole[-1].all()
    step = np.abs(np.diff(found, axis=0)).max()
    assert step < 2e-3  # at once, it would be 0.1 at least
    # the far end of an interval is the near end of the next one
    if by == "spread":
        np.testing.assert_allclose(found[200:, 0], found[:-200, 1], atol=1e-12)
