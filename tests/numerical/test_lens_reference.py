"""The rays through a lens against closed forms."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from tests.reference.lens_picture import NOTHING, Lens, lens_picture

pytestmark = pytest.mark.tools

LENS = Lens(5.0, 0.5, (1.25, 1.25))
PX_PER_DPT = 2.0
SHAPE = (30, 44)


def disc(radius_px, size, n=40):
    """Uniform disc integrated over pixels by n x n points each."""
    at = (np.arange(size * n) + 0.5) / n - size / 2
    inside = at[:, None] ** 2 + at[None] ** 2 <= radius_px**2
    kernel = inside.reshape(size, n, size, n).mean(axis=(1, 3))
    return kernel / kernel.sum()


@pytest.mark.parametrize("distance_dpt", [0.0, 2.5, 3.1])
def test_a_plane_is_convolved_with_the_disc_of_its_defocus(rng, distance_dpt):
    image = rng.random((*SHAPE, 3))
    seen = lens_picture([image], [np.full(SHAPE, distance_dpt)], LENS, ray_count=4096)
    kernel = disc(abs(distance_dpt - 0.5) * PX_PER_DPT, 15)
    truth = fftconvolve(image, kernel[..., None], mode="same")
    inside = (slice(7, -7), slice(7, -7))
    assert np.abs(seen - truth)[inside].max() < 5e-3


def test_a_plane_in_focus_is_itself(rng):
    image = rng.random((*SHAPE, 3))
    seen = lens_picture([image], [np.full(SHAPE, 0.5)], LENS, ray_count=64)
    assert np.abs(seen - image).max() < 1e-12


def test_a_slope_has_no_cracks(rng):
    """0.2 px of blur a pixel; what is behind it may not be seen."""
    slope_dpt = 0.1 * np.arange(SHAPE[1])[None, :] * np.ones((SHAPE[0], 1))
    bright = np.full((*SHAPE, 3), 1.0)
    behind = np.full(SHAPE, 0.0)
    behind[:, :4] = NOTHING
    seen = lens_picture(
        [bright, 0.0 * bright], [slope_dpt, behind], LENS, ray_count=256
    )
    assert seen[:, 12:].min() == 1.0


@pytest.mark.parametrize(
    ("ray_count", "most"),
    [(500, 5e-3), pytest.param(8192, 2e-3, marks=pytest.mark.slow)],
)
def test_a_blurred_edge_spreads_as_the_segment_of_a_disc(ray_count, most):
    columns = np.arange(SHAPE[1])
    near = np.broadcast_to(columns < 22, SHAPE)
    white, black = np.ones((*SHAPE, 3)), np.zeros((*SHAPE, 3))
    layers = [np.where(near, 3.0, 0.5), np.where(near, 0.5, NOTHING)]
    color = np.where(near[..., None], white, black)
    seen = lens_picture([color, black], layers, LENS, ray_count=ray_count)
    t = np.clip((columns - 21.5) / 5.0, -1.0, 1.0)
    truth = (np.arccos(t) - t * np.sqrt(1.0 - t**2)) / np.pi
    assert np.abs(seen - truth[None, :, None]).max() < most


def test_rays_that_pass_a_near_edge_see_what_it_hides():
    """Focused before the far plane, they cross: the far side is seen round the edge."""
    columns = np.arange(SHAPE[1])
    near = np.broadcast_to(columns < 22, SHAPE)
    layers = [np.where(near, 3.0, 0.0), np.where(near, 0.0, NOTHING)]
    lens = Lens(5.0, 1.5, (1.25, 1.25))
    hidden = np.ones((*SHAPE, 3))
    color = np.zeros((*SHAPE, 3))
    seen = lens_picture([color, hidden], layers, lens, ray_count=500)
    # Half a pixel beside the edge: rays beyond 0.5 px of the discs' 3 px pass
    # the near plane and end behind it.
    t = 0.5 / 3.0
    share = (np.arccos(t) - t * np.sqrt(1.0 - t**2)) / np.pi
    assert np.abs(seen[:, 21:23] - share).max() < 5e-3
