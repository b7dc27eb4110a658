"""Wiener filters and the acuity of pictures, to which `bench correct` compares."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from estimator.acuity.observer import log_mar_of
from estimator.acuity.transfer import Transfer
from filter_service.camera import Camera
from tests.benchmarks.wiener_pictures import (
    REGULARIZATIONS,
    STEP_CPD,
    by_one_psf,
    by_tiles,
    log_mar_of_picture,
    psf_at,
)

pytestmark = pytest.mark.tools

SHAPE = (72, 96, 3)
CAMERA = Camera.from_fov(72 / 60.0, width_px=96, height_px=72)  # 30 cycles per degree


class Blur:
    """A Gaussian blur, wider to the right if it varies."""

    color_shape = image_shape = SHAPE

    def __init__(self, sigma_px, *, varies=False):
        self.sigma_px = sigma_px
        x = np.linspace(0.0, 1.0, SHAPE[1])[:, None]
        self.share = np.where(varies, x, 0.0)

    def _blurred(self, image, sigma_px):
        return gaussian_filter(image, (sigma_px, sigma_px, 0.0), mode="nearest")

    def forward(self, color):
        parts = self._blurred(color, self.sigma_px), self._blurred(color, 3.0)
        found = (1.0 - self.share) * parts[0] + self.share * parts[1]
        return found.astype(np.float32)


@pytest.fixture
def target(rng):
    """Smooth light well between black and white."""
    noise = gaussian_filter(rng.standard_normal(SHAPE), (6.0, 6.0, 0.0))
    return (0.5 + 0.1 * noise / np.abs(noise).max()).astype(np.float32)


def errors(operator, pictures, target):
    return [np.sqrt(np.mean((operator.forward(x) - target) ** 2)) for x in pictures]


def test_a_point_is_moved_to_the_middle():
    psf = psf_at(Blur(2.0), 30, 40)
    assert np.unravel_index(psf[..., 0].argmax(), SHAPE[:2]) == (36, 48)
    assert np.isclose(psf.sum(), 3.0, rtol=1e-3)


@pytest.mark.parametrize("filters", [by_one_psf, by_tiles])
def test_little_regularization_undoes_a_blur(target, filters):
    operator = Blur(2.0)
    found = errors(operator, filters(operator, target), target)
    assert len(found) == len(REGULARIZATIONS)
    (plain,) = errors(operator, [target], target)
    assert min(found) < 0.2 * plain
    assert found[-1] > plain  # a matched filter, which blurs again


def test_tiles_follow_a_blur_that_varies(target):
    operator = Blur(1.0, varies=True)
    one, tiles = (
        min(errors(operator, filters(operator, target), target))
        for filters in (by_one_psf, by_tiles)
    )
    assert tiles < 0.7 * one


@pytest.mark.parametrize("sigma_px", [1.5, 4.0])
def test_the_acuity_is_that_of_the_blur(rng, sigma_px):
    meant = rng.random(SHAPE)
    blurred = gaussian_filter(meant, (sigma_px, sigma_px, 0.0), mode="wrap")
    along_cpd = STEP_CPD * np.arange(-81, 82)
    radial_px = np.hypot(along_cpd[:, None], along_cpd) / 60.0  # cycles per pixel
    ratio = np.exp(-2.0 * (np.pi * sigma_px * radial_px) ** 2) * (radial_px < 0.5)
    wanted = log_mar_of(Transfer(along_cpd, ratio.astype(np.complex128)))
    assert abs(log_mar_of_picture(blurred, meant, CAMERA) - wanted) < 0.02


def test_less_contrast_means_less_acuity(rng):
    meant = rng.random(SHAPE)
    full, quarter = (
        log_mar_of_picture(0.5 + contrast * (meant - 0.5), meant, CAMERA)
        for contrast in (1.0, 0.25)
    )
    assert full < quarter
