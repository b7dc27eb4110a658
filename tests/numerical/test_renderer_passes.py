"""Each pass against a plain numpy twin, and what must hold for every input."""

import numpy as np
import pytest

from filter_service import constants
from filter_service.errors import BadMessage, CameraMismatch
from filter_service.rendering import frame_kernels, reference
from filter_service.rendering.gl import kernel_passes
from filter_service.rendering.image_cells import image_cells
from filter_service.rgbd_view import RgbdView
from tests.numerical.synthetic import Bench, psnr_db, tangents, texture

MYOPIA = {"kind": "preset", "name": "myopia"}
SIZE = {"width_px": 150, "height_px": 101, "vertical_fov_deg": 8.0}


@pytest.fixture(scope="module")
def bench(gpu):
    return Bench(gpu, MYOPIA, **SIZE)


def depth_scene():
    """Near disc, slanted floor and far wall: edges, slopes and flats."""
    y, x = np.mgrid[0:101, 0:150]
    floor = 1.0 / (0.1 + 1.5 * np.clip(y - 60, 0, None) / 40)
    depth_m = np.where(y > 60, floor, 8.0)
    disc = (x - 60) ** 2 + (y - 40) ** 2 < 20**2
    return np.where(disc, 0.4, depth_m).astype(np.float32)


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
        line = np.frombuffer(gpu.atlas(name, 1).read(), np.uint32)
    return line.reshape(-1, 4)[:, :3]


