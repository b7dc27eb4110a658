"""What the PSF engines share: the result, the refusal, and the kernel's disc."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Psf:
    """One point-spread function integrated over pixels.

    Attributes
    ----------
    kernel : (2R+1, 2R+1) float32
        ``[y, x]`` in image orientation: the row index grows downward, so light sent
        to +theta_y lands in a smaller row.  Unit sum, zero outside the disc
        dx² + dy² <= (R + 0.5)², centre element = chief ray (theta = 0).
    radius_px : int
        R.
    lost_energy_ratio : float
        Share of the light that falls outside the disc, before the kernel was
        brought to unit sum.
    method : str
        ``"fourier"`` or ``"geometric"``.
    blur_radius_px : float
        Largest wavefront slope over the pupil, in pixels.
    """

    kernel: NDArray[np.float32]
    radius_px: int
    lost_energy_ratio: float
    method: str
    blur_radius_px: float


class PsfTooLarge(ValueError):
    """A PSF needs a larger kernel than the caller allows.

    Attributes
    ----------
    radius_px : int
        Radius that the worst PSF of the call needs.
    max_radius_px : int
        Radius that was allowed.
    index : int
        Which PSF of the call it is.
    """

    def __init__(self, *, radius_px: int, max_radius_px: int, index: int):
        super().__init__(
            f"PSF {index} needs a radius of {radius_px} px; "
            f"allowed are at most {max_radius_px} px"
        )
        self.radius_px = radius_px
        self.max_radius_px = max_radius_px
        self.index = index

    def __reduce__(self):
        """Pickle by keyword: builds run in worker processes."""
        return _rebuild_psf_too_large, (
            self.radius_px,
            self.max_radius_px,
            self.index,
        )


def _rebuild_psf_too_large(radius_px, max_radius_px, index):
    return PsfTooLarge(radius_px=radius_px, max_radius_px=max_radius_px, index=index)


@lru_cache(maxsize=512)
def disc_mask(radius_px: int) -> NDArray[np.bool_]:
    """(2R+1, 2R+1): True where dx² + dy² <= (R + 0.5)²."""
    offset = np.arange(-radius_px, radius_px + 1)
    mask = offset[:, None] ** 2 + offset**2 <= (radius_px + 0.5) ** 2
    mask.setflags(write=False)
    return mask
