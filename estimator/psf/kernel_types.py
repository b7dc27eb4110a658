"""Result, size error, buffer and kernel disc of the PSF engines."""

from collections.abc import Callable
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
        ``[y, x]`` in image orientation: rows are downward, so +theta_y is in a row with
        a smaller index.  It has unit sum and is zero outside the disc
        dx² + dy² <= (R + 0.5)²; the center element is the chief ray (theta = 0).
    radius_px : int
        R.
    lost_energy_ratio : float
        Share of the light outside the disc, before normalization to unit sum.
    method : str
        "fourier", "geometric", "fourier+geometric" or an ENZ method.
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
        Allowed radius.
    index : int
        Index of the PSF in the call.
    """

    def __init__(self, *, radius_px: int, max_radius_px: int, index: int):
        super().__init__(
            f"PSF {index} needs a radius of {radius_px} px, allowed are up to "
            f"{max_radius_px} px: use fewer pixels per degree, a smaller pupil or less "
            "defocus"
        )
        self.radius_px = radius_px
        self.max_radius_px = max_radius_px
        self.index = index

    def __reduce__(
        self,
    ) -> tuple[Callable[[int, int, int], "PsfTooLarge"], tuple[int, int, int]]:
        """Support pickling, because worker processes build PSFs."""
        return _rebuild_psf_too_large, (
            self.radius_px,
            self.max_radius_px,
            self.index,
        )


def _rebuild_psf_too_large(
    radius_px: int, max_radius_px: int, index: int
) -> PsfTooLarge:
    return PsfTooLarge(radius_px=radius_px, max_radius_px=max_radius_px, index=index)


@lru_cache(maxsize=512)
def disc_mask(radius_px: int) -> NDArray[np.bool_]:
    """Return a mask (2R+1, 2R+1), True where dx² + dy² <= (R + 0.5)²."""
    offset = np.arange(-radius_px, radius_px + 1)
    mask = offset[:, None] ** 2 + offset**2 <= (radius_px + 0.5) ** 2
    mask.setflags(write=False)
    return mask


@dataclass(frozen=True)
class KernelBuffer:
    """Output buffer of the engines: the concatenated kernels of one call.

    Attributes
    ----------
    flat_kernels : (total,) float32
        All kernels; PSF p starts at ``offset_count[p]``.
    offset_count, radius_px : (P,) int64
    geometric_ratio : (P,)
        Weight of ray optics in each kernel; both engines add their part.
    total_ratio : (P,)
        Share of the light inside the disc, from the sums of the kernels.
    """

    flat_kernels: NDArray[np.float32]
    offset_count: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    geometric_ratio: NDArray[np.float64]
    total_ratio: NDArray[np.float64]


def empty_buffer(
    radius_px: NDArray[np.int64],
    geometric_ratio: NDArray[np.float64],
) -> KernelBuffer:
    """Return an uninitialized buffer for kernels with given radii (P,)."""
    counts = (2 * radius_px + 1) ** 2
    ends = np.cumsum(counts)
    return KernelBuffer(
        flat_kernels=np.empty(int(ends[-1]) if ends.size else 0, np.float32),
        offset_count=ends - counts,
        radius_px=radius_px,
        geometric_ratio=geometric_ratio,
        total_ratio=np.zeros(radius_px.size),
    )
