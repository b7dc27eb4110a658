"""What must hold for every frame and every engine."""

import numpy as np
import pytest

from filter_service.constants import PLAN_KERNELS, PLAN_OLD_KERNELS
from filter_service.errors import BadMessage, CameraMismatch
from filter_service.rendering.gl.kernel_passes import KernelRun
from filter_service.rendering.media_effects import srgb_from_linear
from filter_service.rendering.perfect_eye import PUPIL_MM
from filter_service.rgbd_view import RgbdView
from tests.numerical.made_fragments import made_fragments
from tests.numerical.one_kernel import OneKernelBench, disc
from tests.numerical.synthetic import (
    AS_DYNAMIC,
    Bench,
    assert_same_frame,
    depth_scene,
    psnr_db,
    tangents,
    texture,
)
from tests.reference import render_passes as reference

MYOPIA = {"kind": "preset", "name": "myopia"}
SIZE = {"width_px": 150, "height_px": 101, "vertical_fov_deg": 8.0}


@pytest.fixture(scope="module")
def bench(engine):
    return Bench(engine, MYOPIA, **SIZE)


@pytest.fixture
def view(bench, rng):
    return bench.view(texture(rng, 101, 150), depth_scene())


def test_layers_are_no_farther_apart_than_the_blur_step(bench):
    assert np.all(np.diff(bench.layers().layer_dpt) > 0)
    blur_px = bench.blur_px()
    change_px = np.abs(np.diff(blur_px, axis=0))
    step_px = np.maximum(0.25, 0.05 * np.maximum(blur_px[1:], blur_px[:-1]))
    assert np.all(change_px <= step_px + 1e-9)


@pytest.mark.brief
@pytest.mark.both_engines
def test_merging_keeps_every_pixel_once(bench, view):
    result = bench.render(view, pupil_diameter_mm=5.0, render_tolerance=AS_DYNAMIC)
    made = made_fragments(bench, 150, 101)
    assert result.fragment_count == made.x.size
    assert np.square(made.edge_px)[made.edge_px > 1].sum() == result.merged_count
    assert {1, 2, 4} <= set(made.edge_px)
    covered = np.zeros((101, 150), int)
    for x, y, edge_px in zip(made.x, made.y, made.edge_px, strict=True):
        covered[y : y + edge_px, x : x + edge_px] += 1
    assert np.all(covered == 1)


def test_merging_does_not_depend_on_the_unit_of_light(bench, rng):
    image, depth_m = texture(rng, 101, 150), depth_scene()
    merged = [
        bench.render(bench.view(image * np.float32(unit), depth_m)).merged_count
        for unit in (10.0, 1000.0)
    ]
    assert merged[0] == merged[1] > 0


@pytest.mark.brief
@pytest.mark.both_engines
def test_eight_bit_output_is_the_encoded_linear_output(bench, rng):
    color = rng.integers(0, 256, (101, 150, 3), dtype=np.uint8)
    view = bench.view(color, depth_scene())
    linear = bench.render(view, output="linear").color
    encoded = bench.render(view, output="srgb8").color
    twin = srgb_from_linear(linear)
    # pow() of the shader may round a value that lies on a step the other way
    assert np.abs(encoded.astype(int) - twin).max() <= 1
    assert np.mean(encoded != twin) < 1e-3


@pytest.mark.brief
@pytest.mark.both_engines
@pytest.mark.parametrize("output", ["srgb8", "linear", "linear16"])
def test_a_picture_goes_where_it_is_wanted(bench, view, output):
    usual = bench.render(view, output=output).color
    room = np.full_like(usual, 7)
    assert bench.render(view, output=output, out=room).color is room
    assert_same_frame(room, usual, is_exact=bench.gpu is None)
    for wrong in (room[:-1], room.astype(np.float64), room[:, ::-1]):
        with pytest.raises(BadMessage, match=r"out: .* contiguous"):
            bench.render(view, output=output, out=wrong)


@pytest.mark.brief
@pytest.mark.both_engines
@pytest.mark.parametrize("accumulation", ["coverage", "paper"])
def test_same_input_gives_the_same_frame(bench, view, accumulation):
    first = bench.render(view, accumulation=accumulation).color
    again = bench.render(view, accumulation=accumulation).color
    assert_same_frame(first, again, is_exact=bench.gpu is None)


