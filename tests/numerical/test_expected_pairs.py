"""Kernels told from the frame before: right by construction, and seen where not."""

from types import SimpleNamespace

import numpy as np
import pytest

from filter_service.constants import USED_PARTS
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.gl.expected_pairs import MARGIN_DPT, part_edges_dpt
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.pair_loops import dilate, predict_pairs, unpack_pairs
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.scene_frames import scene_view

ROWS, COLUMNS = 3, 4
SIZE = {"width_px": 240, "height_px": 135}


def words_of(parts):
    """Bits (rows, columns, n_parts) as words, as the GPU notes them."""
    padded = np.pad(parts, ((0, 0), (0, 0), (0, -parts.shape[2] % 32)))
    packed = np.packbits(padded, axis=2, bitorder="little")
    return np.ascontiguousarray(packed).view("<u4").astype(np.uint32)


def noted(places_dpt, edge_dpt):
    """Bits (rows, columns, n) of the ranges between edges that pixels lie in."""
    last = edge_dpt.size - 2
    part = np.clip(np.searchsorted(edge_dpt, places_dpt, "right") - 1, 0, last)
    bits = np.zeros((*places_dpt.shape[:2], last + 1), bool)
    rows, columns = np.indices(places_dpt.shape[:2])[..., None]
    bits[rows, columns, part] = True
    return bits


class Scene:
    """Pixels of random vergence; defocus changes over the field with the state."""

    def __init__(self, rng):
        self.rng = rng
        self.vergence_dpt = rng.uniform(0.0, 4.0, (ROWS, COLUMNS, 6))
        self.share = rng.random((2, *self.vergence_dpt.shape))

    def state(self, count):
        """Places of the pixels, layers, and the change at the corners of cells."""
        change_dpt = self.rng.normal(0.0, 0.5, (ROWS + 1, COLUMNS + 1))
        across, down = self.share
        upper, lower = (
            (1 - across) * part[:, :-1, None] + across * part[:, 1:, None]
            for part in (change_dpt[:-1], change_dpt[1:])
        )
        places_dpt = self.vergence_dpt + (1 - down) * upper + down * lower
        ends_dpt = np.array([places_dpt.min() - 0.01, places_dpt.max() + 0.01])
        inside_dpt = self.rng.uniform(*ends_dpt, max(count - 2, 0))
        return places_dpt, np.sort(np.append(inside_dpt, ends_dpt[:count])), change_dpt