def made_kernels(bench, view, **state):
    """Kernels that the renderer made for a view, planned again."""
    bench.render(view, **state)
    layers, image = bench.layers(**state), image_cells(bench.spec, bench.store.plan)
    words = -(-frame_kernels.interval_count(layers) // 32)
    used = read(bench, "USED", (image.count, words), np.uint32)
    used = kernel_passes.used_pairs(used, layers)
    return frame_kernels.frame_kernels(bench.store, layers, image, used)


@pytest.mark.parametrize("mode", ["on-axis", "dynamic"])
def test_blended_kernels_equal_their_twin(gpu, rng, mode):
    field = {"mode": mode, "pupil_range_mm": (3.0, 4.0), "focus_range_dpt": (6, 8)}
    bench = Bench(gpu, MYOPIA, **{**SIZE, "vertical_fov_deg": 20.0}, **field)
    view = bench.view(texture(rng, 101, 150), depth_scene())
    kernels = made_kernels(bench, view, pupil_diameter_mm=3.3, focus_dpt=7.0)
    expected = reference.kernel_pairs(bench.store, kernels)
    table, _ = frame_kernels.kernel_table(kernels)
    line = atlas_line(gpu, "kernels")
    largest, levels = expected.shape[2] // 2, set()
    assert kernels.count > (1 if mode == "on-axis" else 50)
    for k in range(0, kernels.count, max(kernels.count // 50, 1)):
        to_left, to_right, to_top, to_bottom = kernels.reach_px[k]
        part = (
            slice(largest - to_top, largest + to_bottom + 1),
            slice(largest - to_left, largest + to_right + 1),
        )
        steps = table[k, 2].view(np.float32) / constants.WEIGHT_MAX
        height, width = to_top + to_bottom + 1, to_left + to_right + 1
        # half a step of the kernel, of up to four node kernels, and float32 sums
        nodes = kernels.nodes.peak_ratio[kernels.parts[k]] / constants.WEIGHT_MAX
        rounding = 0.501 * float((nodes * kernels.weight_ratio[k]).sum())
        for level, (offset, step) in enumerate(zip(table[k, 1], steps, strict=True)):
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


def test_layers_are_no_farther_apart_than_the_blur_step(bench):
    assert np.all(np.diff(bench.layers().layer_dpt) > 0)
    change_px = np.abs(np.diff(bench.blur_px(), axis=0))
    assert change_px.max() <= bench.spec.max_blur_step_px + 1e-9


def test_merging_keeps_every_pixel_once(bench, view):
    result = bench.render(view, pupil_diameter_mm=5.0)
    alive, x, y, _, _, edges = fragments(bench)
    assert result.fragment_count == len(alive)
    assert np.square(edges[alive])[edges[alive] > 1].sum() == result.merged_count
    assert {1, 2, 4} <= set(edges[alive])
    covered = np.zeros((101, 150), int)
    for slot in alive:
        edge = edges[slot]
        covered[y[slot] : y[slot] + edge, x[slot] : x[slot] + edge] += 1
    assert np.all(covered == 1)


def test_merging_does_not_depend_on_the_unit_of_light(bench, rng):
    image, depth_m = texture(rng, 101, 150), depth_scene()
    merged = [
        bench.render(bench.view(image * np.float32(unit), depth_m)).merged_count
        for unit in (10.0, 1000.0)
    ]
    assert merged[0] == merged[1] > 0


def test_eight_bit_output_is_the_encoded_linear_output(bench, rng):
    color = rng.integers(0, 256, (101, 150, 3), dtype=np.uint8)
    view = bench.view(color, depth_scene())
    linear = bench.render(view, output="linear").color
    encoded = bench.render(view, output="srgb8").color
    twin = reference.srgb_from_linear(linear)
    # pow() of the shader may round a value that lies on a step the other way
    assert np.abs(encoded.astype(int) - twin).max() <= 1
    assert np.mean(encoded != twin) < 1e-3


@pytest.mark.parametrize("accumulation", ["coverage", "paper"])
def test_same_input_gives_the_same_bytes(bench, view, accumulation):
    first = bench.render(view, accumulation=accumulation).color
    again = bench.render(view, accumulation=accumulation).color
    assert first.tobytes() == again.tobytes()


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


def test_a_new_store_is_not_mistaken_for_the_last(gpu, rng):
    first = Bench(gpu, MYOPIA, **SIZE)
    second = Bench(gpu, {"kind": "preset", "name": "cataract"}, **SIZE)
    view = first.view(texture(rng, 101, 150), 1.0)
    expected = second.render(view).color
    first.render(view)
    handle = first.renderer.load(second.store)
    options = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.0}
    mixed = first.renderer.render(view, handle, **options).color
    assert mixed.tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    ("width_px", "height_px"),
    [
        *[(1, 1), (3, 2), (8, 8), (9, 17), (257, 33)],
        pytest.param(1283, 517, marks=pytest.mark.slow),
    ],
)
def test_every_frame_size_agrees_with_the_gather(gpu, rng, width_px, height_px):
    # 1.2 mrad a pixel whatever the size
    fov_deg = 2 * np.degrees(np.arctan(0.6e-3 * height_px))
    bench = Bench(
        gpu, MYOPIA, width_px=width_px, height_px=height_px, vertical_fov_deg=fov_deg
    )
    depth_m = np.where(np.arange(width_px) % 40 < 20, 0.5, 3.0)[None, :]
    view = bench.view(texture(rng, height_px, width_px), depth_m)
    result = bench.render(view, merge=False)
    truth = reference.gather(view, bench.store, bench.layers())
    assert result.color.shape == (height_px, width_px, 3)
    assert psnr_db(result.color, truth) >= 50.0


@pytest.mark.parametrize("fill", [0.0, -1.0, np.nan])
def test_missing_depth_takes_the_nearest_and_is_counted(bench, rng, fill):
    image = texture(rng, 101, 150)
    whole = bench.view(image, np.where(np.arange(150) < 75, 0.5, 4.0)[None, :])
    holes = whole.depth_m.copy()
    holes[20:30, 10:14] = fill
    result = bench.render(RgbdView(image, holes, whole.tangents))
    assert result.missing_depth_count == 40
    assert result.color.tobytes() == bench.render(whole).color.tobytes()


def test_all_depth_missing_is_infinity(bench, rng):
    image = texture(rng, 101, 150)
    nothing = bench.render(bench.view(image, np.nan))
    assert nothing.missing_depth_count == 101 * 150
    assert np.array_equal(nothing.color, bench.render(bench.view(image, np.inf)).color)


def test_colour_that_is_not_finite_is_black_and_counted(bench, rng):
    image = texture(rng, 101, 150)
    image[5, 7] = np.nan
    image[6, 9, 1] = np.inf
    result = bench.render(bench.view(image, 2.0))
    assert result.bad_color_count == 2
    assert np.isfinite(result.color).all()
    assert any("non-finite" in note for note in result.notes)


def test_depth_nearer_than_prepared_is_counted(gpu, rng):
    bench = Bench(gpu, MYOPIA, **SIZE, object_range_dpt=(0.0, 2.0))
    depth_m = np.where(np.arange(150) < 30, 0.2, 1.0)[None, :]
    result = bench.render(bench.view(texture(rng, 101, 150), depth_m, "radial"))
    assert result.clamped_depth_count == 30 * 101


def test_wrong_arrays_and_cameras_are_refused(bench, rng):
    image, depth_m = texture(rng, 101, 150), depth_scene()
    bad = [
        (image[..., :2], depth_m, bench.tangents),
        (image.astype(np.float64), depth_m, bench.tangents),
        (image, depth_m[:50], bench.tangents),
        (image, depth_m, bench.tangents, "sideways"),
    ]
    for parts in bad:
        with pytest.raises(BadMessage):
            bench.render(RgbdView(*parts))
    with pytest.raises(CameraMismatch):
        bench.render(RgbdView(image, depth_m, tangents(150, 101, 20.0)))
    with pytest.raises(BadMessage, match="accumulation"):
        bench.render(bench.view(image, depth_m), accumulation="average")


def test_pupil_outside_the_prepared_range_is_clamped_with_a_note(bench, view):
    result = bench.render(view, pupil_diameter_mm=1.0)
    assert result.pupil_diameter_mm == pytest.approx(2.0)
    assert any("prepared" in note for note in result.notes)


def test_stage_times_name_every_pass(bench, view):
    times_ms = bench.render(view, output="srgb8").stage_times_ms
    assert {"upload_ms", "psf_blend_ms", "fragments_ms", "merge_ms", "bin_ms"} <= set(
        times_ms
    )
    assert {"sort_ms", "splat_ms", "encode_ms", "readback_ms"} <= set(times_ms)
    assert all(value >= 0.0 for value in times_ms.values())