@pytest.mark.brief
@pytest.mark.both_engines
def test_a_frame_after_memory_went_back_is_the_same(bench, view):
    before = bench.render(view).color
    bench.renderer.trim()
    if bench.gpu is None:
        assert bench.renderer.memory_mb == 0.0
    assert_same_frame(bench.render(view).color, before, is_exact=bench.gpu is None)


def test_a_new_store_is_not_mistaken_for_the_last(engine, rng):
    first = Bench(engine, MYOPIA, **SIZE)
    second = Bench(engine, {"kind": "preset", "name": "cataract"}, **SIZE)
    view = first.view(texture(rng, 101, 150), 1.0)
    expected = second.render(view).color
    first.render(view)
    handle = first.renderer.load(second.store)
    options = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.0}
    mixed = first.renderer.render(view, handle, **options).color
    assert_same_frame(mixed, expected, is_exact=engine.name == "native")


@pytest.mark.parametrize(
    ("width_px", "height_px", "row_step"),
    [
        *[(1, 1, 1), (3, 2, 1), (8, 8, 1), (9, 17, 1), (257, 33, 16)],
        pytest.param(1283, 517, 12, marks=pytest.mark.slow),
    ],
)
def test_every_frame_size_agrees_with_the_gather(
    engine, rng, width_px, height_px, row_step
):
    # every step includes the last row
    # 1.2 mrad a pixel whatever the size
    fov_deg = 2 * np.degrees(np.arctan(0.6e-3 * height_px))
    bench = Bench(
        engine,
        MYOPIA,
        width_px=width_px,
        height_px=height_px,
        vertical_fov_deg=fov_deg,
    )
    depth_m = np.where(np.arange(width_px) % 40 < 20, 0.5, 3.0)[None, :]
    view = bench.view(texture(rng, height_px, width_px), depth_m)
    result = bench.render(view, merge=False)
    truth = reference.gather(view, bench.store, bench.layers(), row_step=row_step)
    assert result.color.shape == (height_px, width_px, 3)
    assert psnr_db(result.color[::row_step], truth) >= 50.0


@pytest.mark.parametrize("fill", [0.0, -1.0, np.nan])
def test_missing_depth_takes_the_nearest_and_is_counted(bench, rng, fill):
    image = texture(rng, 101, 150)
    whole = bench.view(image, np.where(np.arange(150) < 75, 0.5, 4.0)[None, :])
    holes = whole.depth_m.copy()
    holes[20:30, 10:14] = fill
    result = bench.render(RgbdView(image, holes, whole.tangents))
    assert result.missing_depth_count == 40
    is_exact = bench.gpu is None
    assert_same_frame(result.color, bench.render(whole).color, is_exact=is_exact)


def test_all_depth_missing_is_infinity(bench, rng):
    image = texture(rng, 101, 150)
    nothing = bench.render(bench.view(image, np.nan))
    assert nothing.missing_depth_count == 101 * 150
    infinite = bench.render(bench.view(image, np.inf))
    assert_same_frame(nothing.color, infinite.color, is_exact=bench.gpu is None)


def test_color_that_is_not_finite_is_black_and_counted(bench, rng):
    image = texture(rng, 101, 150)
    image[5, 7] = np.nan
    image[6, 9, 1] = np.inf
    result = bench.render(bench.view(image, 2.0))
    assert result.bad_color_count == 2
    assert np.isfinite(result.color).all()
    assert any("non-finite" in note for note in result.notes)


@pytest.mark.brief
@pytest.mark.both_engines
def test_depth_beyond_what_is_prepared_is_counted(engine, rng):
    """And depth at either end of it is not, the background least of all."""
    bench = Bench(engine, MYOPIA, **SIZE, object_range_dpt=(0.0, 2.0))
    depth_m = np.full((1, 150), np.inf)
    depth_m[:, :30], depth_m[:, 60:90], depth_m[:, 90:] = 0.2, 0.5, 1.0
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


def new_kernels(monkeypatch):
    """Return the list that the number of kernels planned by each frame is noted in."""
    noted, is_complete = [], KernelRun.is_complete

    def note(run, fill):
        new = run.counts[[PLAN_KERNELS, PLAN_OLD_KERNELS]].astype(int)
        noted.append(int(new[0] - new[1]))
        return is_complete(run, fill)

    monkeypatch.setattr(KernelRun, "is_complete", note)
    return noted


