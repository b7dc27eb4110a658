"""Kernels as the passes plan them, against the compiled loops in float64."""

import numpy as np
import pytest

from filter_service import constants as c
from filter_service.gl.stage_timer import StageTimer
from filter_service.psfs.frame_layers import frame_layers
from filter_service.rendering import image_cells
from filter_service.rendering.frame_kernels import frame_kernels, interval_count
from filter_service.rendering.gl import kernel_passes
from filter_service.rendering.gl.gl_store import GlStore
from filter_service.rendering.gl.kernel_passes import FrameState, KernelPasses, marked
from filter_service.view_state import State
from tests.numerical import plan_twin
from tests.numerical.test_frame_plan import CASES, store_for

pytestmark = pytest.mark.gl

SUM_RTOL = 3e-5
"""Sums of 32-bit floats; shares between nodes of defocus are differences of them."""

MOST_PAIRS = 150
"""More of the made-up kernels, which are large, would not fit a software renderer."""


class Planned:
    """Plans of an eye's kernels in one state, and what the passes have written."""

    def __init__(self, gpu, store, layers, image):
        self.gpu, self.store, self.layers, self.image = gpu, store, layers, image
        self.handle = GlStore(gpu, store)
        self.passes = KernelPasses(gpu)
        change_dpt = layers.field.at(image.corner_h_deg, image.corner_v_deg)
        self.state = FrameState(layers, image, change_dpt.astype(np.float32))
        self.fields = []

    def plan(self, used):
        """Plan the kernels of used pairs; return whether they are complete."""
        words = kernel_passes.words_per_cell(self.layers)
        bits = np.zeros((self.image.count, words * c.BITS_PER_WORD), np.uint8)
        bits[:, : used.shape[1]] = used
        with self.gpu.context:
            self.run = self.passes.begin(self.handle, self.state, StageTimer(self.gpu))
            self.run.clear()
            self.gpu.write(
                self.run.buffers["USED"], np.packbits(bits, bitorder="little")
            )
            self.run.make()
            self.gpu.read_into(*self.run.to_read(np.zeros(256, np.uint32)))
        return self.run.is_complete(self._note)

    def _note(self, psfs):
        """Note missing PSFs, and compute none."""
        self.fields.append(psfs)
        return psfs

    def plan_until_complete(self, used):
        """Plan again with larger buffers, as frames do."""
        for _ in range(4):
            if self.plan(used):
                return
        raise AssertionError("the plan is never complete")

    def read(self, name, *shape):
        """Return a buffer's words."""
        buffer = self.run.buffers[name]
        with self.gpu.context:
            return self.gpu.read(buffer, shape, np.uint32)

    def count(self, index):
        """Return a counter of the plan."""
        return int(self.run.counts[index])


@pytest.fixture(autouse=True)
def any_texel_count(monkeypatch):
    """The made-up kernels are larger than real ones."""
    monkeypatch.setattr(image_cells, "TEXELS_PER_PIXEL", np.inf)


BRIEF = "pupil on a node"
LONG = pytest.mark.long("an eye is planned, by a software renderer as well")
SAME_PASSES = (
    # of another case of the loops, with as many neighbors and nodes
    *("lowest end", "highest end", "accommodation on a node", "several accommodations"),
)
PLANNED = [
    pytest.param(name, marks=[pytest.mark.brief, LONG] if name == BRIEF else [])
    for name in CASES
    if name not in SAME_PASSES
]


