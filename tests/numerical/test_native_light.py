"""Loops of bright pixels and of the light beyond their kernels, against plain NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest

from estimator.native import shared_threads
from estimator.psf.tables import N_EDGE
from filter_service.native import loops
from filter_service.rendering import edge_kinds
from filter_service.rendering.edge_kinds import FADE_WHITE, BrightPixels
from filter_service.rendering.light_kernels import add_plane, add_sources, seen_by_edges
from filter_service.rgbd_view import RgbdView


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_bright_pixels_are_those_with_a_value_above_the_limit(rng, dtype):
    color = rng.uniform(0.0, 3.0, (37, 51, 3))
    color.reshape(-1)[rng.integers(0, color.size, 40)] = rng.uniform(3.0, 12.0, 40)
    color[0, 0], color[-1, -1] = 9.0, [np.inf, 5.0, np.nan]
    color[3, 4:7, 1] = np.inf, np.nan, -np.inf
    color = color.astype(dtype)
    view = RgbdView(color, np.ones((37, 51), np.float32), (-0.3, 0.3, 0.2, -0.2))
    pixels = BrightPixels.of(view, 1.25)
    brightest = np.where(np.isfinite(color), color, 0.0).astype(float).max(axis=2)
    low, high = FADE_WHITE
    part = np.clip((brightest / 1.25 - low) / (high - low), 0.0, 1.0)
    y_px, x_px = np.nonzero(part)
    np.testing.assert_array_equal(pixels.y_px, y_px)
    np.testing.assert_array_equal(pixels.x_px, x_px)
    share = (3.0 * part**2 - 2.0 * part**3)[y_px, x_px]
    np.testing.assert_allclose(pixels.share_ratio, share, rtol=1e-6)
    assert 0 < np.count_nonzero(share < 1.0) < share.size


def test_a_pixel_without_light_is_no_source():
    """A value that is not a number is above the limit of a view that is dark."""
    color = np.zeros((8, 9, 3), np.float32)
    color[2, 3], color[4, 5, 1] = 1.0, np.nan
    view = RgbdView(color, np.ones((8, 9), np.float32), (-0.3, 0.3, 0.2, -0.2))
    pixels = BrightPixels.of(view, 0.0)
    assert (pixels.x_px.tolist(), pixels.y_px.tolist()) == ([3], [2])


def test_many_bright_pixels_are_merged_with_all_their_light(rng):
    color = np.zeros((200, 300, 3), np.float32)
    color[20:120, 30:230] = rng.uniform(10.0, 90.0, (100, 200, 3))
    view = RgbdView(color, np.ones((200, 300), np.float32), (-0.3, 0.3, 0.2, -0.2))
    pixels = BrightPixels.of(view, 1.0)
    assert pixels.light.shape[0] <= edge_kinds.MAX_SOURCES < pixels.x_px.size
    np.testing.assert_allclose(
        pixels.light.sum(axis=0), color.sum(axis=(0, 1), dtype=np.float64), rtol=1e-6
    )
    weight = color.sum(axis=2, dtype=np.float64)
    middle = (weight * np.arange(300)).sum() / weight.sum()
    own = pixels.light.sum(axis=1)
    assert (pixels.source_px[:, 0] * own).sum() / own.sum() == pytest.approx(middle)


@pytest.mark.parametrize("blur_px", [0.0, 3.0, -5.0])
def test_the_light_of_a_round_edge_has_its_closed_form(blur_px):
    """lambda / (2 pi^3 D rho) [1 / (rho - g)^2 + 1 / (rho + g)^2], in um and um/px."""
    wavelength_um, radius_um_per_px = 0.55, 1.4
    angle = 2.0 * np.pi * np.arange(N_EDGE) / N_EDGE
    normal = np.stack([np.cos(angle), np.sin(angle)])
    tangent = np.stack([-np.sin(angle), np.cos(angle)])
    area = np.pi * radius_um_per_px**2
    turn = np.sin(2.0 * np.pi / N_EDGE)
    length = radius_um_per_px * 2.0 * np.pi / N_EDGE
    length *= wavelength_um / (4.0 * np.pi**2 * area)
    edge = np.concatenate(
        [
            blur_px * normal,
            tangent,
            normal,
            np.full((1, N_EDGE), length),
            np.full((1, N_EDGE), turn),
        ]
    )
    edges = np.broadcast_to(edge.astype(np.float32), (1, 3, 8, N_EDGE)).copy()
    rho_px = np.array([20.0, 28.0, 40.0, 160.0])
    directions = np.stack([np.cos([0.0, 0.3, 2.0]), np.sin([0.0, 0.3, 2.0])], axis=-1)
    polar = np.empty((1, 3, 8 * 3 + 1, 3), np.float32)
    loops().call(
        "fill_polar",
        *(shared_threads(), edges, np.zeros(1, np.int64)),
        *(np.ones((1, N_EDGE), np.float32), 1),
        *(rho_px.astype(np.float32), rho_px.size, directions.astype(np.float32), 3),
        *(8, polar),
    )
    low_px, high_px = rho_px - blur_px, rho_px + blur_px
    exact = wavelength_um / (4.0 * np.pi**3 * radius_um_per_px * rho_px)
    exact = exact * (1.0 / low_px**2 + 1.0 / high_px**2)
    found = polar[0, :, ::8, 1] / rho_px**3
    np.testing.assert_allclose(found, np.broadcast_to(exact, found.shape), rtol=0.012)


def doubled(coarse, axis, size):
    """Pixels of half the size along an axis, whose centers are at quarters."""
    at = (np.arange(size) + 0.5) / 2.0 - 0.5
    low = np.floor(at).astype(int)
    last = coarse.shape[axis] - 1
    near, far = (np.take(coarse, np.clip(low + k, 0, last), axis) for k in (0, 1))
    shape = [1] * coarse.ndim
    shape[axis] = size
    part = (at - low).reshape(shape)
    return near + part * (far - near)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 4), (33, 129), (6, 300)])
def test_a_plane_is_interpolated_between_its_pixels(rng, size):
    coarse = rng.random((*(-(-n // 2) for n in size), 3)).astype(np.float32)
    image = rng.random((*size, 3)).astype(np.float32)
    expected = image + doubled(doubled(coarse.astype(float), 0, size[0]), 1, size[1])
    add_plane(coarse, image)
    np.testing.assert_allclose(image, expected, rtol=5e-7)  # 32-bit floats


@pytest.mark.parametrize(("pitch_px", "is_split"), [(1, False), (3, False), (4, True)])
def test_sources_are_added_at_points_of_their_grid(rng, pitch_px, is_split):
    """Also those whose kernels end outside; kernels are zero outside their circle."""
    size_px, half, count = (41, 30), 5, 60
    number = np.sort(rng.integers(0, 2, count))
    source_px = rng.uniform(0.0, 1.0, (count, 2)) * [size_px[1] - 1, size_px[0] - 1]
    light = rng.uniform(0.0, 9.0, (count, 3))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    kernels = rng.random((2, 2 * half + 1, 2 * half + 1, 3)).astype(np.float32)
    kernels *= (x * x + y * y <= half * half)[..., None]
    is_image = pitch_px != 4
    shape = size_px if is_image else tuple(-(-n // pitch_px) for n in size_px)
    plane, margin = np.zeros((*shape, 3), np.float32), 2 * half
    padded = np.zeros((shape[0] + 2 * margin, shape[1] + 2 * margin, 3))
    for point, own, kernel in zip(source_px, light, kernels[number], strict=True):
        place = (point + 0.5) / pitch_px - 0.5
        corners = [(np.floor(place + 0.5).astype(int), 1.0)]
        if is_split:
            low = np.floor(place).astype(int)
            part = place - low
            corners = [
                (low + k, np.prod(np.where(k, part, 1.0 - part)))
                for k in np.ndindex(2, 2)
            ]
        for at, share in corners:
            column, row = (pitch_px * at + pitch_px // 2 if is_image else at) + margin
            rows = slice(row - half, row + half + 1)
            columns = slice(column - half, column + half + 1)
            padded[rows, columns] += share * own * kernel
    add_sources(
        *(plane, source_px, light, number, kernels),
        pitch_px=pitch_px,
        size_px=size_px,
        is_split=is_split,
        is_image=is_image,
    )
    inside = padded[margin : margin + shape[0], margin : margin + shape[1]]
    np.testing.assert_allclose(plane, inside, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("kind", ["radial", "planar"])
def test_rays_are_blocked_where_they_pass_behind_a_wall(kind):
    """A wall at 2 dpt from a column on, where rays have moved by 2 dpt times a shift.

    Elements whose ray passes the edge within a pixel see a part of the source.
    """
    wall_px, wall_dpt = 40, 2.0
    depth_m = np.full((50, 70), np.inf, np.float32)
    depth_m[:, wall_px:] = 1.0 / wall_dpt
    narrow = (-1e-3, 1e-3, 1e-3, -1e-3)  # depth along z is the distance
    view = RgbdView(np.zeros((50, 70, 3), np.float32), depth_m, narrow, kind)
    x_px = np.array([2, 30, 36, 39, 39])
    pixels = SimpleNamespace(
        source_at_px=np.stack([x_px, np.array([3, 25, 25, 10, 49])], axis=-1),
        object_dpt=np.full(5, 1e-6),
        source_surface=np.zeros(5, np.int64),
    )
    angle = 2.0 * np.pi * np.arange(N_EDGE) / N_EDGE
    shift_px = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    shift_px = shift_px * np.array([2.0, 6.0])[:, None, None]
    kinds = np.array([0, 1, 0, 0, 1])
    seen = seen_by_edges(view, pixels, kinds, shift_px)
    beyond_px = x_px[:, None] + wall_dpt * shift_px[kinds, :, 0] - (wall_px - 0.5)
    np.testing.assert_array_equal(seen[beyond_px < -1.0], 1.0)
    np.testing.assert_array_equal(seen[beyond_px > 1.0], 0.0)
    assert np.all((seen >= 0.0) & (seen <= 1.0))
    assert {0.0, 1.0} < set(seen.ravel().tolist())
