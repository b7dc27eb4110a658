"""Sampling of wave-optical PSFs.

One FFT computes the wave-optical PSF of a wavefront, and a filter integrates it exactly
over pixels, because the angular samples per pixel are a whole number.  The edge of the
pupil is low-pass filtered, so that its diffracted light does not alias into the window.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.psf.tables import EDGE_HALF_WIDTH, FAST_LENGTHS, MARGIN_PX


@dataclass(frozen=True)
class FourierAccuracy:
    """Sampling parameters of an accuracy level.

    Attributes
    ----------
    oversampling : float
        Minimum number of angular samples per lambda/D.  With 2 or more, the intensity
        is not aliased.  Fewer suffice if a pixel contains many samples, because it
        averages the undersampled fringes.
    min_samples_per_px : int
        Samples per pixel below which the oversampling is increased, up to 2.
    margin : float
        Margin of the window on each side of the geometric spot, lambda/D.
    filter_half_width : int
        Extent of the pixel filter beyond the pixel, samples.
    """

    oversampling: float
    min_samples_per_px: int
    margin: float
    filter_half_width: int


ACCURACY = {
    "normal": FourierAccuracy(
        oversampling=1.0, min_samples_per_px=7, margin=8.0, filter_half_width=4
    ),
    "fine": FourierAccuracy(
        oversampling=2.0, min_samples_per_px=8, margin=16.0, filter_half_width=8
    ),
    "finest": FourierAccuracy(
        oversampling=2.0, min_samples_per_px=8, margin=64.0, filter_half_width=8
    ),
}


class FftTooLong(ValueError):
    """A PSF is too wide for the longest FFT of the wave method."""


@dataclass(frozen=True)
class FourierPlan:
    """Grids of M PSFs; columns are x and y.

    Attributes
    ----------
    length_count : (M, 2) int64
        FFT lengths.
    samples_per_px_count : (M, 2) int64
        Angular samples per pixel.
    pupil_samples : (M, 2)
        Samples across the bounding box of the pupil, in general not integers.
    """

    length_count: NDArray[np.int64]
    samples_per_px_count: NDArray[np.int64]
    pupil_samples: NDArray[np.float64]


def plan_grids(
    *,
    extent_px: NDArray[np.float64],
    unit_px: NDArray[np.float64],
    accuracy: FourierAccuracy,
    lengths: NDArray[np.int64] = FAST_LENGTHS,
) -> FourierPlan:
    """Return the smallest grids whose windows contain the spots and their margins.

    Parameters
    ----------
    extent_px : (M, 2)
        Sides of the geometric spots.
    unit_px : (M, 2)
        lambda/D in pixels.
    accuracy : FourierAccuracy
    lengths : (n,) int64
        Allowed FFT lengths, ascending.

    Raises
    ------
    FftTooLong
        A window exceeds the largest length.
    """
    margin_px = np.maximum(accuracy.margin * unit_px, MARGIN_PX)
    window_px = extent_px + 2.0 * margin_px
    samples_per_px = np.maximum(
        np.ceil(accuracy.oversampling / unit_px),
        np.minimum(np.ceil(2.0 / unit_px), accuracy.min_samples_per_px),
    )
    while True:
        wanted = window_px * samples_per_px
        if wanted.size and wanted.max() > lengths[-1]:
            raise FftTooLong(
                f"wave PSF needs an FFT of {wanted.max():.0f} samples; at most "
                f"{lengths[-1]} are allowed: use the geometric method"
            )
        length = lengths[np.searchsorted(lengths, wanted)]
        pupil = length / (samples_per_px * unit_px)
        too_wide = pupil + 2 * EDGE_HALF_WIDTH > length
        if not too_wide.any():
            return FourierPlan(length, samples_per_px.astype(np.int64), pupil)
        samples_per_px += too_wide