@pytest.fixture
def case(request, rng, gpu):
    """A plan, and used pairs."""
    (name, settings), pupil_mm, focus_dpt, share, gaze_deg = CASES[request.param]
    store = store_for(name, **settings)
    layers = frame_layers(store, State(pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt))
    image = image_cells.image_cells(store.spec, store.plan, gaze_deg)
    shape = image.count, interval_count(layers)
    used = rng.random(shape) < min(share, MOST_PAIRS / np.prod(shape))
    used[image.count // 2, used.shape[1] // 2] = True
    return Planned(gpu, store, layers, image), used


def reaches(words):
    return np.ascontiguousarray(words).view(np.uint8).reshape(-1, 4).astype(int)


def floats(words):
    return np.ascontiguousarray(words).view(np.float32)


def assert_reaches(found_px, expected_px):
    """Mapped reaches may end a pixel earlier or later, for sums in 32-bit floats."""
    assert np.abs(found_px - expected_px).max() <= 1
    assert (found_px != expected_px).mean() < 0.005


def assert_nodes(planned, kernels, node_of):
    """Node kernels: sizes and recipes."""
    nodes, n = kernels.nodes, planned.count(c.PLAN_NODES)
    assert n == nodes.near.size
    found = planned.read("NODES", n, c.NODE_WORDS, 4)[node_of]
    np.testing.assert_array_equal(reaches(found[:, 0, 3]), nodes.reach_px)
    np.testing.assert_array_equal(found[:, 1, 3], nodes.radius_px)
    np.testing.assert_allclose(floats(found[:, 1, 0]), nodes.peak_ratio, SUM_RTOL)
    ends = np.stack([nodes.near, nodes.far], axis=-1)
    spread_px = nodes.recipe_spread_px[ends]
    np.testing.assert_allclose(floats(found[:, 1, 1:3]), spread_px, SUM_RTOL)
    recipes = planned.read("RECIPES", n, 2, c.RGB, 3, c.RECIPE_TAPS)[node_of]
    expected = nodes.recipes.reshape(-1, c.RGB, 3, c.RECIPE_TAPS)[ends]
    weights, plain = floats(recipes[..., 2, :]), floats(expected[..., 2, :])
    np.testing.assert_allclose(weights, plain, rtol=0.0, atol=SUM_RTOL * plain.max())
    both = (weights > 0.0) & (plain > 0.0)
    for word in (0, 1):  # offsets and reaches
        np.testing.assert_array_equal(
            recipes[..., word, :][both], expected[..., word, :][both]
        )
    return found[:, 0, 2], nodes.reach_px


def assert_covered(starts, sizes, total):
    """Ranges of texels that follow each other without gaps, in any order."""
    order = np.argsort(starts, kind="stable")
    ends = np.cumsum(sizes[order])
    np.testing.assert_array_equal(starts[order], ends - sizes[order])
    assert ends[-1] == total


def assert_work(planned, work_list, numbers, sizes):
    """Each texel of each kernel in one item of a work list."""
    count = planned.count(c.PLAN_WORK + work_list)
    capacity = planned.run.capacity.work_items
    items = planned.read("WORK", kernel_passes.WORK_LISTS, capacity, 2)
    found = {tuple(item) for item in items[work_list, :count].tolist()}
    expected = {
        (int(number), texel)
        for number, size in zip(numbers, sizes, strict=True)
        for texel in range(0, int(size), c.THREADS)
    }
    assert len(found) == count
    assert found == expected


@pytest.mark.parametrize("case", PLANNED, indirect=True)
def test_kernels_are_those_of_the_compiled_loops(case):
    planned, used = case
    planned.plan_until_complete(used)
    expected = frame_kernels(planned.store, planned.layers, planned.image, used)
    n, n_intervals = expected.count, interval_count(planned.layers)
    assert planned.count(c.PLAN_KERNELS) == n
    kernel_of = planned.read("KERNEL_OF", *used.shape)
    np.testing.assert_array_equal(kernel_of != c.NO_INDEX, used)
    numbers = kernel_of[expected.cells, expected.intervals]
    np.testing.assert_array_equal(np.sort(numbers), np.arange(n))

    n_fields = planned.store.fields_count
    node_of = planned.read("NODE_OF", n_fields * n_intervals)
    used_nodes = np.flatnonzero(node_of != c.NO_INDEX)
    starts, reach_px = assert_nodes(planned, expected, node_of[used_nodes])
    node_sizes = (reach_px[:, 0] + reach_px[:, 1] + 1) * (
        reach_px[:, 2] + reach_px[:, 3] + 1
    )
    assert_covered(starts, node_sizes, planned.count(c.PLAN_NODE_TEXELS))
    assert_work(planned, 0, node_of[used_nodes], node_sizes)

    parts = planned.read("PARTS", n, c.PART_WORDS, 4)[numbers]
    weights = floats(parts[:, 1 : c.PART_MAPS, :3])
    np.testing.assert_allclose(weights, expected.weight_ratio, 1e-5)
    has_weight = expected.weight_ratio[:, 0] > 0.0
    own = node_of[used_nodes][expected.parts]
    np.testing.assert_array_equal(parts[:, 0, :3][has_weight], own[has_weight])
    maps = floats(parts[:, c.PART_MAPS :]).reshape(n, 2, 3, 2, 2)
    for end in range(2):
        found, plain = (
            all_maps[:, end][has_weight] for all_maps in (maps, expected.maps)
        )
        np.testing.assert_allclose(found, plain, 1e-5, 1e-6)

    records = planned.read("KERNELS", n, c.KERNEL_WORDS, 4)[numbers]
    np.testing.assert_allclose(floats(records[:, 0, :2]), expected.spread_px, SUM_RTOL)
    np.testing.assert_array_equal(records[:, 0, 2], expected.radius_px)
    found_px = reaches(records[:, 0, 3])
    assert_reaches(found_px, expected.reach_px)
    scale = floats(records[:, 2])
    sizes, _, scales = plan_twin.kernel_levels(
        found_px, floats(records[:, 0, :2]), expected.peak_ratio
    )
    np.testing.assert_allclose(scale, scales, SUM_RTOL)
    starts = records[:, 1].astype(np.int64)
    np.testing.assert_array_equal(starts != c.NO_LEVEL, sizes > 0)
    assert_covered(starts[sizes > 0], sizes[sizes > 0], planned.count(c.PLAN_TEXELS))
    for level in range(c.MAX_LEVEL + 1):
        assert_work(planned, 1 + level, numbers, sizes[:, level])
    assert planned.count(c.PLAN_REACH) == found_px.max()
    assert planned.count(c.PLAN_BASE_TEXELS) == sizes[:, 0].sum()


@pytest.mark.parametrize(
    "case",
    [BRIEF, "every pair", "two planes", "a single layer"],
    indirect=True,
)
def test_a_state_that_stays_keeps_its_kernels(case, rng):
    planned, used = case
    planned.plan_until_complete(used)
    first = planned.read("KERNEL_OF", *used.shape)
    records = planned.read("KERNELS", planned.count(c.PLAN_KERNELS), 3, 4)
    more = rng.random(used.shape) < min(0.1, 20 / used.size)
    assert planned.plan(more)
    found = planned.read("KERNEL_OF", *used.shape)
    np.testing.assert_array_equal(found != c.NO_INDEX, used | more)
    np.testing.assert_array_equal(found[used], first[used])
    n_new = int((more & ~used).sum())
    assert planned.count(c.PLAN_KERNELS) == used.sum() + n_new
    now = planned.read("KERNELS", planned.count(c.PLAN_KERNELS), 3, 4)
    np.testing.assert_array_equal(now[: len(records)], records)
    expected = frame_kernels(planned.store, planned.layers, planned.image, used | more)
    numbers = found[expected.cells, expected.intervals]
    assert_reaches(reaches(now[numbers, 0, 3]), expected.reach_px)
    assert planned.plan(used)  # nothing is left to do
    assert not planned.run.counts[c.PLAN_WORK : c.PLAN_WORK + 5].any()
    groups = planned.run.counts[: c.PLAN_KERNELS : c.DISPATCH_WORDS]
    assert not groups.any()


def planned_case(gpu):
    """A state between the nodes of pupil and accommodation."""
    (name, settings), pupil_mm, focus_dpt, *_ = CASES["between all nodes"]
    store = store_for(name, **settings)
    layers = frame_layers(store, State(pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt))
    image = image_cells.image_cells(store.spec, store.plan)
    return Planned(gpu, store, layers, image)


def test_missing_psfs_are_reported_and_others_take_their_weight(gpu):
    planned = planned_case(gpu)
    store, layers = planned.store, planned.layers
    used = np.zeros((planned.image.count, interval_count(layers)), bool)
    used[0, 0] = used[5, 3] = True
    assert planned.plan(used)
    read = marked(planned.run.read_words)
    lacking = read[::4]
    store.tables.is_computed[lacking] = False
    peaks = store.tables.peak_ratio[lacking].copy()
    store.tables.peak_ratio[lacking] = 0.0
    try:
        planned = Planned(gpu, store, layers, planned.image)
        assert not planned.plan(used)
        np.testing.assert_array_equal(planned.fields, [lacking])
        assert planned.count(c.PLAN_MISSING) > 0
        n = planned.count(c.PLAN_NODES)
        recipes = planned.read("RECIPES", n, 2, c.RGB, 3, c.RECIPE_TAPS)
        weights = floats(recipes[..., 2, :]) * c.WEIGHT_MAX
        of = {int(store.tables.offsets[psf]): psf for psf in read}
        tap_peaks = np.array(
            [
                store.tables.peak_ratio[of.get(int(w), read[0])]
                for w in recipes[..., 0, :].flat
            ]
        ).reshape(weights.shape)
        share = np.divide(weights, tap_peaks, where=tap_peaks > 0.0, out=weights * 0)
        np.testing.assert_allclose(share.sum(axis=-1), 1.0, rtol=1e-5)
    finally:
        store.tables.is_computed[lacking] = True
        store.tables.peak_ratio[lacking] = peaks


def test_a_plan_that_does_not_fit_is_made_again(gpu, monkeypatch):
    """With more kernels than records, and more texels than any plan has at first."""
    monkeypatch.setattr(kernel_passes, "FIRST_RECORDS", 7)
    planned = planned_case(gpu)
    used = np.zeros((planned.image.count, interval_count(planned.layers)), bool)
    used[::10, ::40] = True
    assert not planned.plan(used)
    planned.plan_until_complete(used)
    assert planned.count(c.PLAN_KERNELS) == used.sum() > 7
    assert planned.count(c.PLAN_TEXELS) > kernel_passes.FIRST_TEXELS
