"""Frames that change continuously with depth, and lamps beside edges."""

from dataclasses import replace

import numpy as np
import pytest

from filter_service.constants import (
    DISCONTINUITY_PX,
    MERGE_CONTRAST,
    MERGE_CONTRAST_POWER,
    MERGE_FADE_RATIO,
)
from filter_service.rgbd_view import RgbdView
from tests.numerical.made_fragments import made_fragments
from tests.numerical.one_kernel import OneKernelBench, disc
from tests.numerical.synthetic import AS_DYNAMIC, Bench, texture

pytestmark = pytest.mark.both_engines

EMMETROPE = {"kind": "prescription", "sphere_dpt": 0.0}
PURE = {"diffraction": False, "chromatic": False}
WIDTH, HEIGHT = 64, 48
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
STEP_RATIO = 2e-3
"""Relative change of a step of depth; light changes by less than half of this."""

Y, X = np.mgrid[:HEIGHT, :WIDTH]
DISC = np.hypot(X - WIDTH // 2, Y - HEIGHT // 2) < 12
BAR = abs(X - 14) < 3


@pytest.fixture(scope="module")
def bench(engine):
    return Bench(
        engine,
        EMMETROPE,
        width_px=WIDTH,
        height_px=HEIGHT,
        vertical_fov_deg=4.0,
        **PURE,
    )


def change_across(bench, frame):
    """Return the largest change of a frame when a step of depth becomes an edge.

    ``frame`` takes the step in diopters.
    """
    edge_dpt = DISCONTINUITY_PX / bench.layers(**STATE).blur_px_per_dpt
    below, above = (
        frame(edge_dpt * ratio)
        for ratio in (1.0 - STEP_RATIO / 2.0, 1.0 + STEP_RATIO / 2.0)
    )
    return np.abs(above.astype(float) - below).max()


@pytest.mark.parametrize("has_bar", [False, True])
def test_a_step_that_becomes_an_edge_changes_no_pixel_at_once(bench, rng, has_bar):
    """Alone, and beside a bar whose light makes order matter everywhere."""
    fine = texture(rng, HEIGHT, WIDTH, cell_px=3)
    color = np.where(DISC[..., None], 0.6 + 0.4 * fine, 0.2 * fine)
    near_dpt = 1.5

    def frame(step_dpt):
        distance_dpt = np.where(DISC, near_dpt, near_dpt - step_dpt)
        if has_bar:
            distance_dpt[BAR] = 4.0
        depth_m = (1.0 / distance_dpt).astype(np.float32)
        view = bench.view(color.astype(np.float32), depth_m, "radial")
        return bench.render(view, **STATE, merge=False).color

    assert change_across(bench, frame) < 1e-3


def test_a_hidden_surface_appears_gradually_behind_the_visible_one(bench, rng):
    color = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    hidden_color = 0.5 + 0.5 * texture(rng, HEIGHT, WIDTH)
    distance_dpt = np.where(DISC, 3.0, 1.0).astype(np.float32)

    def frame(step_dpt):
        view = RgbdView(
            color,
            np.float32(1.0) / distance_dpt,
            bench.tangents,
            "radial",
            hidden_color=hidden_color,
            hidden_depth_m=(1.0 / (distance_dpt - step_dpt)).astype(np.float32),
        )
        return bench.render(view, **STATE, merge=False).color

    assert change_across(bench, frame) < 1e-3


@pytest.mark.parametrize("light", [1.0, 50.0])
@pytest.mark.parametrize("is_near", [False, True])
def test_a_lamp_beside_an_edge_has_the_energy_of_its_visible_part(
    bench, light, is_near
):
    """A lamp on the far surface, focused on the near one; and the reverse."""
    near = X < WIDTH // 2
    depth_m = np.where(near, 1.0 / 2.5, 1.0 / 0.5).astype(np.float32)
    state = STATE | {"focus_dpt": 0.5 if is_near else 2.5}
    for distance_px in (1, 2):
        column = WIDTH // 2 + (-distance_px if is_near else distance_px - 1)
        color = np.zeros((HEIGHT, WIDTH, 3), np.float32)
        color[HEIGHT // 2, column] = light
        beside, alone = (
            bench.render(bench.view(color, d, "radial"), **state).color.astype(float)
            for d in (depth_m, depth_m[HEIGHT // 2, column])
        )
        visible = alone if is_near else alone[:, WIDTH // 2 :]
        assert is_near or visible.sum() < 0.99 * alone.sum()
        assert beside.sum() == pytest.approx(visible.sum(), rel=0.02)


def test_a_lamp_behind_a_blurred_edge_is_as_bright_with_one_layer_as_with_two(bench):
    near = X < WIDTH // 2
    depth_m = np.where(near, 1.0 / 2.5, 1.0 / 0.5).astype(np.float32)
    for distance_px in (1, 3):
        color = np.zeros((HEIGHT, WIDTH, 3), np.float32)
        color[HEIGHT // 2, WIDTH // 2 - 1 + distance_px] = 1.0
        view = bench.view(color, depth_m, "radial")
        hidden_m = np.where(near, np.float32(2.0), np.float32(0.0))
        layered = replace(
            view, hidden_color=np.zeros_like(color), hidden_depth_m=hidden_m
        )
        one, two = (
            bench.render(v, **STATE | {"focus_dpt": 2.0}).color.sum(dtype=float)
            for v in (view, layered)
        )
        assert one == pytest.approx(two, rel=0.02)


def test_squares_merge_gradually(bench, rng):
    """With pixels of two colors, all squares reach the limit of contrast together."""
    sign = rng.choice([-0.5, 0.5], (HEIGHT, WIDTH, 1))

    def rendered(contrast):
        color = (0.5 + contrast * sign).repeat(3, axis=2).astype(np.float32)
        view = bench.view(color, 1.0 / 3.0, "radial")
        return bench.render(view, **STATE, white_level=1.0)

    low, high = 0.0, 0.5
    assert rendered(low).merged_count > rendered(high).merged_count
    for _ in range(12):
        middle = (low + high) / 2.0
        is_merged = rendered(middle).merged_count > WIDTH * HEIGHT / 2
        low, high = (middle, high) if is_merged else (low, middle)
    below, above = rendered(low), rendered(high)
    assert below.merged_count > above.merged_count + WIDTH * HEIGHT / 2
    assert np.abs(above.color.astype(float) - below.color).max() < 3e-4


@pytest.mark.gl
@pytest.mark.parametrize("spread_px", [2.0, 4.0])
def test_a_square_that_stops_merging_changes_no_pixel_at_once(gl_engine, spread_px):
    """Pixels of two colors, whose contrast passes the limit of merging."""
    bench = OneKernelBench(
        gl_engine, disc(3), width_px=32, height_px=32, spread_px=spread_px
    )
    limit = MERGE_CONTRAST * spread_px**MERGE_CONTRAST_POWER

    def frame(ratio):
        color = np.full((32, 32, 3), 0.4, np.float32)
        color[(X + Y)[:32, :32] % 2 == 0] += np.float32(ratio * limit)
        color[:, 24:] = 1.0  # white
        return bench.render(color, output="linear", render_tolerance=AS_DYNAMIC)

    below, above = frame(1.0 - STEP_RATIO / 2.0), frame(1.0 + STEP_RATIO / 2.0)
    assert above.merged_count < below.merged_count == 32 * 32
    assert np.abs(above.color - below.color).max() < 0.5 * STEP_RATIO
    for share in (0.1, 0.5, 1.0, 1.1):  # of the difference that is left
        ratio = 1.0 + share * MERGE_FADE_RATIO
        frame(ratio)
        made = made_fragments(bench, 32, 32)
        found = np.ptp(made.rgb[made.x < 24])
        assert found == pytest.approx(min(share, 1.0) * ratio * limit, rel=0.01)
