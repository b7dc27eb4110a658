"""Random small frames through the compiled loops, against the float64 twin."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from filter_service.psfs.frame_layers import frame_layers
from filter_service.rendering.native import frame_record
from filter_service.rendering.perfect_eye import PUPIL_MM
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.conftest import Engine
from tests.numerical.one_kernel import OneKernelBench, disc
from tests.numerical.synthetic import AS_DYNAMIC, psnr_db, texture
from tests.reference import render_passes as reference

STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": 0.0}

DISTANCES_M = (np.inf, 0.5, 0.7, 1.0, 4.0, 0.0, np.nan, -1.0)
"""All prepared distances, one nearer than those, and what stands for a missing one."""

ROUNDING_DB = 75.0
"""Weights of 15 bits and sums in float32, where a pixel may be made of two weights."""


MANY = settings(
    deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)


@st.composite
def frames(draw):
    """Size, kernel radius, seed of all numbers, and how distances lie."""
    return {
        "size": (draw(st.integers(1, 45)), draw(st.integers(1, 45))),
        "radius_px": draw(st.integers(0, 14)),
        "seed": draw(st.integers(0, 2**32 - 1)),
        "distances_m": draw(
            st.lists(st.sampled_from(DISTANCES_M), min_size=1, max_size=4)
        ),
        "patch_px": draw(st.integers(1, 20)),
        "accumulation": draw(st.sampled_from(["coverage", "paper"])),
        "n_threads": draw(st.integers(1, 5)),
    }


def random_kernel(rng, radius_px):
    """Lopsided, with holes, within its disc."""
    side = 2 * radius_px + 1
    y, x = np.mgrid[:side, :side] - radius_px
    inside = x * x + y * y <= (radius_px + 0.5) ** 2
    kernel = inside * rng.random((side, side)) * (rng.random((side, side)) < 0.7)
    kernel[radius_px, radius_px] += 0.1
    return kernel / kernel.sum()


def random_view(rng, bench, case):
    height, width = bench.size
    patch = case["patch_px"]
    cells = (height // patch + 1, width // patch + 1)
    coarse = rng.choice(np.float32(case["distances_m"]), cells)
    depth_m = coarse.repeat(patch, 0).repeat(patch, 1)[:height, :width].copy()
    color = rng.random((height, width, 3), dtype=np.float32)
    return RgbdView(color, depth_m, bench.tangents, "radial")


def assert_twin_makes_the_same(case):
    rng = np.random.default_rng(case["seed"])
    height_px, width_px = case["size"]
    kernel = random_kernel(rng, case["radius_px"])
    bench = OneKernelBench(
        Engine("native"), kernel, width_px=width_px, height_px=height_px
    )
    view = random_view(rng, bench, case)
    rule = {"accumulation": case["accumulation"]}
    result = bench.renderer.render(view, bench.handle, **STATE, merge=False, **rule)
    layers = frame_layers(bench.store, State(**STATE))
    truth = reference.gather(view, bench.store, layers, **rule)
    assert np.isfinite(result.color).all()
    assert psnr_db(result.color, truth) >= ROUNDING_DB
    bench.renderer.close()


@settings(MANY, max_examples=10)
@given(frames())
def test_random_frames_are_those_of_the_twin(case):
    assert_twin_makes_the_same(case)


@pytest.mark.slow
@settings(MANY, max_examples=60)
@given(frames())
def test_many_random_frames_are_those_of_the_twin(case):
    assert_twin_makes_the_same(case)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(frames())
def test_threads_and_processors_give_the_same_picture(case):
    """To the bit for any number of threads; to rounding on processors without AVX2."""
    from filter_service.native import Loops, loops
    from filter_service.rendering.native import NativeRenderer

    rng = np.random.default_rng(case["seed"])
    height_px, width_px = case["size"]
    kernel = random_kernel(rng, case["radius_px"])
    bench = OneKernelBench(
        Engine("native"), kernel, width_px=width_px, height_px=height_px, spread_px=9.0
    )
    view = random_view(rng, bench, case)
    name_before = bench.renderer.name
    usual = bench.renderer.render(view, bench.handle, **STATE).color
    other = NativeRenderer(n_threads=case["n_threads"])
    same = other.render(view, other.load(bench.store), **STATE).color
    assert same.tobytes() == usual.tobytes()
    portable = NativeRenderer(Loops(loops().path, portable=True))
    assert "portable" in portable.name
    plain = portable.render(view, portable.load(bench.store), **STATE).color
    assert psnr_db(plain, usual.astype(float)) >= 100.0
    assert bench.renderer.name == name_before  # the one does not change the other
    again = bench.renderer.render(view, bench.handle, **STATE).color
    assert again.tobytes() == usual.tobytes()


@pytest.mark.parametrize("radius_px", [12, 30, 60])
def test_coarse_pixels_cost_little(rng, monkeypatch, radius_px):
    """Squares under kernels that wide light pixels of 2 px (12) or 4 px (30, 60)."""
    width_px, height_px = 3 * radius_px, 2 * radius_px + 21
    bench = OneKernelBench(
        Engine("native"),
        disc(radius_px),
        width_px=width_px,
        height_px=height_px,
        spread_px=float(radius_px),
    )
    image = texture(rng, height_px, width_px, cell_px=16)
    coarse = bench.render(image, render_tolerance=AS_DYNAMIC).color
    never = (0.0, np.inf, np.inf)
    monkeypatch.setattr(frame_record, "COARSE_SPREAD_PX", never)
    bench.renderer = Engine("native").new_renderer()  # which keeps no kernels
    fine = bench.render(image, render_tolerance=AS_DYNAMIC).color
    assert 55.0 <= psnr_db(coarse, fine) <= 90.0
    truth = bench.plane_truth(image)
    # without sharpening, 1.2 to 2.4 dB
    assert psnr_db(coarse, truth) >= psnr_db(fine, truth) - 0.5
