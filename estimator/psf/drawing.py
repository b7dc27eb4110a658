"""Draw PSFs in gray on the axes of a figure."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DECADES = 4.0
"""Powers of ten between white and black."""


def draw_psf(axes: "Axes", kernel: NDArray[Any], *, half_side_arcmin: float) -> None:
    """Draw a PSF [y, x], logarithmic: its peak white, `DECADES` below it black.

    Parameters
    ----------
    half_side_arcmin : float
        From its center to its edge.
    """
    extent = (-half_side_arcmin, half_side_arcmin) * 2
    decades = np.log10(np.maximum(kernel / kernel.max(), 10.0**-DECADES))
    axes.imshow(
        decades, cmap="gray", vmin=-DECADES, vmax=0.0, extent=extent,
        interpolation="nearest",
    )  # fmt: skip