@pytest.mark.parametrize("new_count", [1, 2, 9, 40])
def test_all_pairs_of_the_same_scene_are_told(new_count, rng):
    scene = Scene(rng)
    places_dpt, layer_dpt, change_dpt = scene.state(20)
    new_places_dpt, new_layer_dpt, new_change_dpt = scene.state(new_count)
    edge_dpt = part_edges_dpt(SimpleNamespace(layer_dpt=layer_dpt))
    words = words_of(noted(places_dpt, edge_dpt))
    told = predict_pairs(
        words, edge_dpt, change_dpt, new_layer_dpt, new_change_dpt, MARGIN_DPT
    )
    ends_dpt = new_layer_dpt if new_count > 1 else np.array([-np.inf, np.inf])
    wanted = noted(new_places_dpt, ends_dpt)
    assert told.shape == wanted.shape
    assert not np.any(wanted & ~told)
    wide = dilate(told)
    for row in range(ROWS):
        for column in range(COLUMNS):
            around = told[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            np.testing.assert_array_equal(wide[row, column], around.any(axis=(0, 1)))


def test_parts_of_intervals_are_pairs(rng):
    parts = rng.random((1, 7, 29 * USED_PARTS)) < 0.05
    used = unpack_pairs(words_of(parts)[0], 29)
    np.testing.assert_array_equal(used, parts[0].reshape(7, 29, -1).any(axis=2))


def test_the_same_state_tells_little_more_than_is_used(rng):
    """Neighboring intervals alone, and those only from parts at their border."""
    layer_dpt = np.linspace(0.0, 4.0, 30)
    edge_dpt = part_edges_dpt(SimpleNamespace(layer_dpt=layer_dpt))
    change_dpt = np.zeros((ROWS + 1, COLUMNS + 1))
    parts = rng.random((ROWS, COLUMNS, 29, USED_PARTS)) < 0.03
    told = predict_pairs(
        words_of(parts.reshape(ROWS, COLUMNS, -1)),
        *(edge_dpt, change_dpt, layer_dpt, change_dpt, MARGIN_DPT),
    )
    wanted = parts.any(axis=3)
    wanted[..., 1:] |= parts[..., :-1, -1]
    wanted[..., :-1] |= parts[..., 1:, 0]
    np.testing.assert_array_equal(told, wanted)


@pytest.fixture(scope="module")
def store():
    settings = {"mode": "dynamic", "tolerance": "loose"}
    settings |= {"pupil_range_mm": (3.5, 4.5), "focus_range_dpt": (0.0, 1.0)}
    spec = spec_for(*SIZE.values(), **settings)
    return build_psf_store(traced_eye("emmetropia", spec), spec)


@pytest.fixture
def hardware(gpu, monkeypatch):
    """The context as if it were a GPU's: other variants, and it pays not to wait."""
    monkeypatch.setattr(gpu, "is_software", False)
    return gpu


def fresh(gpu, store, view, state):
    """The picture of a renderer that knows of no frame before."""
    renderer = FilterRenderer(gpu)
    return renderer.render(view, renderer.load(store), **state)


def moved(view, columns):
    """The scene, gone to the left."""
    rolled = [np.roll(i, -columns, axis=1) for i in (view.color, view.depth_m)]
    return type(view)(*map(np.ascontiguousarray, rolled), view.tangents, "planar")


def test_frames_whose_state_changes_wait_once(hardware, store, monkeypatch):
    view = scene_view("courtyard", **SIZE)
    states = [
        {"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt}
        for pupil_mm, focus_dpt in ((4.0, 0.5), (4.1, 0.5), (4.1, 0.7), (3.6, 0.9))
    ]
    expected = [fresh(hardware, store, view, state) for state in states]
    renderer = FilterRenderer(hardware)
    handle = renderer.load(store)
    renderer.render(view, handle, **states[0])
    waits, read = [], hardware.begin_read
    monkeypatch.setattr(
        hardware, "begin_read", lambda *parts: waits.append(1) or read(*parts)
    )
    for state, wanted in zip(states[1:], expected[1:], strict=True):
        waits.clear()
        seen = renderer.render(view, handle, **state)
        assert len(waits) == 1
        assert "psf_blend_ms" in seen.stage_times_ms
        assert seen.fragment_count == wanted.fragment_count
        np.testing.assert_allclose(seen.color, wanted.color, rtol=1e-5, atol=1e-6)


def test_a_moving_scene_is_whole_and_told_by_its_neighbors(
    hardware, store, monkeypatch
):
    """Once told wrongly, the neighbors count: then it waits once, as a still one."""
    view = scene_view("courtyard", **SIZE)
    renderer = FilterRenderer(hardware)
    handle = renderer.load(store)
    waits, read = [], hardware.begin_read
    monkeypatch.setattr(
        hardware, "begin_read", lambda *parts: waits.append(1) or read(*parts)
    )
    counts = []
    for k in range(6):
        state = {"pupil_diameter_mm": 4.0 + 0.05 * k, "focus_dpt": 0.5}
        scene = moved(view, 3 * k)
        wanted = fresh(hardware, store, scene, state)
        waits.clear()
        seen = renderer.render(scene, handle, **state)
        counts.append(len(waits))
        np.testing.assert_allclose(seen.color, wanted.color, rtol=1e-5, atol=1e-6)
        assert seen.fragment_count == wanted.fragment_count
    assert counts[0] == 2, "nothing is known of the first: it asks"
    assert counts[1] == 2, "the second was told wrongly, and is done again"
    assert counts[3:] == [1, 1, 1]
