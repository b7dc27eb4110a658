"""A hidden layer against closed forms, rays through a lens, and its numpy twin."""

from dataclasses import replace

import numpy as np
import pytest

from filter_service import constants
from filter_service.errors import BadMessage
from filter_service.rendering.frame import border_px_of
from filter_service.rgbd_view import RgbdView
from tests.numerical.made_fragments import made_fragments
from tests.numerical.synthetic import Bench, assert_same_frame, psnr_db, texture
from tests.reference import render_passes as reference
from tests.reference.lens_picture import NOTHING, Lens, lens_picture

EMMETROPE = {"kind": "prescription", "sphere_dpt": 0.0}
PURE = {"diffraction": False, "chromatic": False, "kept_energy_ratio": 0.9999}
SIZE = {"width_px": 97, "height_px": 75, "vertical_fov_deg": 6.0}
WIDTH, HEIGHT = SIZE["width_px"], SIZE["height_px"]
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
Y, X = np.mgrid[:HEIGHT, :WIDTH]
DISC = np.hypot(X - WIDTH // 2, Y - HEIGHT // 2) < 15
NEAR_DPT, FAR_DPT = 2.5, 0.5


@pytest.fixture(scope="module")
def bench(engine):
    return Bench(engine, EMMETROPE, **SIZE, **PURE)


def layered(bench, mask, near, far, *, near_dpt=NEAR_DPT, far_dpt=FAR_DPT):
    """One thing before another, with what it hides."""
    near_m, far_m = (
        np.broadcast_to(np.float32(1.0) / np.float32(d), mask.shape)
        for d in (near_dpt, far_dpt)
    )
    color = np.where(mask[..., None], near, far).astype(np.float32)
    far = np.broadcast_to(far, color.shape).astype(np.float32)
    return RgbdView(
        color,
        np.where(mask, near_m, far_m),
        bench.tangents,
        "radial",
        hidden_color=far,
        hidden_depth_m=np.where(mask, far_m, np.float32(0.0)),
    )


def disc_view(bench, rng, **distances):
    near = texture(rng, HEIGHT, WIDTH, cell_px=6) * 0.5 + 0.5
    far = texture(rng, HEIGHT, WIDTH, cell_px=3) * 0.5
    return layered(bench, DISC, near, far, **distances)


def traced(bench, view, *, focus_dpt, **options):
    """Truth by rays; the eye of these tests is a thin lens."""
    seen_dpt = 1.0 / view.depth_m.astype(float)
    holds = view.hidden_depth_m > 0.0
    hidden_m = np.where(holds, view.hidden_depth_m, 1.0)
    lens = Lens(STATE["pupil_diameter_mm"], focus_dpt, bench.spec.pixel_pitch_mrad)
    return lens_picture(
        [view.color, view.hidden_color],
        [seen_dpt, np.where(holds, 1.0 / hidden_m, NOTHING)],
        lens,
        **options,
    )


def disc_edge_spread(distance_px, radius_px):
    """Part of a uniform disc on the far side of a line (its circular segment)."""
    t = np.clip(distance_px / radius_px, -1.0, 1.0)
    return (np.arccos(t) - t * np.sqrt(1.0 - t**2)) / np.pi


def test_blurred_half_plane_over_a_uniform_background_is_its_edge_spread(bench):
    near, far = np.array([0.9, 0.5, 0.2]), np.array([0.1, 0.4, 0.8])
    view = layered(bench, X < 48, near, far)
    shown = bench.render(view, **STATE, merge=False).color
    radius_px = (NEAR_DPT - FAR_DPT) * 2.0 / bench.spec.pixel_pitch_mrad[0]
    assert radius_px > 2.5
    share = disc_edge_spread(np.arange(WIDTH) - 47.5, radius_px)[None, :, None]
    truth = share * near + (1.0 - share) * far
    assert np.abs(shown - truth).max() < 2e-3  # to the image's very border
    lacking = replace(view, hidden_color=None, hidden_depth_m=None)
    one_layer = bench.render(lacking, **STATE, merge=False).color
    assert np.abs(one_layer - truth).max() > 0.2


@pytest.mark.parametrize(
    ("focus_dpt", "one_db", "two_db"), [(0.5, 35.0, 55.0), (2.5, 50.0, 58.0)]
)
def test_two_layers_are_what_a_lens_sees(bench, rng, focus_dpt, one_db, two_db):
    view = disc_view(bench, rng)
    state = STATE | {"focus_dpt": focus_dpt}
    truth = traced(bench, view, focus_dpt=focus_dpt, ray_count=256)
    lacking = replace(view, hidden_color=None, hidden_depth_m=None)
    two = bench.render(view, **state, merge=False).color
    one = bench.render(lacking, **state, merge=False).color
    assert psnr_db(two, truth) >= two_db
    assert psnr_db(one, truth) < one_db


def test_a_surface_hidden_in_part_is_lit_by_its_whole_kernel(bench, rng):
    """Focused between two blurred surfaces: no side of the far one comes first."""
    view = disc_view(bench, rng)
    state = STATE | {"focus_dpt": 1.5}
    shown = bench.render(view, **state, merge=False).color
    turned = {
        name: np.ascontiguousarray(getattr(view, name)[::-1, ::-1])
        for name in ("color", "depth_m", "hidden_color", "hidden_depth_m")
    }
    again = bench.render(replace(view, **turned), **state, merge=False).color
    assert np.abs(again[::-1, ::-1] - shown).max() < 1e-4
    truth = traced(bench, view, focus_dpt=1.5, ray_count=512)
    assert psnr_db(shown, truth) >= 45.0


@pytest.mark.parametrize("accumulation", ["coverage", "paper"])
def test_two_layers_equal_the_sorted_gather(bench, rng, accumulation):
    slant_dpt = 0.3 + 1.2 * Y / HEIGHT
    view = disc_view(bench, rng, near_dpt=2.0 + 0.01 * X, far_dpt=slant_dpt)
    result = bench.render(view, **STATE, merge=False, accumulation=accumulation)
    layers = bench.layers(**STATE)
    truth = reference.gather(view, bench.store, layers, accumulation=accumulation)
    assert psnr_db(result.color, truth) >= 60.0


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan])
def test_nothing_hidden_changes_nothing_and_is_never_filled_in(bench, rng, nothing):
    view = disc_view(bench, rng)
    empty = np.full_like(view.depth_m, nothing)
    alone = replace(view, hidden_color=None, hidden_depth_m=None)
    with_empty = bench.render(replace(view, hidden_depth_m=empty), **STATE)
    assert with_empty.missing_depth_count == 0
    assert_same_frame(
        with_empty.color, bench.render(alone, **STATE).color, is_exact=bench.gpu is None
    )
    holes = np.where(X < 40, view.hidden_depth_m, np.float32(nothing))
    zeros = np.where(X < 40, view.hidden_depth_m, np.float32(0.0))
    some, same = (
        bench.render(replace(view, hidden_depth_m=d), **STATE).color
        for d in (holes, zeros)
    )
    assert_same_frame(some, same, is_exact=bench.gpu is None)
    assert np.abs(some - bench.render(view, **STATE).color).max() > 0.01


