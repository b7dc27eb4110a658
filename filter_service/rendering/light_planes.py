"""Light of sources, added to images and to grids of coarse pixels."""

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from filter_service.constants import RGB
from filter_service.native import loops


def add_sources(
    plane: NDArray[np.float32],
    source_px: NDArray[np.float64],
    light: NDArray[np.float64],
    number: NDArray[np.int64],
    kernels: NDArray[np.float32],
    *,
    pitch_px: int,
    size_px: tuple[int, int],
    is_split: bool,
    is_image: bool = False,
) -> None:
    """Add sources times their kernels to a plane, from points of a grid.

    Parameters
    ----------
    plane : (rows, columns, 3)
        Of the pitch of the grid, or the image.
    source_px : (n, 2)
        x, y in pixels of the image.
    light : (n, 3)
    number : (n,)
        Kernel of each source, ascending.
    kernels : (n_kernels, side, side, 3)
        Round kernels.
    pitch_px : int
        Pitch of the grid.
    size_px : (height, width)
        Size of the image.
    is_split : bool
        Whether each source is divided between the four points around it, and not moved
        to the nearest.
    is_image : bool
        Whether the plane is the image; the pitch is odd.
    """
    shape = tuple(-(-n // pitch_px) + 2 for n in size_px)  # with a margin
    most = 4 * len(number)  # each source is divided between four points
    at, kernel = np.empty((most, 2), np.int64), np.empty(most, np.int64)
    gathered = np.zeros((most, RGB), np.float32)
    count = loops().call(
        "gather_points",
        *(source_px, number, light, len(number), pitch_px, is_split),
        *(np.full(shape, -1, np.int64), shape[1], at, kernel, gathered),
    )
    if is_image:  # centers of squares of an odd number of pixels
        at[:count] = pitch_px * at[:count] + pitch_px // 2
    loops().call(
        "add_sources",
        *(shared_threads(), at, kernel, gathered, count, kernels, kernels.shape[1]),
        *(plane, *plane.shape[:2]),
    )


def add_plane(coarse: NDArray[np.float32], image: NDArray[np.float32]) -> None:
    """Add light on pixels of twice the size, interpolated, to an image (h, w, 3)."""
    sizes = coarse.shape[:2], image.shape[:2]
    loops().call("add_plane", shared_threads(), coarse, *sizes[0], image, *sizes[1])
