"""Tables and constants of the PSF engine in C, each defined once.

SciPy is imported where it is used: the service is ready before it loads SciPy.
"""

import math
from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native.records import PsfTables, pointer_to
from estimator.optics.zernike import (
    N_TERMS,
    exponents,
    inverse_monomial_matrix,
    monomial_matrix,
    radial_order,
)

VECTOR = 8

BASE_DB = 41.56
PER_RMS_DB = 7.40
PER_PIXEL_DB = 5.88
PER_NARROW_DB = 2.58
"""PSNR of ray optics: constant, and slopes per decade of the RMS in waves, of the pixel
in lambda/D, and of one plus `survey.PupilSurvey.narrow_ratio`."""

GEOMETRIC_FROM_DB = 51.0
CROSS_FADE_DB = 0.5
"""Predicted PSNR from which kernels of both engines are blended, and width of the
blend, above which only ray optics is used.  The blend is narrow because it costs both
engines; the step that it smooths has a PSNR above 50 dB."""

FILTER_COUNT = 256
"""Largest number of samples per pixel with a tabulated filter: pixels of 14 mrad,
pupils of 8 mm."""


MARGIN_PX = 1.6
"""Minimum margin of the window, px: it contains the neighbors of the spot's pixels.

For large pupils, a pixel is 16 lambda/D wide, and its neighbors contain up to 10 % of
the light of a sharp spot.  The mean edge light would be too inaccurate there: 7 % L2
error instead of 2 %.
"""

MAX_LENGTH = 4096
"""Longest FFT."""


def _fast_lengths() -> NDArray[np.int64]:
    """Return 5-smooth FFT lengths that are multiples of eight.

    Their measured cost per sample is within 20 % of the cost of powers of two.
    """
    found = {
        2**a * 3**b * 5**c for a in range(3, 15) for b in range(6) for c in range(4)
    }
    return np.array(sorted(n for n in found if 32 <= n <= MAX_LENGTH))


FAST_LENGTHS = _fast_lengths()

EDGE_HALF_WIDTH = 8
"""Number of samples by which the smoothed pupil extends beyond its edge."""

EDGE_STEPS = 256
"""Entries per sample of the tabulated step response."""


_EDGE_TAPER = 3.75


@lru_cache(maxsize=1)
def edge_response() -> NDArray[np.float32]:
    """Return the step response of a Kaiser-windowed sinc, in steps of 1/256 sample.

    With a half width of 8 and beta = 3.75, light from the edge of the pupil passes up
    to 0.43 of the window and is attenuated by 40 dB from 0.57 on, so little of it
    aliases.  Measurements with wider or less tapered windows were no better.
    """
    from scipy.special import i0

    t: NDArray[Any] = np.arange(
        -EDGE_HALF_WIDTH * EDGE_STEPS, EDGE_HALF_WIDTH * EDGE_STEPS + 1
    )
    t = t / EDGE_STEPS
    window = i0(
        _EDGE_TAPER * np.sqrt(np.maximum(0.0, 1.0 - (t / EDGE_HALF_WIDTH) ** 2))
    )
    impulse = np.sinc(t) * window
    steps: NDArray[np.float64] = np.concatenate(
        [[0.0], np.cumsum((impulse[1:] + impulse[:-1]) / 2.0)]
    )
    ratio: NDArray[np.float32] = (steps / steps[-1]).astype(np.float32)
    return ratio


@lru_cache(maxsize=256)
def pixel_filter(samples_per_px: int, half_width: int) -> NDArray[np.float32]:
    """Return weights that integrate a band-limited intensity over one pixel.

    Weight l belongs to the sample at l - reach from the center of the pixel, with reach
    = ceil(k/2) + half_width and k samples per pixel.  The weights follow from sinc
    interpolation, (Si(pi b) - Si(pi a)) / pi for distances a and b to the edges of the
    pixel, tapered outside the pixel.  Their sum is k.
    """
    from scipy.special import sici

    reach = (samples_per_px + 1) // 2 + half_width
    t = np.arange(-reach, reach + 1)
    half = samples_per_px / 2.0
    weights: NDArray[np.float64] = (
        sici(np.pi * (t + half))[0] - sici(np.pi * (t - half))[0]
    ) / np.pi
    beyond = np.clip((np.abs(t) - half) / (half_width + 1.0), 0.0, 1.0)
    weights *= np.cos(np.pi / 2.0 * beyond) ** 2
    weights *= samples_per_px / weights.sum()
    return weights.astype(np.float32)


