"""The bins' lists against their twin, at their limits, and what frames make of them."""

from dataclasses import replace

import numpy as np
import pytest

from filter_service import constants
from filter_service.gl.stage_timer import StageTimer
from filter_service.rendering.gl import list_passes
from filter_service.rendering.gl.list_passes import ListPasses
from filter_service.rendering.gl.strip import Strip
from tests.numerical import tile_lists
from tests.numerical.synthetic import Bench, assert_same_frame, texture

MYOPIA = {"kind": "preset", "name": "myopia"}
WIDTH, HEIGHT = 150, 101
SIZE = {"width_px": WIDTH, "height_px": HEIGHT, "vertical_fov_deg": 8.0}
KEY_BITS = {
    "coverage": constants.SORT_KEY_BITS,
    "paper": constants.PAPER_SORT_KEY_BITS,
}
RULES = ("coverage", "paper")


@pytest.fixture(scope="module")
def bench(gl_engine):
    return Bench(gl_engine, MYOPIA, **SIZE)


def depth_scene():
    """Near disc, slanted floor and far wall: edges, slopes and flats."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    floor = 1.0 / (0.1 + 1.5 * np.clip(y - 60, 0, None) / 40)
    depth_m = np.where(y > 60, floor, 8.0)
    disc = (x - 60) ** 2 + (y - 40) ** 2 < 20**2
    return np.where(disc, 0.4, depth_m).astype(np.float32)


@pytest.fixture
def view(bench, rng):
    return bench.view(texture(rng, HEIGHT, WIDTH), depth_scene())


def new_passes(bench, *, paper_rule=False, surface_count=1):
    """Passes of a view, about to make its lists."""
    view = bench.view(np.zeros((HEIGHT, WIDTH, 3), np.float32), 1.0)
    if surface_count == 2:
        view = replace(view, hidden_color=view.color, hidden_depth_m=view.depth_m)
    strip = Strip(
        bench.gpu,
        view,
        StageTimer(bench.gpu),
        layers=bench.layers(),
        paper_rule=paper_rule,
    )
    return ListPasses(strip)


def random_buffers(rng, tile_count, columns, surface_count, *, reach_px):
    """BLOCKS, FRAGMENT_PLACE, FRAGMENT_COLOR: fragments of every size and reach."""
    n_blocks = surface_count * tile_count
    slots = n_blocks * constants.THREADS
    block = np.arange(slots) // constants.THREADS % tile_count
    level = rng.integers(0, constants.MAX_LEVEL + 1, slots)
    place_in_block = [rng.integers(0, 8, slots) >> level << level for _ in range(2)]
    x = block % columns * constants.TILE_SIZE_PX + place_in_block[0]
    y = block // columns * constants.TILE_SIZE_PX + place_in_block[1]
    radius = rng.integers(0, reach_px + 1, slots)
    sides = (rng.random((slots, 4)) * (radius[:, None] + 1)).astype(np.uint8)
    edge = (rng.random(slots) < 0.002) * constants.EDGE_BIT
    edge |= (rng.random(slots) < 0.01) * constants.BRIGHT_BIT
    place = np.stack(
        [
            x | y << constants.PLACE_BITS,
            level << constants.LEVEL_SHIFT | edge,
            radius << constants.PLACE_BITS,
            sides.view("<u4")[:, 0],
        ],
        axis=-1,
    ).astype(np.uint32)
    color = rng.random((slots, 4)).astype(np.float32)
    color[:, 3] = np.round(8.0 * color[:, 3]) / 8.0  # many equal depths
    blocks = np.zeros((n_blocks, 4), np.uint32)
    blocks[:, 0] = rng.integers(0, 9, n_blocks)
    reaches = radius.reshape(n_blocks, -1).max(axis=1) + np.float32(0.5)
    blocks[:, 1] = reaches.astype(np.float32).view(np.uint32)
    return blocks, place, color


def made_lists(passes, blocks, place, color, *, reach_px):
    """Run the list passes on buffers; counts, offsets and entries that they made."""
    gpu = passes.strip.gpu
    with gpu.context:
        for name, words in (
            ("BLOCKS", blocks),
            ("FRAGMENT_PLACE", place),
            ("FRAGMENT_COLOR", color),
        ):
            passes.strip.buffers[name] = gpu.upload(name, words)
        plan = np.zeros(constants.PLAN_WORDS, np.uint32)
        plan[constants.PLAN_REACH] = reach_px
        passes.strip.buffers["PLAN"] = gpu.upload("plan of a test", plan)
        passes.count_bins()
        totals = np.empty(constants.TOTAL_WORDS, np.uint32)
        gpu.read_into((*passes.totals, totals))
        passes.record_totals(totals)
        passes.reserve_lists()
        assert len(passes.bands) == 1
        passes.make_lists(0, passes.strip.bin_count)
        n_bins = passes.strip.bin_count
        counts = gpu.read(passes.strip.buffers["BIN_COUNTS"], (n_bins, 4), np.uint32)
        offsets = gpu.read(passes.strip.buffers["BIN_OFFSETS"], (n_bins,), np.uint32)
        entries = gpu.read(
            passes.strip.buffers["ENTRIES"], (passes.lists.entry_count,), np.uint32
        )
    starts = zip(offsets, counts[:, 0], strict=True)
    return counts, offsets, [entries[start : start + n] for start, n in starts]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("surface_count", [1, 2])
@pytest.mark.parametrize("reach_px", [0, 7, 60])
def test_lists_equal_those_of_all_pairs(bench, rng, rule, surface_count, reach_px):
    paper_rule = rule == "paper"
    passes = new_passes(bench, paper_rule=paper_rule, surface_count=surface_count)
    buffers = random_buffers(
        rng,
        passes.strip.tile_count,
        passes.strip.grid[0],
        surface_count,
        reach_px=reach_px,
    )
    counts, offsets, made = made_lists(passes, *buffers, reach_px=reach_px)
    expected = tile_lists.expected_lists(
        tile_lists.unpack_fragments(*buffers),
        (WIDTH, HEIGHT),
        hidden_from=passes.strip.tile_count * constants.THREADS,
        order_always=paper_rule,
    )
    lengths = np.array([len(entries) for entries in expected.entries])
    assert np.array_equal(counts[:, 0], lengths)
    assert np.array_equal(offsets, expected.offsets[:-1])
    assert passes.lists.entry_count == lengths.sum()
    assert np.array_equal(counts[:, 1], expected.ordered_tiles)
    bright = expected.bright_tiles << constants.TILES_PER_BIN
    assert np.array_equal(counts[:, 3], expected.hidden_tiles | bright)
    assert not counts[:, 2].any()
    room = constants.TILES_PER_BIN * len(lengths)
    found = read(bench, "TILES", (constants.TILE_KINDS, room), np.uint32)
    for kind, tiles in enumerate(tile_lists.expected_tiles(expected, (WIDTH, HEIGHT))):
        assert passes.lists.tiles[kind] == len(tiles)
        filled = np.append(tiles, [constants.NO_INDEX] * (-len(tiles) % 4))
        assert np.array_equal(found[kind, : filled.size], filled)
    assert passes.lists.longest == lengths.max()
    assert passes.lists.overflow_count == 0
    sorted_bins = 0
    for listed, twin, ordered in zip(
        made, expected.entries, expected.ordered_tiles, strict=True
    ):
        if ordered and len(twin):
            # eighths are exact in the keys of either rule: the order is the exact one
            depths = tile_lists.entry_depths(twin, buffers[2])
            twin = twin[np.argsort(depths, kind="stable")]
            sorted_bins += 1
        assert np.array_equal(listed, twin)
    assert sorted_bins > 0
    if surface_count == 1 and not paper_rule and reach_px < 60:
        assert sorted_bins < len(made)


@pytest.mark.parametrize("rule", RULES)
def test_sorted_lists_are_right_to_the_stated_step_of_depth(bench, rng, rule):
    passes = new_passes(bench, paper_rule=rule == "paper")
    blocks, place, color = random_buffers(
        rng, passes.strip.tile_count, passes.strip.grid[0], 1, reach_px=30
    )
    place[:, 1] |= constants.EDGE_BIT
    color[:, 3] = np.exp(rng.uniform(-1.0, 7.0, len(color)))  # 0.4 m to 1 km
    if rule == "coverage":
        color[:, 3] = -1.0 / color[:, 3]
    *_, made = made_lists(passes, blocks, place, color, reach_px=30)
    for listed in made:
        depths = tile_lists.entry_depths(listed, color)
        keys = tile_lists.depth_keys(depths, KEY_BITS[rule], paper_rule=rule == "paper")
        if rule == "paper":  # whole numbers all the way: equal keys in scan order
            assert np.all(np.diff(keys * 2.0**32 + listed) > 0)
        # Float32 may put a depth on a step into the one beside it.
        assert np.all(np.diff(keys) >= -1)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("reach_px", [4, 60])
def test_every_size_class_sorts_alike(bench, rng, monkeypatch, rule, reach_px):
    passes = new_passes(bench, paper_rule=rule == "paper")
    buffers = random_buffers(
        rng, passes.strip.tile_count, passes.strip.grid[0], 1, reach_px=reach_px
    )
    buffers[2][:, 3] = rng.random(len(buffers[2]))
    results = []
    for capacities in ((512, 2048), (16, 64), (4,)):
        monkeypatch.setattr(list_passes, "SORT_CAPACITIES", capacities)
        *_, made = made_lists(passes, *buffers, reach_px=reach_px)
        results.append(np.concatenate(made))
    assert passes.lists.longest > 16
    assert np.array_equal(results[0], results[1])
    assert np.array_equal(results[0], results[2])


def test_a_key_holds_the_depth_and_the_place_in_the_longest_list():
    assert max(constants.SORT_CAPACITIES) <= 2**constants.SORT_INDEX_BITS
    assert max(KEY_BITS.values()) + constants.SORT_INDEX_BITS <= 32
    # every sort must begin and end on whole digits
    assert not any(bits % constants.RADIX_BITS for bits in KEY_BITS.values())


def test_a_list_that_overflows_keeps_its_first_entries_and_is_counted(
    bench, view, monkeypatch
):
    whole = bench.render(view)
    assert whole.overflow_count == 0
    lengths = read(bench, "BIN_COUNTS", (n_bins(), 4), np.uint32)[:, 0].astype(int)
    limit = int(np.median(lengths))
    monkeypatch.setattr(list_passes, "MAX_BAND_ENTRIES", limit)
    cut, again = bench.render(view), bench.render(view)
    assert cut.overflow_count == np.maximum(lengths - limit, 0).sum() > 0
    assert cut.entry_count == np.minimum(lengths, limit).sum()
    assert np.isfinite(cut.color).all()
    assert cut.color.min() >= 0.0
    assert cut.color.max() <= 1.001  # the mean of what was kept
    assert_same_frame(cut.color, again.color)
    monkeypatch.undo()
    assert_same_frame(bench.render(view).color, whole.color)


@pytest.mark.parametrize("limit", ["MAX_BAND_ENTRIES", "MAX_BAND_BINS"])
@pytest.mark.parametrize("rule", RULES)
def test_bands_change_nothing(bench, view, monkeypatch, limit, rule):
    whole = bench.render(view, accumulation=rule)
    few = 7 if limit == "MAX_BAND_BINS" else whole.entry_count // 7
    monkeypatch.setattr(list_passes, limit, few)
    banded = bench.render(view, accumulation=rule)
    assert (banded.entry_count, banded.overflow_count) == (whole.entry_count, 0)
    assert_same_frame(banded.color, whole.color)


@pytest.mark.parametrize("rule", RULES)
def test_hardware_group_sizes_make_the_same_frame(bench, view, monkeypatch, rule):
    software = bench.render(view, accumulation=rule)
    lists = frame_lists(bench)
    monkeypatch.setattr(bench.gpu, "is_software", not bench.gpu.is_software)
    other = bench.render(view, accumulation=rule)
    assert np.array_equal(lists, frame_lists(bench))
    # one sum in the same order; products may be fused otherwise
    assert np.abs(other.color - software.color).max() < 1e-5


def read(bench, name, shape, dtype):
    gpu = bench.gpu
    with gpu.context:
        return gpu.read(gpu.storage(name, 1), shape, dtype)


def n_bins():
    edge = constants.BIN_SIZE_PX
    return -(-WIDTH // edge) * -(-HEIGHT // edge)


def frame_lists(bench):
    """Lists of the last frame, one behind the other."""
    counts = read(bench, "BIN_COUNTS", (n_bins(), 4), np.uint32)[:, 0]
    starts = read(bench, "BIN_OFFSETS", (n_bins(),), np.uint32)
    entries = read(bench, "ENTRIES", (int(starts[-1] + counts[-1]),), np.uint32)
    pairs = zip(starts, counts, strict=True)
    return np.concatenate([entries[start : start + n] for start, n in pairs])


@pytest.mark.parametrize("surface_count", [1, 2])
@pytest.mark.parametrize("share", [0.0, 0.01, 1.0])
def test_windows_hold_the_blocks_in_reach_and_no_more(bench, rng, surface_count, share):
    """A share of the blocks reaches far; those of ``share`` 0 leave bins empty."""
    passes = new_passes(bench, surface_count=surface_count)
    reach_px = 90
    blocks, *others = random_buffers(
        rng,
        passes.strip.tile_count,
        passes.strip.grid[0],
        surface_count,
        reach_px=reach_px,
    )
    n_blocks = len(blocks)
    far = rng.random(n_blocks) < share
    reaches = np.where(far, rng.uniform(30, reach_px, n_blocks), 0.5)
    blocks[:, 1] = reaches.astype(np.float32).view(np.uint32)
    if share == 0.0:
        blocks[:, 0] *= rng.random(n_blocks) < 0.1
    made_lists(passes, blocks, *others, reach_px=reach_px)
    windows = read(bench, "WINDOWS", (n_bins(), 4), np.int32)
    expected = tile_lists.expected_windows(blocks, passes.strip.grid, surface_count)
    assert np.array_equal(windows, expected)
