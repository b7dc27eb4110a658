"""Views that are begun before the one before is finished: each as if it were alone."""

import itertools

import numpy as np
import pytest

from filter_service.constants import RGB
from filter_service.gl.gpu import Gpu
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gl import list_passes
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.scene_frames import scene_view

pytestmark = pytest.mark.gl

SIZE = {"width_px": 160, "height_px": 90}
STATES = [
    {"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt}
    for pupil_mm, focus_dpt in ((4.0, 0.2), (4.2, 0.2), (4.2, 0.2), (3.7, 0.9))
]
COUNTS = ("fragment_count", "merged_count", "entry_count", "missing_depth_count")


@pytest.fixture(scope="module")
def stores():
    settings = {"mode": "dynamic", "tolerance": "loose"}
    settings |= {"pupil_range_mm": (3.5, 4.5), "focus_range_dpt": (0.0, 1.0)}
    spec = spec_for(*SIZE.values(), **settings)
    names = ("emmetropia", "myopia", "keratoconus")
    return [build_psf_store(traced_eye(name, spec), spec) for name in names]


@pytest.fixture(params=["mapped memory", "plain"])
def hardware(request):
    """A context of its own, used as a hardware GPU's is."""
    gpu = Gpu()
    gpu.is_software = False
    gpu.use_staging(request.param == "mapped memory")
    yield gpu
    gpu.close()


def scenes(count):
    """The scene and the same gone to the left, again and again."""
    view = scene_view("courtyard", **SIZE)
    for k in itertools.islice(itertools.count(), count):
        images = [np.roll(i, -5 * k, axis=1) for i in (view.color, view.depth_m)]
        yield RgbdView(*map(np.ascontiguousarray, images), view.tangents, "planar")


def assert_same(seen, wanted):
    np.testing.assert_allclose(seen.color, wanted.color, rtol=1e-5, atol=1e-6)
    for name in COUNTS:
        assert getattr(seen, name) == getattr(wanted, name), name


def alone(gpu, store, view, state):
    renderer = FilterRenderer(gpu)
    return renderer.render(view, renderer.load(store), **state)


@pytest.mark.parametrize(
    "eye_count",
    [
        pytest.param(1, marks=pytest.mark.slow),
        2,
        pytest.param(3, marks=pytest.mark.slow),
    ],
)
def test_eyes_in_flight_are_as_if_alone(hardware, stores, eye_count):
    """States and scenes that change, so that some frames are done again."""
    views = list(scenes(2 * len(STATES)))
    pairs = [views[2 * k : 2 * k + 2] for k in range(len(STATES))]
    used = [stores[k % eye_count] for k in range(max(eye_count, 2))]
    wanted = [
        [
            alone(hardware, store, view, state)
            for store, view in zip(used, itertools.cycle(pair), strict=False)
        ]
        for state, pair in zip(STATES, pairs, strict=True)
    ]
    renderer = FilterRenderer(hardware)
    loaded = {id(store): renderer.load(store) for store in stores}
    handles = [loaded[id(store)] for store in used]
    for state, pair, expected in zip(STATES, pairs, wanted, strict=True):
        begun = [
            renderer.begin(ViewRequest(view, handle, State(**state)))
            for handle, view in zip(handles, itertools.cycle(pair), strict=False)
        ]
        for finish, one in zip(begun, expected, strict=True):
            assert_same(finish(), one)


def test_finished_in_any_order(hardware, stores):
    views = list(scenes(2))
    wanted = [
        alone(hardware, *each, STATES[0]) for each in zip(stores, views, strict=False)
    ]
    renderer = FilterRenderer(hardware)
    handles = [renderer.load(store) for store in stores[:2]]
    for _ in range(2):
        begun = [
            renderer.begin(ViewRequest(view, handle, State(**STATES[0])))
            for handle, view in zip(handles, views, strict=True)
        ]
        for k in (1, 0):
            assert_same(begun[k](), wanted[k])


def test_missing_depth_beside_a_whole_view(hardware, stores):
    whole, other = scenes(2)
    depth_m = other.depth_m.copy()
    depth_m[20:40, 30:60] = 0.0
    torn = RgbdView(other.color, depth_m, other.tangents, "planar")
    wanted = [alone(hardware, stores[0], view, STATES[0]) for view in (torn, whole)]
    renderer = FilterRenderer(hardware)
    handle = renderer.load(stores[0])
    for _ in range(2):
        begun = [
            renderer.begin(ViewRequest(view, handle, State(**STATES[0])))
            for view in (torn, whole)
        ]
        for finish, one in zip(begun, wanted, strict=True):
            assert_same(finish(), one)
    assert wanted[0].missing_depth_count == 20 * 30


def test_lists_that_do_not_fit_are_made_again(hardware, stores, monkeypatch):
    """The first of two finds its fragments overwritten by the second's."""
    views = list(scenes(2))
    wanted = [alone(hardware, stores[0], view, STATES[0]) for view in views]
    monkeypatch.setattr(list_passes, "MAX_BAND_ENTRIES", wanted[0].entry_count // 3)
    renderer = FilterRenderer(hardware)
    handle = renderer.load(stores[0])
    begun = [
        renderer.begin(ViewRequest(view, handle, State(**STATES[0]))) for view in views
    ]
    for finish, one in zip(begun, wanted, strict=True):
        assert_same(finish(), one)


def test_reads_in_flight_keep_what_was_sent(hardware):
    """Buffers change behind a read; mapped memory that is full is emptied first."""
    gpu = hardware
    with gpu.context:
        sent = [np.full(300_000, k, np.uint32) for k in range(6)]
        received = [np.zeros_like(data) for data in sent]
        waiting = []
        for data, out in zip(sent, received, strict=True):
            buffer = gpu.upload("TRIED", data)
            waiting.append(gpu.begin_read((buffer, 0, out)))
        for arrive in reversed(waiting):
            arrive()
            arrive()  # a second time does nothing
    for data, out in zip(sent, received, strict=True):
        np.testing.assert_array_equal(out, data)


def test_a_picture_is_the_callers(hardware, stores):
    """What comes later does not change it."""
    (view,) = scenes(1)
    renderer = FilterRenderer(hardware)
    handle = renderer.load(stores[0])
    first = renderer.render(view, handle, output="srgb8", **STATES[0]).color
    kept = first.copy()
    renderer.render(view, handle, output="srgb8", **STATES[3])
    np.testing.assert_array_equal(first, kept)
    assert first.shape == (SIZE["height_px"], SIZE["width_px"], RGB)
