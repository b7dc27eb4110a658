"""High dynamic range and wide gamut: any unit of light, and colors below zero."""

import numpy as np
import pytest

from filter_service.constants import HALF_MAX
from filter_service.rendering.media_effects import half_from_linear
from tests.numerical.synthetic import Bench, assert_same_frame, psnr_db, texture

WIDTH, HEIGHT = 101, 61  # odd: halves of a pixel share words with its neighbors
MYOPIA = {"kind": "preset", "name": "myopia"}


@pytest.fixture(scope="module")
def bench(engine):
    return Bench(engine, MYOPIA, width_px=WIDTH, height_px=HEIGHT, vertical_fov_deg=5.0)


def hdr_scene(rng):
    """A room in 0..0.5, a window of 40 and a lamp of 900, before two distances."""
    color = 0.5 * texture(rng, HEIGHT, WIDTH, cell_px=12)
    color[10:25, 60:80] = [38.0, 40.0, 44.0]
    color[40:42, 20:23] = [900.0, 700.0, 400.0]
    depth_m = np.where(np.arange(WIDTH) < 50, 0.6, 4.0)[None, :]
    return color, depth_m


def relative_error(image, expected):
    return np.abs(image - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("unit", [100.0, 1e-3, 2.0**-20])
def test_the_filter_scales_with_the_light(bench, rng, unit):
    color, depth_m = hdr_scene(rng)
    plain = bench.render(bench.view(color, depth_m))
    scaled = bench.render(bench.view((color * unit).astype(np.float32), depth_m))
    assert 0 < scaled.merged_count == plain.merged_count
    # float32 sums of hundreds of weights, in which a scaled light rounds otherwise
    assert relative_error(scaled.color / unit, plain.color) <= 4e-6


def test_merging_keeps_the_dark_of_a_bright_scene(bench, rng):
    """Against every pixel by itself, relative to the room and not to the lamp."""
    color, depth_m = hdr_scene(rng)
    view = bench.view(color, depth_m)
    merged, single = bench.render(view), bench.render(view, merge=False)
    assert merged.merged_count > 0
    room = single.color.max(axis=2) < 0.5
    assert room.mean() > 0.3
    assert psnr_db(2.0 * merged.color[room], 2.0 * single.color[room]) >= 45.0


@pytest.mark.parametrize("merge", [True, False])
def test_negative_light_is_filtered_like_positive(bench, rng, merge):
    """Light minus white: the filter of the difference is the difference.

    No light is so bright that missing coverage does not amplify it.
    """
    color, depth_m = hdr_scene(rng)
    color = 0.6 + np.minimum(color, 2.0) / 5.0
    plain = bench.render(bench.view(color, depth_m), merge=False)
    lowered = bench.render(bench.view(color - np.float32(1.0), depth_m), merge=merge)
    assert lowered.bad_color_count == 0
    assert lowered.color.min() < -0.2
    assert psnr_db(lowered.color + 1.0, plain.color) >= (50.0 if merge else 110.0)


def test_half_floats_in_are_the_same_as_their_floats(bench, rng):
    color, depth_m = hdr_scene(rng)
    half = (color - 0.1).astype(np.float16)
    half[3, 4] = [np.inf, np.nan, 1.0]
    from_half, from_float = (
        bench.render(bench.view(image, depth_m))
        for image in (half, half.astype(np.float32))
    )
    assert_same_frame(from_half.color, from_float.color, is_exact=bench.gpu is None)
    assert from_half.bad_color_count == from_float.bad_color_count == 1


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32])
def test_half_floats_out_equal_their_twin(bench, rng, dtype):
    color, depth_m = hdr_scene(rng)
    if dtype == np.uint8:
        color = np.minimum(255.0 * color, 255.0)
    else:
        color = 3e4 * (color - 0.1)  # beyond the largest half in the window
        color = np.clip(color, -HALF_MAX, HALF_MAX if dtype == np.float16 else None)
    view = bench.view(color.astype(dtype), depth_m)
    linear, half = (
        bench.render(view, output=output).color for output in ("linear", "linear16")
    )
    assert half.dtype == np.float16
    assert half.nbytes == linear.nbytes // 2
    np.testing.assert_array_equal(half, half_from_linear(linear))
    assert np.isfinite(half).all()
    if dtype == np.float32:
        assert half.max() == HALF_MAX < linear.max()
        assert half.min() < 0.0