def test_two_eyes_in_turn_find_their_kernels_again(gl_engine, rng, monkeypatch):
    """As the frames of a stereo stream do; a third eye takes the place of the first."""
    benches = [
        OneKernelBench(
            gl_engine, disc(2 + 3 * i), width_px=96, height_px=64, spread_px=4.0
        )
        for i in range(3)
    ]
    renderer = benches[0].renderer
    handles = [renderer.load(bench.store) for bench in benches]
    color = texture(rng, 64, 96).astype(np.float32)
    depth_m = np.ones((64, 96), np.float32)
    view = RgbdView(color, depth_m, benches[0].tangents, "radial")
    noted = new_kernels(monkeypatch)

    def seen(handle):
        return renderer.render(view, handle, pupil_diameter_mm=PUPIL_MM, focus_dpt=0.0)

    first = [seen(handle) for handle in handles[:2]]
    assert noted == [1, 1]
    for _ in range(3):
        for before, handle in zip(first, handles, strict=False):
            again = seen(handle)
            assert noted[-1] == 0
            assert_same_frame(again.color, before.color)
    seen(handles[2])
    seen(handles[0])
    assert noted[-2:] == [1, 1]
    handles[2].release()
    again = seen(handles[0])
    assert noted[-1] == 0
    assert_same_frame(again.color, first[0].color)


def reads_of(gpu, monkeypatch):
    """Return the list that each wait for the GPU is noted in."""
    noted, read = [], gpu.begin_read
    monkeypatch.setattr(
        gpu, "begin_read", lambda *parts: noted.append(len(parts)) or read(*parts)
    )
    return noted


def test_a_frame_waits_for_the_gpu_once(gl_engine, gpu, rng, monkeypatch):
    """In the end, for the picture and what was counted; nothing in the middle."""
    bench = Bench(gl_engine, MYOPIA, **SIZE)
    view = bench.view(texture(rng, 101, 150), depth_scene())
    first = bench.render(view, pupil_diameter_mm=5.0)
    noted = reads_of(gpu, monkeypatch)
    again = bench.render(view, pupil_diameter_mm=5.0)
    assert len(noted) == 1
    assert_same_frame(again.color, first.color)
    bench.render(view, pupil_diameter_mm=4.0)
    assert len(noted) == 2, "another state"


@pytest.mark.gl
def test_a_frame_adds_the_kernels_that_it_lacks(gl_engine, gpu, rng, monkeypatch):
    """Another scene in the same state: the picture is as if it were the first."""
    bench = Bench(gl_engine, MYOPIA, **SIZE)
    color = texture(rng, 101, 150)
    near, far = (
        bench.view(color, np.full((101, 150), depth_m, np.float32))
        for depth_m in (0.5, 3.0)
    )
    expected = [
        Bench(gl_engine, MYOPIA, **SIZE).render(view, pupil_diameter_mm=5.0)
        for view in (near, far)
    ]
    bench.render(near, pupil_diameter_mm=5.0)
    waits, new = reads_of(gpu, monkeypatch), new_kernels(monkeypatch)
    seen = bench.render(far, pupil_diameter_mm=5.0)
    assert len(waits) == 1
    assert new == [1]
    assert_same_frame(seen.color, expected[1].color)
    for counted in ("fragment_count", "merged_count", "missing_depth_count"):
        assert getattr(seen, counted) == getattr(expected[1], counted)
    for view, first in ((near, expected[0]), (far, expected[1])):
        seen = bench.render(view, pupil_diameter_mm=5.0)
        assert new[-1] == 0, "both scenes' kernels are kept"
        assert_same_frame(seen.color, first.color)


def test_two_renderers_of_one_context_do_not_take_each_others_kernels(gl_engine, rng):
    benches = [Bench(gl_engine, MYOPIA, **SIZE) for _ in range(2)]
    view = benches[0].view(texture(rng, 101, 150), depth_scene())
    first = benches[0].render(view, pupil_diameter_mm=5.0)
    benches[1].render(view, pupil_diameter_mm=2.5)
    again = benches[0].render(view, pupil_diameter_mm=5.0)
    assert_same_frame(again.color, first.color)
