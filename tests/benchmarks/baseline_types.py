"""What every baseline of the renderer gives back."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Filtered:
    """A view filtered by a baseline, and what that took.

    Attributes
    ----------
    color : (height, width, 3)
        Linear light.
    prepare_ms : float
        PSFs and tables; once for an eye, pupil and focus.
    render_ms : float
        Per frame.
    memory_mb : float
        PSFs as the method keeps them, at the bytes a texel that it is published with.
    psf_count : int
    tap_count : int
        PSF samples that the frame needs, without those that a tile reads beyond a PSF;
        0 where nothing counts them, as with methods that convolve by FFT.
    """

    color: NDArray[np.float64]
    prepare_ms: float
    render_ms: float
    memory_mb: float
    psf_count: int
    tap_count: int = 0


class Stopwatch:
    """Wall time of consecutive stages."""

    def __init__(self):
        self._start_s = time.perf_counter()

    def lap_ms(self) -> float:
        """Time since the last call, or since the start."""
        now_s = time.perf_counter()
        lap_ms = 1e3 * (now_s - self._start_s)
        self._start_s = now_s
        return lap_ms
