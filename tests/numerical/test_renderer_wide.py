"""A headset's field, 94 x 96 deg: pixels of cells and of nodes differ threefold."""

import numpy as np
import pytest

from filter_service.rgbd_view import RgbdView
from tests.numerical.synthetic import assert_same_frame, psnr_db, texture
from tests.numerical.test_renderer_field import (
    FOCUS_DPT,
    PUPIL_MM,
    FieldBench,
    splat_exactly,
    tangents_of,
)

SIZE_PX = (36, 42)
LEFT_EYE = tangents_of(-52, 42, -53, 43)


@pytest.fixture(scope="module")
def bench(engine):
    """Return one bench for an engine: frames depend on their input alone."""
    return FieldBench(
        engine,
        "myopia",
        LEFT_EYE,
        size=SIZE_PX,
        mode="dynamic",
        tolerance="loose",  # few nodes, far apart
    )


def scene(rng):
    width, height = SIZE_PX
    color = texture(rng, height, width, cell_px=3).astype(np.float32)
    depth_m = np.full((height, width), 1.5, np.float32)
    depth_m[20:40, 10:30] = 0.6
    return color, depth_m


def test_maps_are_as_wide_as_this_is_about(bench):
    maps = bench.handle.image.maps.tables.node_from_cell
    assert np.abs(maps).max() > 2.0


def test_a_wide_field_agrees_with_the_exact_psf_of_every_pixel(bench, rng):
    """Where nothing hides anything; at an edge there is more than PSFs to it."""
    color, depth_m = scene(rng)
    depth_m[:] = 1.5
    seen = bench.render(color, depth_m).color
    exact = splat_exactly(bench, color, depth_m)
    inner = (slice(4, -4), slice(4, -4))
    assert psnr_db(seen[inner], exact[inner]) > 43.0


def test_a_wide_field_comes_out_the_same_again_and_again(engine, bench, rng):
    """Whatever lies in memory beside it: a map once read beyond its kernel."""
    color, depth_m = scene(rng)
    view = RgbdView(color, depth_m, bench.spec.camera.tangents)
    first = None
    for n in range(8):
        if hasattr(bench.renderer, "trim"):
            bench.renderer.trim()
        _ = np.full(1000 * n + 1, np.nan)  # other memory, with other contents
        seen = bench.renderer.render(
            view, bench.handle, pupil_diameter_mm=PUPIL_MM, focus_dpt=FOCUS_DPT
        ).color
        first = seen if first is None else first
        assert_same_frame(seen, first, is_exact=engine.name == "native")
