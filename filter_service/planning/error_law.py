"""Image error caused by blending neighboring PSFs.

The law is a fit to measurements; `python -m tests.benchmarks.plan_law` repeats it.  The
data are 3,600 random pairs of neighbors in defocus, pupil, accommodation and field,
from five eyes, pupils of 2 to 7 mm, fields to 40 x 25 deg and pixels of 0.8 to
3.5 mrad.  Each pair was blended half and half and compared with the exact PSF between
its members on linear 720p frames of the scene *Courtyard*.

Blending has two errors.  It doubles rays that are at a distance D from each other; this
error grows with D² relative to the blur.  Where rays do not move in proportion, it also
displaces the blend from the exact PSF; this error is of first order.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.planning.slopes import WEIGHTS

DOUBLING = 0.00463
ASIDE = 0.0248
BLUR_EXPONENT = 0.795
"""RMS error of the image, in units of white, at a difference and a blur of 1 px."""

SHARP_PX = 0.384
OWN_SHARE = 0.41
DIFFRACTION_SHARE = 2.9
"""Terms of the squared blur besides that of the rays: that of a pixel, px, and factors
of D² and of the squared wavelength over pupil diameter."""

AXIS_FACTOR = {
    "h": 1.15,
    "v": 1.0,
    "pupil": 0.8,
    "accommodation": 2.5,
    "defocus": 2.2,
}
"""Measured mean square error relative to that of the law, by interpolated axis."""

COHERENCE = 0.09
"""Degree to which the errors of several axes add as amplitudes, because all of them
blur."""

FLOOR = 1.8e-6
"""Mean square error that denser nodes do not remove: from rims of spots that cross a
pixel edge between two nodes, and from the transition between PSF methods.  `COHERENCE`
and `FLOOR` are from 36 whole plans of three eyes, measured and predicted (spread
0.7 dB)."""

LEAST_SHARE = 0.02
"""Least share of the total error for an axis, if the other axes have used all of it."""

MEAN_OF_HALF_WAY = 8.0 / 15.0
"""Mean square over an interval of 4 f (1 - f), the error relative to its middle."""


def mean_square(vectors_px: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean (P,) over the pupil of squared vectors (P, n, 2)."""
    return (WEIGHTS[:, None] * np.square(vectors_px)).sum(axis=(-2, -1))


def spot_covariance(slopes_px: NDArray[Any]) -> NDArray[np.float64]:
    """Return the covariance (P, 3) xx, yy, xy of landing points of rays, px²."""
    centered = slopes_px - (WEIGHTS[:, None] * slopes_px).sum(axis=-2, keepdims=True)
    x, y = centered[..., 0], centered[..., 1]
    return np.stack([(x * x) @ WEIGHTS, (y * y) @ WEIGHTS, (x * y) @ WEIGHTS], axis=-1)


def _blur_px2(
    covariance_px2: NDArray[Any], difference_px2: NDArray[Any], unit_px: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the blur (P,), px²: the geometric mean of the two principal variances."""
    xx, yy, xy = np.moveaxis(covariance_px2, -1, 0)
    more = (
        SHARP_PX**2
        + OWN_SHARE * difference_px2
        + DIFFRACTION_SHARE * np.square(unit_px)
    )
    return np.sqrt(np.maximum((xx + more) * (yy + more) - xy * xy, more * more))


def blend_error(
    lower_px: NDArray[Any],
    upper_px: NDArray[Any],
    exact_px: NDArray[Any],
    *,
    share_ratio: NDArray[Any],
    unit_px: NDArray[Any],
) -> NDArray[np.float64]:
    """Return the mean square error (P,) of images filtered with blends of two PSFs.

    Parameters
    ----------
    lower_px, upper_px, exact_px : (P, n, 2)
        Slopes of the neighbors and of the exact PSF between them.
    share_ratio : (P,)
        Share of the upper neighbor.
    unit_px : (P,)
        Wavelength over pupil diameter, px.
    """
    share = share_ratio[:, None, None]
    difference_px2 = mean_square(upper_px - lower_px)
    aside_px2 = mean_square((1.0 - share) * lower_px + share * upper_px - exact_px)
    blur_px2 = _blur_px2(spot_covariance(exact_px), difference_px2, unit_px)
    half_way = 4.0 * share_ratio * (1.0 - share_ratio)
    doubled = DOUBLING * half_way * difference_px2 / blur_px2**BLUR_EXPONENT
    # The error of a displacement beyond the blur saturates: image contrast is limited.
    aside_square = (
        ASIDE**2 * aside_px2 * (blur_px2 + aside_px2) ** (1.0 - 2.0 * BLUR_EXPONENT)
    )
    return doubled**2 + aside_square


def allowed_difference_px(
    covariance_px2: NDArray[Any],
    *,
    unit_px: NDArray[Any],
    half_way_error: float | NDArray[Any],
) -> NDArray[np.float64]:
    """Return the RMS difference (P,) of neighbors that causes an error half-way.

    Parameters
    ----------
    covariance_px2 : (P, 3)
        See `spot_covariance`.
    """
    difference_px2 = np.zeros(covariance_px2.shape[:-1])
    for _ in range(12):  # a contraction: the blur grows slower than the difference
        blur_px2 = _blur_px2(covariance_px2, difference_px2, unit_px)
        difference_px2 = half_way_error / DOUBLING * blur_px2**BLUR_EXPONENT
    return np.sqrt(difference_px2)


def half_way_error(axis: str, allowed_error: float) -> float:
    """Return the RMS error half-way between nodes for a mean square error."""
    return float(np.sqrt(allowed_error / MEAN_OF_HALF_WAY / AXIS_FACTOR[axis]))


def combined_error(errors: list[float]) -> float:
    """Return the mean square error of several interpolations together."""
    amplitude = float(np.sum(np.sqrt(errors)))
    return FLOOR + (1.0 - COHERENCE) * float(np.sum(errors)) + COHERENCE * amplitude**2


def equal_share(allowed_error: float, *, spent: list[float], count: int) -> float:
    """Return the mean square error that each remaining interpolation may add.

    Parameters
    ----------
    spent : list
        Errors of the interpolations whose nodes are known.
    count : int
        Number of remaining interpolations, which share equally.
    """
    # combined_error is a quadratic polynomial of their amplitude.
    square = (1.0 - COHERENCE) * count + COHERENCE * count**2
    linear = COHERENCE * count * float(np.sum(np.sqrt(spent)))
    left = allowed_error - combined_error(spent)
    if left <= 0.0:
        return LEAST_SHARE * allowed_error
    amplitude = (np.sqrt(linear**2 + square * left) - linear) / square
    return max(float(amplitude**2), LEAST_SHARE * allowed_error)


def psnr_db(mean_square_error: float) -> float:
    """Return the PSNR for a white of 1."""
    return float(-10.0 * np.log10(max(mean_square_error, 1e-12)))
