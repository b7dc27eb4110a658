"""Each pass against a plain numpy twin, and what must hold for every input."""

from contextlib import closing

import numpy as np
import pytest

from filter_service import constants
from filter_service.gl.gpu import Gpu
from filter_service.rendering import frame_kernels
from filter_service.rendering.frame import fill_missing_depth
from filter_service.rendering.gl import kernel_passes
from filter_service.rendering.image_cells import image_cells
from tests.conftest import Engine
from tests.numerical.synthetic import (
    AS_DYNAMIC,
    Bench,
    assert_same_frame,
    depth_scene,
    psnr_db,
    texture,
)
from tests.reference import render_passes as reference

MYOPIA = {"kind": "preset", "name": "myopia"}
SIZE = {"width_px": 150, "height_px": 101, "vertical_fov_deg": 8.0}


@pytest.fixture(scope="module")
def bench(gl_engine):
    return Bench(gl_engine, MYOPIA, **SIZE)


@pytest.fixture
def view(bench, rng):
    return bench.view(texture(rng, 101, 150), depth_scene())


def read(bench, name, shape, dtype):
    gpu = bench.gpu
    with gpu.context:
        return gpu.read(gpu.storage(name, 1), shape, dtype)


def tile_grid():
    return -(-150 // constants.TILE_SIZE_PX), -(-101 // constants.TILE_SIZE_PX)


def fragments(bench):
    """Alive slots, first pixels, reaches and radii, as the merge pass packed them."""
    columns, rows = tile_grid()
    n_tiles, slots = columns * rows, columns * rows * constants.THREADS
    counts = read(bench, "BLOCKS", (n_tiles, 4), np.uint32)[:, 0]
    place = read(bench, "FRAGMENT_PLACE", (slots, 4), np.uint32)
    alive = np.arange(slots) % constants.THREADS < np.repeat(counts, constants.THREADS)
    level = (place[:, 1] >> constants.LEVEL_SHIFT) & constants.LEVEL_MASK
    x = (place[:, 0] & constants.PLACE_MASK).astype(int)
    y = (place[:, 0] >> constants.PLACE_BITS).astype(int)
    reach = np.ascontiguousarray(place[:, 3]).view(np.uint8).reshape(-1, 4).astype(int)
    radius = (place[:, 2] >> constants.PLACE_BITS).astype(int)
    return np.flatnonzero(alive), x, y, reach, radius, 2 ** level.astype(int)


def merged_twin(kernel, edge):
    """Kernel summed over the positions of a square."""
    height, width = kernel.shape[:2]
    total = np.zeros((height + edge - 1, width + edge - 1, 3))
    for dy in range(edge):
        for dx in range(edge):
            total[dy : dy + height, dx : dx + width] += kernel
    return total


def atlas_line(gpu, name):
    with gpu.context:
        atlas = gpu.atlas(name, 1)
        if gpu.atlas_is_buffer:
            line = gpu.read(atlas, (atlas.size // 16, 4), np.uint32)
        else:
            line = np.frombuffer(atlas.read(), np.uint32)
    return line.reshape(-1, 4)[:, :3]


@pytest.mark.parametrize(
    "mode", ["on-axis", pytest.param("dynamic", marks=pytest.mark.gl)]
)
def test_atlases_in_buffers_make_the_same_frame(gl_engine, rng, monkeypatch, mode):
    """What a hardware GPU has, though a software renderer reads textures faster."""
    bench = Bench(gl_engine, MYOPIA, **SIZE, mode=mode)
    view = bench.view(texture(rng, 101, 150), depth_scene())
    pictures = []
    for is_buffer in (False, True):
        monkeypatch.setattr(bench.gpu, "atlas_is_buffer", is_buffer)
        bench.renderer = gl_engine.new_renderer()
        pictures.append(bench.render(view).color)
    assert_same_frame(*pictures)


def made_kernels(bench, view, **state):
    """Kernels that the renderer made for a view, planned again; and their records."""
    count = bench.render(view, **state).kernel_count
    layers, image = bench.layers(**state), image_cells(bench.spec, bench.store.plan)
    words = kernel_passes.words_per_cell(layers)
    used = read(bench, "USED", (image.count, 4 * words), np.uint8)
    used = np.unpackbits(used, axis=1, bitorder="little").astype(bool)
    used = used[:, : frame_kernels.interval_count(layers)]
    kernels = frame_kernels.frame_kernels(bench.store, layers, image, used)
    kernel_of = read(bench, "KERNEL_OF 0", used.shape, np.uint32)
    records = read(bench, "KERNELS 0", (count, constants.KERNEL_WORDS, 4), np.uint32)
    return kernels, records[kernel_of[kernels.cells, kernels.intervals]]


@pytest.mark.parametrize(
    "mode", ["on-axis", pytest.param("dynamic", marks=pytest.mark.gl)]
)
def test_blended_kernels_equal_their_twin(gl_engine, rng, mode):
    field = {"mode": mode, "pupil_range_mm": (3.0, 4.0), "focus_range_dpt": (6, 8)}
    bench = Bench(gl_engine, MYOPIA, **{**SIZE, "vertical_fov_deg": 20.0}, **field)
    view = bench.view(texture(rng, 101, 150), depth_scene())
    kernels, records = made_kernels(bench, view, pupil_diameter_mm=3.3, focus_dpt=7.0)
    expected = reference.kernel_pairs(bench.store, kernels)
    starts = records[:, 1]
    step_ratio = np.ascontiguousarray(records[:, 2]).view(np.float32)
    # mapped reaches may end a pixel earlier than in 64-bit sums, without light there
    reach_px = np.ascontiguousarray(records[:, 0, 3]).view(np.uint8).reshape(-1, 4)
    reach_px = reach_px.astype(int)
    line = atlas_line(bench.gpu, "kernels 0")
    largest, levels = expected.shape[2] // 2, set()
    assert kernels.count > (1 if mode == "on-axis" else 50)
    for k in range(0, kernels.count, max(kernels.count // 50, 1)):
        to_left, to_right, to_top, to_bottom = reach_px[k]
        part = (
            slice(largest - to_top, largest + to_bottom + 1),
            slice(largest - to_left, largest + to_right + 1),
        )
        steps = step_ratio[k] / constants.WEIGHT_MAX
        height, width = to_top + to_bottom + 1, to_left + to_right + 1
        # half a step of the kernel, of up to four node kernels, and float32 sums
        nodes = kernels.nodes.peak_ratio[kernels.parts[k]] / constants.WEIGHT_MAX
        weights = kernels.weight_ratio[k].max(axis=0)
        rounding = 0.501 * float((nodes * weights).sum())
        for level, (offset, step) in enumerate(zip(starts[k], steps, strict=True)):
            if offset == constants.NO_LEVEL:
                break
            edge = 2**level
            shape = height + edge - 1, width + edge - 1, 3
            found = line[offset:][: shape[0] * shape[1]].reshape(shape)
            rounding = rounding * (4 if level else 1) + 0.501 * step
            for end, shift in enumerate((0, constants.WEIGHT_BITS)):
                made = ((found >> shift) & constants.WEIGHT_MASK) * float(step)
                twin = merged_twin(expected[k, end][part], edge)
                assert np.abs(made - twin).max() <= rounding + 1e-6
                levels.add(level)
    assert len(levels) >= 2


@pytest.mark.gl
def test_a_frame_whose_lists_outgrow_their_buffers_loses_nothing(rng):
    """Lists are made in the buffers that there are, and again where those are small."""
    native = Bench(Engine("native"), MYOPIA, **SIZE)
    view = native.view(texture(rng, 101, 150), depth_scene())
    wide = {"pupil_diameter_mm": 5.0, "merge": False}
    with closing(Gpu()) as own_gpu:  # whose buffers are those of the narrow frame
        bench = Bench(Engine("gl", own_gpu), MYOPIA, **SIZE)
        small = bench.render(view, pupil_diameter_mm=3.0, render_tolerance=AS_DYNAMIC)
        found = bench.render(view, **wide)
    assert found.entry_count > 2 * small.entry_count
    assert psnr_db(found.color, native.render(view, **wide).color) >= 100.0


def faulty_view(bench, rng):
    """A scene with pixels without depth, too near, and without a finite color."""
    color, depth_m = texture(rng, 101, 150), depth_scene()
    color[70:73, 20:30, 1] = np.nan
    color[90, 100] = np.inf
    depth_m[5:9, 40:60] = 0.03
    return bench.view(color, depth_m)


def test_faults_are_counted_once_whatever_the_frame_is_cut_into(
    bench, rng, monkeypatch
):
    view = faulty_view(bench, rng)
    whole = bench.render(view)
    assert (whole.bad_color_count, whole.clamped_depth_count) == (31, 80)
    monkeypatch.setattr(bench.gpu, "max_block_bytes", 16 * 152 * 80)
    cut = bench.render(view)
    assert cut.fragment_count > whole.fragment_count
    assert (cut.bad_color_count, cut.clamped_depth_count) == (31, 80)


def test_depth_that_goes_missing_in_a_stream_is_filled_from_that_frame_on(
    gl_engine, rng
):
    whole_m, lacking_m = depth_scene(), depth_scene()
    lacking_m[40:50, 90:97] = np.nan
    color = texture(rng, 101, 150)
    bench = Bench(gl_engine, MYOPIA, **SIZE)
    stream = [bench.view(color, m) for m in (whole_m, lacking_m, lacking_m, whole_m)]
    seen = [bench.render(view) for view in stream]
    assert [frame.missing_depth_count for frame in seen] == [0, 70, 70, 0]
    assert_same_frame(seen[1].color, seen[2].color, is_exact=bench.gpu is None)
    assert_same_frame(seen[0].color, seen[3].color, is_exact=bench.gpu is None)
    filled_m, _ = fill_missing_depth(lacking_m)
    filled = bench.render(bench.view(color, filled_m))
    assert_same_frame(seen[1].color, filled.color, is_exact=bench.gpu is None)


@pytest.mark.parametrize("accumulation", ["coverage", "paper"])
def test_strips_change_nothing(bench, view, monkeypatch, accumulation):
    whole = bench.render(view, accumulation=accumulation)
    rows = 80  # two halos of 32 px and a row of bins
    monkeypatch.setattr(bench.gpu, "max_block_bytes", 16 * 152 * rows)
    # named buffers are larger already; only the cutting into strips sees the limit
    cut = bench.render(view, accumulation=accumulation)
    assert cut.fragment_count > whole.fragment_count
    # the same lists and sums; only object distances round otherwise
    assert np.abs(cut.color - whole.color).max() < 1e-5


def test_stage_times_name_every_pass(bench, view):
    state = {"pupil_diameter_mm": 4.4}  # another than before: kernels are made
    times_ms = bench.render(view, output="srgb8", **state).stage_times_ms
    assert {"upload_ms", "psf_blend_ms", "fragments_ms", "merge_ms", "bin_ms"} <= set(
        times_ms
    )
    assert {"sort_ms", "splat_ms", "encode_ms", "readback_ms"} <= set(times_ms)
    assert all(value >= 0.0 for value in times_ms.values())
