"""Operators with frozen layers and kernels of 30 bits, against images by quadrature."""

from dataclasses import replace

import numpy as np
import pytest

from filter_service import Camera, EyeFilter, FilterSettings, RgbdView
from filter_service.errors import OutOfMemory
from filter_service.filtering.operator import frozen_layers, frozen_operator
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.frozen_store import MAX_DISTANCES, FrozenLayers, FrozenStore
from filter_service.view_state import State
from tests.reference.flat_image import FlatScene, wavefront_of_profile

WIDTH, HEIGHT = 20, 14
CAMERA = Camera.from_fov(0.6, width_px=WIDTH, height_px=HEIGHT)
SETTINGS = FilterSettings(mode="on-axis", eye_model="wavefront", chromatic=False)
STATE = State(3.0, 0.0)
PROFILE = {
    "kind": "zernike",
    "pupil_diameter_mm": 5.0,
    "wavelength_nm": 587.56,
    "zernike_um": {"2,-2": 0.1, "2,0": 0.4, "3,1": -0.08, "4,0": 0.1},
}


def view_of(distance_dpt):
    depth_m = np.broadcast_to(1.0 / distance_dpt, (HEIGHT, WIDTH)).astype(np.float32)
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    return RgbdView(black, depth_m, CAMERA.tangents, depth_kind="radial")


@pytest.fixture(scope="module")
def planned_of():
    """Return a function that returns the planned frame of distances in diopters."""
    with EyeFilter(PROFILE, CAMERA, SETTINGS) as eye_filter:

        def planned(distance_dpt):
            views = [view_of(distance_dpt)]
            while not (found := eye_filter.plan(views, [STATE], newest_only=True)):
                eye_filter.wait()
            return found

        yield planned


def operator_of(planned):
    layers = [frozen_layers(view) for view in planned.views]
    return frozen_operator(planned, layers, is_sequence=False)


@pytest.mark.long("a PSF by the reference's quadrature")
def test_the_image_of_a_point_is_that_of_quadrature(planned_of):
    point = np.zeros((HEIGHT, WIDTH))
    point[6, 9] = 1.0
    color = np.repeat(point[..., None], 3, axis=2).astype(np.float32)
    found = operator_of(planned_of(1.5)).forward(color)[..., 1]
    cornea_um, measured_nm = wavefront_of_profile(PROFILE)
    expected = FlatScene(
        cornea_um=cornea_um,
        measured_nm=measured_nm,
        pupil_diameter_mm=STATE.pupil_diameter_mm,
        focus_dpt=STATE.focus_dpt,
        object_dpt=1.5,
        light=point,
        pitch_mrad=CAMERA.pixel_pitch_mrad,
    ).image()[..., 0]
    # Half of the steps of 16 bits would be 8e-6 of the peak.
    assert np.abs(found - expected).max() < 2e-4 * expected.max()
    assert np.median(np.abs(found - expected)) < 2e-6 * expected.max()


def test_the_adjoint_is_the_transpose(planned_of, rng):
    near = np.where(np.arange(WIDTH) < 8, 2.5, 1.5)
    operator = operator_of(planned_of(near))
    x = rng.random(operator.color_shape, dtype=np.float32)
    y = rng.random(operator.image_shape, dtype=np.float32)
    products = [
        np.vdot(a.astype(float), b.astype(float))
        for a, b in ((operator.forward(x), y), (x, operator.adjoint(y)))
    ]
    assert products[0] == pytest.approx(products[1], rel=1e-5)
    ones = operator.forward(np.ones(operator.color_shape, np.float32))
    np.testing.assert_allclose(ones, 1.0, atol=1e-5)


def assert_inside(layers):
    assert layers.layer_dpt.size == layers.object_dpt.size + 1
    assert np.all(layers.layer_dpt[:-1] < layers.object_dpt)
    assert np.all(layers.object_dpt < layers.layer_dpt[1:])


def test_few_distances_have_layers_of_their_own(planned_of):
    distances_dpt = np.array([0.5, 1.2, 2.5])
    planned = planned_of(distances_dpt[np.arange(WIDTH) % 3])
    layers = frozen_layers(planned.views[0])
    np.testing.assert_allclose(layers.object_dpt, distances_dpt, atol=1e-6)
    assert_inside(layers)


def test_many_distances_share_layers(planned_of):
    distances_dpt = np.linspace(0.5, 2.5, 4 * MAX_DISTANCES)
    store = planned_of(1.0).views[0].store.store
    layers = FrozenLayers.of(frame_layers(store, STATE), distances_dpt)
    assert layers.object_dpt.size < distances_dpt.size
    assert layers.layer_dpt[0] <= distances_dpt[0]
    assert layers.layer_dpt[-1] >= distances_dpt[-1]
    assert_inside(layers)


def test_kernels_are_not_evicted(planned_of):
    view = planned_of(1.5).views[0]
    state = replace(STATE, gaze_deg=(0.0, 0.0))
    store = FrozenStore(view.store.store, state, frozen_layers(view), (WIDTH, HEIGHT))
    with pytest.raises(OutOfMemory, match="derivative"):
        store.evict(0)
