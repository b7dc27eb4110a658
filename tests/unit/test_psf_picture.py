"""The numbers and the picture that `ocufilter psf` gives of a kernel."""

import numpy as np
import pytest

from filter_service.psfs.picture import DECADES, draw_psf, half_light_radius_px


def _disc(radius_px, half_size_px):
    offset = np.arange(-half_size_px, half_size_px + 1)
    disc = (offset[:, None] ** 2 + offset**2 <= radius_px**2).astype(np.float32)
    return disc / disc.sum()


def test_half_of_a_uniform_disc_lies_within_its_radius_over_root_two():
    assert half_light_radius_px(_disc(40, 45)) == pytest.approx(
        40 / np.sqrt(2),
        abs=0.5,  # radii of a pixel grid come in steps below half a pixel here
    )


def test_a_point_has_no_radius():
    assert half_light_radius_px(_disc(0, 3)) == 0.0


def test_gray_falls_by_a_fixed_step_with_every_decade():
    kernel = np.zeros((401, 401), np.float32)
    kernel[0, :4] = [1.0, 0.1, 0.01, 10.0**-DECADES / 2]
    row = draw_psf(kernel, pixel_arcmin=1.0)[0, :5, 0]
    assert row.tolist() == [255, 191, 128, 0, 0]  # 255 (1 - k / 4), rounded


def test_small_kernels_are_enlarged_by_whole_squares():
    picture = draw_psf(_disc(0, 1), pixel_arcmin=1.0)
    assert picture.shape == (384, 384, 3)
    assert (picture[128:256, 128:256] == 255).all()
    assert (picture[:128, :128] == 0).all()


@pytest.mark.parametrize(
    ("pixel_arcmin", "bar_px"), [(1.0, 100), (0.05, 100), (13.0, 77)]
)
def test_the_scale_bar_is_as_long_as_it_says(pixel_arcmin, bar_px):
    kernel = np.zeros((401, 401), np.float32)
    kernel[0, 400] = 1.0  # white, away from the bar
    picture = draw_psf(kernel, pixel_arcmin=pixel_arcmin)
    middle_of_bar = picture[401 - 12 - 3, :, 0]
    # outlined in black: two pixels of its length show no white
    assert np.count_nonzero(middle_of_bar == 255) == bar_px - 1