def test_what_no_edge_uncovers_makes_no_fragments(bench, rng):
    """A wall hides a whole room; and a disc only as far as its blur lets light pass."""
    wall = np.full((HEIGHT, WIDTH), True)
    view = layered(bench, wall, texture(rng, HEIGHT, WIDTH), np.ones(3))
    hidden = bench.render(view, **STATE, merge=False)
    border_px = border_px_of(view, bench.layers(**STATE), bench.handle.image)
    seen_count = (WIDTH + 2 * border_px) * (HEIGHT + 2 * border_px)
    assert hidden.fragment_count == seen_count
    some = bench.render(disc_view(bench, rng), **STATE, merge=False)
    assert 0 < some.fragment_count - seen_count <= DISC.sum()


def test_hidden_pixels_just_behind_what_is_seen_make_no_fragments(bench, rng):
    step_dpt = constants.DISCONTINUITY_PX / bench.layers(**STATE).blur_px_per_dpt
    edge = np.where(X < 48, 2.0, 1.0)
    counts = []
    for behind in (0.9, 1.1):
        view = layered(bench, X >= 0, np.zeros(3), np.ones(3), near_dpt=edge)
        hidden_m = (1.0 / (edge - behind * step_dpt)).astype(np.float32)
        view = replace(view, hidden_depth_m=hidden_m)
        counts.append(bench.render(view, **STATE, merge=False).fragment_count)
    assert counts[1] > counts[0] + 1000