def _even_polynomial(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> tuple[float, ...]:
    """Return the polynomial in z = t², t in [-1/2, 1/2], through 7 Chebyshev nodes."""
    nodes = (1.0 + np.cos(np.pi * (np.arange(7) + 0.5) / 7.0)) / 8.0
    coefficients = np.polynomial.polynomial.polyfit(nodes, function(np.sqrt(nodes)), 6)
    return tuple(float(np.float32(c)) for c in coefficients)


COSINE_OF_TURNS = _even_polynomial(lambda t: np.cos(2.0 * np.pi * t))
SINE_OF_TURNS = _even_polynomial(lambda t: np.sin(2.0 * np.pi * t) / t)
"""Polynomials of cos(2 pi t) and sin(2 pi t) / t, to 3e-7: range reduction is then one
floor, and the loop vectorizes."""

MIN_CELLS = 32
MAX_CELLS = 192
"""Cells across the pupil; more than 192 have no visible effect."""

CELLS_PER_PX = 1.2
"""Cells per pixel of blur: footprints are then at most about a pixel wide."""

MIN_EDGE_POINTS = 64
EDGE_POINTS_PER_PX = 3.0
NEAR_PX = 2
FAR_PX = 6
"""Distances from the image of the edge within which its light is sampled at steps of
half a pixel and of one pixel; farther out, its mean is used (`psf_tails.h`)."""

MIN_CURVATURE_RATIO = 0.1
"""Ratio to the curvature of the wavefront below which the curvature along the edge
counts as zero: the image of the edge has a cusp there, where the straight-edge
approximation fails."""


FRESNEL_LIMIT = 14.0
"""Limit of the table of straight-edge diffraction; fringes beyond it are averaged."""

_FRESNEL_STEPS = 4096


@lru_cache(maxsize=1)
def fresnel_table() -> NDArray[np.float64]:
    """Return the integral of straight-edge diffraction minus the geometric shadow.

    The irradiance is (1/2)[(1/2+C)² + (1/2+S)²]; the integral starts in the shadow.
    """
    from scipy.special import fresnel

    fine = 16
    v = np.linspace(-FRESNEL_LIMIT, FRESNEL_LIMIT, fine * _FRESNEL_STEPS + 1)
    s, c = fresnel(v)
    difference = 0.5 * ((0.5 + c) ** 2 + (0.5 + s) ** 2)
    difference -= np.where(v > 0.0, 1.0, np.where(v < 0.0, 0.0, 0.5))
    steps = (difference[1:] + difference[:-1]) * (v[1] - v[0]) / 2.0
    dark = 1.0 / (2.0 * math.pi**2 * FRESNEL_LIMIT)
    table = dark + np.concatenate([[0.0], np.cumsum(steps)])
    return np.ascontiguousarray(table[::fine])


N_EDGE = 48
_RING_RADII = (0.2, 0.35, 0.5, 0.65, 0.8, 0.9)
N_RING = 24


def _sample_points() -> tuple[NDArray[Any], NDArray[Any]]:
    edge = 2.0 * math.pi * np.arange(N_EDGE) / N_EDGE
    ring = 2.0 * math.pi * np.arange(N_RING) / N_RING
    x = [np.cos(edge)] + [r * np.cos(ring) for r in _RING_RADII] + [np.zeros(1)]
    y = [np.sin(edge)] + [r * np.sin(ring) for r in _RING_RADII] + [np.zeros(1)]
    return np.concatenate(x), np.concatenate(y)


POINTS = np.stack(_sample_points())


def _monomial_slopes(n_terms: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the slopes (n_terms, n) of every monomial at `POINTS`."""
    (x, y), a, b = POINTS, *np.split(exponents(n_terms), 2, axis=1)
    d_x = a * x ** np.maximum(a - 1, 0) * y**b
    d_y = b * x**a * y ** np.maximum(b - 1, 0)
    return d_x, d_y


_N_RADIAL = 8


def _passed_points() -> tuple[NDArray[Any], NDArray[Any]]:
    """Return powers (6, n) of points on rings of the unit disc, and ring weights (8,).

    The last ring is the edge, which has no weight.
    """
    node, weight = np.polynomial.legendre.leggauss(_N_RADIAL)
    rings = np.append(np.sqrt((node + 1.0) / 2.0), 1.0)
    angle = 2.0 * math.pi * np.arange(N_RING) / N_RING
    x, y = (np.outer(rings, f(angle)).ravel() for f in (np.cos, np.sin))
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]), weight / 2.0


PASSED_POWERS, RING_WEIGHTS = _passed_points()


_RADII = {6: (1.0, 0.78, 0.43, 0.0)}


def polynomial_nodes(n_terms: int) -> NDArray[np.float64]:
    """Return nodes (n_terms, 2) that determine a polynomial.

    The nodes of order 6 are on rings of 13, 9, 5 and 1.  The radii for other orders are
    zeros of a Chebyshev polynomial.
    """
    order = radial_order(n_terms)
    counts = range(2 * order + 1, 0, -4)
    angles = math.pi * (np.arange(len(counts)) + 0.5) / (order + 1)
    radii = _RADII.get(order, np.cos(angles))
    points = [
        (radius * math.cos(angle), radius * math.sin(angle))
        for radius, count in zip(radii, counts, strict=True)
        for angle in 2.0 * math.pi * np.arange(count) / count
    ]
    return np.array(points)


def _pupil_tables(n_terms: int) -> dict[str, NDArray[np.generic]]:
    """Return the tables that pupils with a number of Zernike terms need."""
    n_points = POINTS.shape[1]
    slopes = np.zeros((2, n_terms, -(-n_points // VECTOR) * VECTOR), np.float32)
    for padded, values in zip(slopes, _monomial_slopes(n_terms), strict=True):
        padded[:, :n_points] = values
        padded[:, n_points:] = values[:, -1:]
    nodes, (a, b) = polynomial_nodes(n_terms), exponents(n_terms).T
    from_nodes = np.linalg.inv(nodes[:, :1] ** a * nodes[:, 1:] ** b)
    return {
        "edge_xy": POINTS[:, :N_EDGE].astype(np.float32),
        "passed_powers": PASSED_POWERS,
        "ring_weights": RING_WEIGHTS,
        "monomials": monomial_matrix(n_terms),
        "zernike_terms": inverse_monomial_matrix(n_terms),
        "node_xy": nodes.T,
        "from_nodes": from_nodes.T,
        "slope_x": slopes[0],
        "slope_y": slopes[1],
    }


def _with_changes(
    table: NDArray[np.float32] | NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return entries (n, 2) of a table (n,): values, and differences to the next."""
    return np.stack([table, np.diff(table, append=table[-1])], axis=1).astype(
        np.float32
    )


@cache
def _kernel_tables(
    filter_half_width: int, filter_count: int
) -> dict[str, NDArray[np.generic]]:
    """Return the tables that kernels need, but not pupils and their surveys."""
    filters = [pixel_filter(k + 1, filter_half_width) for k in range(filter_count)]
    stride = -(-filters[-1].size // VECTOR) * VECTOR
    table = np.zeros((filter_count, stride), np.float32)
    for row, weights in zip(table, filters, strict=True):
        row[: weights.size] = weights
    lengths = FAST_LENGTHS
    first = np.cumsum(lengths) - lengths
    turns = np.concatenate([np.arange(n) / n for n in lengths])
    twiddles = np.stack([np.cos(2 * np.pi * turns), -np.sin(2 * np.pi * turns)], axis=1)
    contents: dict[str, NDArray[np.generic]] = {
        "fresnel": _with_changes(fresnel_table()),
        "edge_response": _with_changes(edge_response()),
        "pixel_filters": table,
        "lengths": lengths.astype(np.int32),
        "twiddle_first": first.astype(np.int32),
        "twiddles": twiddles.astype(np.float32),
    }
    return {name: np.ascontiguousarray(array) for name, array in contents.items()}


@cache
def psf_tables(
    n_terms: int = N_TERMS,
    filter_half_width: int = 4,
    filter_count: int = FILTER_COUNT,
    rays_from_db: float = GEOMETRIC_FROM_DB,
    *,
    pupils_only: bool = False,
) -> tuple[PsfTables, dict[str, NDArray[np.generic]]]:
    """Return the tables of the engine, and the arrays that they point to.

    Parameters
    ----------
    n_terms : int
        Number of Zernike terms of the wavefronts.
    filter_half_width : int
        Extent of the pixel filters beyond the pixel, samples.
    filter_count : int
        Largest number of samples per pixel.
    rays_from_db : float
        Predicted PSNR from which ray optics is used.
    pupils_only : bool
        Whether to omit the tables that only kernels need, for which SciPy is loaded.
        Frames through the eyes of a bank need no others.
    """
    arrays = {
        name: np.ascontiguousarray(array)
        for name, array in _pupil_tables(n_terms).items()
    }
    counts = {}
    if not pupils_only:
        arrays |= _kernel_tables(filter_half_width, filter_count)
        counts = {
            "fresnel_count": len(arrays["fresnel"]),
            "filter_stride": arrays["pixel_filters"].shape[1],
            "filter_count": filter_count,
            "length_count": FAST_LENGTHS.size,
        }
    tables = PsfTables(
        **{name: pointer_to(array) for name, array in arrays.items()},
        cosine=COSINE_OF_TURNS,
        sine=SINE_OF_TURNS,
        fresnel_limit=FRESNEL_LIMIT,
        least_margin_px=MARGIN_PX,
        base_db=BASE_DB,
        per_rms_db=PER_RMS_DB,
        per_pixel_db=PER_PIXEL_DB,
        per_narrow_db=PER_NARROW_DB,
        rays_from_db=rays_from_db,
        fade_db=CROSS_FADE_DB,
        min_cells=MIN_CELLS,
        max_cells=MAX_CELLS,
        cells_per_px=CELLS_PER_PX,
        min_edge_points=MIN_EDGE_POINTS,
        edge_points_per_px=EDGE_POINTS_PER_PX,
        min_curvature_ratio=MIN_CURVATURE_RATIO,
        far_px=FAR_PX,
        near_px=NEAR_PX,
        edge_half_width=EDGE_HALF_WIDTH,
        edge_steps=EDGE_STEPS,
        filter_half_width=filter_half_width,
        n_rings=RING_WEIGHTS.size + 1,
        n_ring=N_RING,
        order=radial_order(n_terms),
        **counts,
    )
    return tables, arrays
