"""Frames that trip renderers: every size and radius, depths without an order."""

import numpy as np
import pytest

from filter_service.constants import MAX_REACH_PX
from filter_service.errors import GridTooLarge
from tests.numerical.one_kernel import OneKernelBench, disc
from tests.numerical.synthetic import Bench, assert_same_frame, psnr_db, texture
from tests.reference import render_passes as reference

MYOPIA = {"kind": "preset", "name": "myopia"}
WIDTH, HEIGHT = 70, 45
RULES = ("coverage", "paper")


@pytest.fixture(scope="module")
def bench(engine):
    return Bench(engine, MYOPIA, width_px=WIDTH, height_px=HEIGHT, vertical_fov_deg=4.0)


@pytest.mark.parametrize(
    ("width_px", "height_px"),
    [
        *[(1, 1), (2, 1), (1, 40), (15, 17), (16, 16), (33, 8), (257, 3)],
        pytest.param(1283, 517, marks=pytest.mark.slow),
        pytest.param(4096, 2160, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("rule", RULES)
def test_radius_0_gives_the_input_back_at_every_size(
    engine, rng, width_px, height_px, rule
):
    bench = OneKernelBench(engine, disc(0), width_px=width_px, height_px=height_px)
    image = rng.random((height_px, width_px, 3), dtype=np.float32)
    depth_m = rng.uniform(0.5, 9.0, (height_px, width_px))
    result = bench.render(image, depth_m, accumulation=rule)
    assert result.overflow_count == 0
    # one rounding of the weight 1 and one of its quotient
    assert np.allclose(result.color, image, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("radius_px", [1, 31, 128, MAX_REACH_PX])
def test_every_radius_up_to_the_cap_is_the_convolution(engine, rng, radius_px):
    width_px, height_px = 2 * radius_px + 31, 21
    bench = OneKernelBench(
        engine, disc(radius_px), width_px=width_px, height_px=height_px
    )
    image = texture(rng, height_px, width_px)
    result = bench.render(image)
    truth = bench.plane_truth(image)
    assert result.overflow_count == 0
    # float32 sums of up to 13,000 weights, each rounded to a step of 2**-16
    assert np.abs(result.color - truth).max() < 1e-4


def test_merged_squares_under_the_widest_kernel_lose_nothing(engine):
    """A square of 8 pixels sits at the kernel's rim: its disc must not be cut."""
    width_px, height_px = 2 * MAX_REACH_PX + 80, 24
    bench = OneKernelBench(
        engine,
        disc(MAX_REACH_PX),
        width_px=width_px,
        height_px=height_px,
        spread_px=64.0,
    )
    image = np.full((height_px, width_px, 3), 0.25, np.float32)  # no light in excess
    image[8:16, 0:8] = 1.0
    merged = bench.render(image, render_tolerance=0.1)  # in no coarser pixels
    assert merged.merged_count == image[..., 0].size
    truth = bench.plane_truth(image)
    # the kernel of a square has steps of its own: 2**-16 of 64 weights' sum
    assert np.abs(merged.color - truth).max() < 2e-5
    assert np.abs(truth).max() > 1e-3


def test_a_kernel_beyond_the_cap_is_refused_with_its_radius(engine):
    with pytest.raises(GridTooLarge, match="up to 255 px"):
        Bench(
            engine,
            {"kind": "prescription", "sphere_dpt": -6.0},
            width_px=8,
            height_px=8,
            vertical_fov_deg=0.02,
            pupil_range_mm=(5.0, 5.0),
            object_range_dpt=(0.0, 0.0),
        )


def ramp_m(first_m, last_m):
    return np.linspace(first_m, last_m, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)


def scattered_m():
    return np.random.default_rng(4).uniform(0.4, 5.0, (HEIGHT, WIDTH))


def one_pixel_in_front_m():
    depth_m = np.full((HEIGHT, WIDTH), 4.0)
    depth_m[20, 30] = 0.4
    return depth_m


DEPTHS_M = {
    "all equal": np.full((HEIGHT, WIDTH), 0.7),
    "all at infinity": np.full((HEIGHT, WIDTH), np.inf),
    "all missing": np.full((HEIGHT, WIDTH), np.nan),
    "farther along the scan": ramp_m(0.4, 3.0),
    "nearer along the scan": ramp_m(3.0, 0.4),
    "without any surface": scattered_m(),
    "one pixel in front": one_pixel_in_front_m(),
    "every other pixel at infinity": np.where(np.arange(WIDTH) % 2, np.inf, 0.5)
    * np.ones((HEIGHT, 1)),
}


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("name", DEPTHS_M)
def test_any_depths_are_finite_repeatable_and_right(bench, rng, name, rule):
    view = bench.view(texture(rng, HEIGHT, WIDTH), DEPTHS_M[name])
    options = {"accumulation": rule, "merge": False}
    result, again = (bench.render(view, **options) for _ in range(2))
    assert np.isfinite(result.color).all()
    assert_same_frame(result.color, again.color, is_exact=bench.gpu is None)
    truth = reference.gather(
        view, bench.store, bench.layers(), accumulation=rule, row_step=2
    )
    assert psnr_db(result.color[::2], truth) >= 55.0


@pytest.mark.parametrize("rule", RULES)
def test_two_pixels_one_in_front_of_the_other(engine, rule):
    """By hand: a square of nine pixels, so each has a ninth of either's light."""
    bench = OneKernelBench(engine, disc(1), width_px=2, height_px=1)
    image = np.array([[[0.9, 0.5, 0.0], [0.1, 0.2, 0.6]]], np.float32)
    result = bench.render(image, np.array([[0.5, 5.0]]), accumulation=rule)
    near, far = image[0].astype(float)
    far_share = 1.0 if rule == "coverage" else 8.0 / 9.0
    expected = (near + far_share * far) / (1.0 + far_share)
    assert np.abs(result.color - expected).max() < 1e-5