def test_strips_change_nothing(gl_engine, rng, monkeypatch):
    bench = Bench(gl_engine, EMMETROPE, **SIZE, **PURE)
    view = disc_view(bench, rng)
    whole = bench.render(view, **STATE)
    rows = 2 * 16 + 32  # halos, and tile rows between
    monkeypatch.setattr(bench.gpu, "max_block_bytes", 2 * 16 * 120 * rows)
    room = np.empty_like(whole.color)
    cut = bench.render(view, **STATE, out=room)
    assert cut.color is room
    assert cut.fragment_count > whole.fragment_count
    assert psnr_db(cut.color, whole.color.astype(float)) >= 80.0


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"hidden_color": None}, "hidden_color"),
        ({"hidden_depth_m": None}, "hidden_depth"),
        ({"hidden_depth_m": np.ones((3, 3), np.float32)}, "hidden_depth"),
        ({"hidden_depth_m": np.ones((HEIGHT, WIDTH))}, "hidden_depth"),
        ({"hidden_color": np.ones((HEIGHT, WIDTH, 3), np.uint8)}, "hidden_color"),
        ({"hidden_color": np.ones((HEIGHT, WIDTH, 4), np.float32)}, "hidden_color"),
    ],
)
def test_a_hidden_layer_that_does_not_fit_is_refused(bench, rng, changes, field):
    view = disc_view(bench, rng)
    with pytest.raises(BadMessage) as caught:
        bench.render(replace(view, **changes), **STATE)
    assert caught.value.field == field
    assert caught.value.allowed


def test_bad_color_counts_only_where_something_is_hidden(bench, rng):
    view = disc_view(bench, rng)
    view.hidden_color[0, 0] = np.nan  # nothing is hidden here
    view.hidden_color[HEIGHT // 2, WIDTH // 2] = np.inf
    result = bench.render(view, **STATE)
    assert result.bad_color_count == 1
    assert np.isfinite(result.color).all()


# Other stores come last: a renderer keeps its kernels on the GPU for the next frame.


def test_two_layers_of_odd_bytes_over_the_field_equal_the_gather(engine, rng):
    size = {"width_px": 45, "height_px": 33, "vertical_fov_deg": 40.0}
    bench = Bench(engine, EMMETROPE, **size, mode="dynamic")
    color, hidden = rng.integers(0, 256, (2, 33, 45, 3), dtype=np.uint8)
    mask = np.arange(45)[None, :] < 20
    depth_m = np.where(mask, 0.15, 4.0)
    view = bench.view(color, depth_m)
    holds = np.broadcast_to(np.where(mask, np.float32(4.0), np.float32(0.0)), (33, 45))
    view = replace(view, hidden_color=hidden, hidden_depth_m=holds.copy())
    result = bench.render(view, merge=False)
    truth = reference.gather(view, bench.store, bench.layers())
    assert psnr_db(result.color, truth) >= 60.0


def test_surfaces_never_merge_with_each_other(engine):
    bench = Bench(engine, {"kind": "prescription", "sphere_dpt": -6.0}, **SIZE)
    red, blue = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    view = layered(bench, DISC, red, blue, near_dpt=1.2, far_dpt=0.2)
    result = bench.render(view)
    border_px = border_px_of(view, bench.layers(), bench.handle.image)
    made = made_fragments(bench, WIDTH + 2 * border_px, HEIGHT + 2 * border_px, 2)
    hidden = made.surface == 1
    assert (made.edge_px[hidden] > 1).any()
    assert set(map(tuple, made.rgb[~hidden])) == {tuple(red), tuple(blue)}
    assert set(map(tuple, made.rgb[hidden])) == {tuple(blue)}
    assert hidden.size == result.fragment_count


def test_hidden_depth_beyond_the_prepared_distances_is_counted(engine, rng):
    bench = Bench(engine, EMMETROPE, **SIZE, object_range_dpt=(0.5, 2.0))
    view = disc_view(bench, rng, near_dpt=1.5, far_dpt=0.25)
    result = bench.render(view, **STATE)
    # Everything far, and what the disc hides of it.
    assert result.clamped_depth_count == WIDTH * HEIGHT
