"""Numbers of the passes that build PSFs; every one becomes a ``#define`` of its name.

Those of the engines are the CPU's own, so that the two cannot drift apart.
"""

import math
from functools import lru_cache

import numpy as np

from estimator.psf import geometric as psf_geometric
from estimator.psf import geometric_kernels as psf_geometric_kernels
from estimator.psf.fourier import edge_response
from estimator.psf.fourier_kernels import EDGE_HALF_WIDTH, EDGE_STEPS

FFT_RADICES = {
    48: (8, 6),
    64: (8, 8),
    96: (8, 12),
    128: (8, 16),
    192: (8, 4, 6),
    256: (8, 4, 8),
    384: (8, 8, 6),
    512: (8, 8, 8),
    768: (8, 8, 12),
    1024: (8, 8, 16),
}
"""FFT lengths, and the radices that make them: two exchanges at most.  Shorter ones
hold no window: 8 lambda/D on each side and the smoothed edge take more."""

GROUP_SAMPLES = 1024
"""Sample pairs that a work group transforms at once: 16 KiB of shared memory, half of
what core OpenGL promises, so that two groups share a multiprocessor."""

MAX_GROUP_LINES = 16

EDGE_TERMS = 12
"""Sines of the smoothed edge: it is a step low-passed to nine of them."""

TURN_TERMS = 7
"""Terms of sine and cosine of whole turns, for 3e-7: the same on every device."""

LIGHT_STEP_BITS = 29
"""Steps of light in the ray-optical images: the whole light is 2^29, a cell's part at
least 14,000, and a sum four times the light still fits."""

RAY_ROWS = 32
PIXEL_THREADS = 64
CLEAR_THREADS = 256


@lru_cache(maxsize=1)
def edge_series() -> tuple[float, ...]:
    """Sine terms b_m of the smoothed step 1/2 + d / (2 L) + sum b_m sin(pi m d / L).

    d is the depth in samples, L = EDGE_HALF_WIDTH; the slope's mean is 1 / (2 L).
    """
    depth = np.linspace(-EDGE_HALF_WIDTH, EDGE_HALF_WIDTH, edge_response().size)
    rest = edge_response() - 0.5 - depth / (2.0 * EDGE_HALF_WIDTH)
    m = np.arange(1, EDGE_TERMS + 1)[:, None]
    sines = np.sin(math.pi * m * depth / EDGE_HALF_WIDTH)
    return tuple((sines @ rest / (EDGE_HALF_WIDTH * EDGE_STEPS)).tolist())


def _turn_series(function) -> str:
    """Coefficients in t² of an even function of t in -1/2..1/2, for a shader."""
    nodes = (1.0 + np.cos(math.pi * (np.arange(TURN_TERMS) + 0.5) / TURN_TERMS)) / 8.0
    values = function(np.sqrt(nodes))
    series = np.polynomial.polynomial.polyfit(nodes, values, TURN_TERMS - 1)
    return ", ".join(f"{c:.9e}" for c in series)


def fft_defines(length: int) -> dict[str, int]:
    """How a work group transforms lines of one length."""
    radices = (*FFT_RADICES[length], 1)[:3]
    threads = max(length // radix for radix in radices if radix > 1)
    lines = GROUP_SAMPLES // (1 << (length - 1).bit_length())
    lines = max(1, min(MAX_GROUP_LINES, lines))
    return {
        "FFT_LENGTH": length,
        "FFT_THREADS": threads,
        "FFT_LINES": lines,
        "FFT_GROUP": lines * threads,
        **{f"FFT_RADIX_{i}": radix for i, radix in enumerate(radices)},
    }


def _edge_pieces() -> dict[str, int | float]:
    """Pieces of a profile across the edge: far, near and far again."""
    near, far = psf_geometric_kernels.NEAR_PX, psf_geometric_kernels.FAR_PX
    return {
        "PSF_EDGE_END_PX": far + 0.25,
        "PSF_EDGE_FAR_PIECES": far - near,
        "PSF_EDGE_PIECES": 2 * (far - near) + 4 * near + 1,
    }


DEFINES = {
    "PSF_TURN": 2.0 * math.pi,
    "PSF_TINY": 1.0e-6,
    "PSF_THREADS": PIXEL_THREADS,
    "PSF_CLEAR_THREADS": CLEAR_THREADS,
    "PSF_ROWS": RAY_ROWS,
    "PSF_EDGE_PAIRS": 6,
    "PSF_EDGE_HALF_WIDTH": EDGE_HALF_WIDTH,
    "PSF_TURN_TERMS": TURN_TERMS,
    "PSF_COSINE_SERIES": _turn_series(lambda t: np.cos(2.0 * math.pi * t)),
    "PSF_SINE_SERIES": _turn_series(lambda t: np.sin(2.0 * math.pi * t) / t),
    "PSF_EDGE_SLOPE": 0.5 / EDGE_HALF_WIDTH,
    "PSF_EDGE_TERMS": EDGE_TERMS,
    "PSF_EDGE_SERIES": ", ".join(f"{b:.9e}" for b in edge_series()),
    "PSF_LIGHT_STEPS": float(1 << LIGHT_STEP_BITS),
    "PSF_MIN_BOX_PX": 1.0e-3,
    "PSF_FAR_PX": float(psf_geometric_kernels.FAR_PX),
    "PSF_MIN_CURVATURE": 1.0e-6,
    "PSF_MIN_CURVATURE_RATIO": psf_geometric_kernels.MIN_CURVATURE_RATIO,
    "PSF_FRESNEL_LIMIT": psf_geometric.FRESNEL_LIMIT,
    "PSF_FRESNEL_STEPS": psf_geometric.fresnel_table().size - 1,
    "PSF_FRESNEL_FAR": 0.5 / math.pi**2,
    **_edge_pieces(),
}
"""Numbers of all passes ``psf_*``, further to those of `constants`."""
