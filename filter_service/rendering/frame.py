"""What becomes of a view before it is filtered: depth filled, colour made finite."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import TILE_SIZE_PX
from filter_service.rgbd_view import LEAST_DEPTH_M, RgbdView

IMAGES = ("color", "depth_m", "hidden_color", "hidden_depth_m")


def fill_missing_depth(
    depth_m: NDArray[np.float32],
) -> tuple[NDArray[np.float32], int]:
    """Give missing pixels the depth of the nearest valid pixel, and count them.

    Missing is what is not a number from `LEAST_DEPTH_M` on.
    Nearest by Euclidean distance in the image; if no pixel is valid, all are at
    infinity.
    """
    missing = ~(depth_m >= LEAST_DEPTH_M)
    count = int(np.count_nonzero(missing))
    if count == 0:
        return depth_m, 0
    if count == depth_m.size:
        return np.full_like(depth_m, np.inf), count
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(
        missing, return_distances=False, return_indices=True
    )
    return depth_m[rows, columns], count


def border_px_of(view: RgbdView, reach_px: int) -> int:
    """Return columns and rows to add around a view with a hidden layer, whole tiles.

    Next to the border of an image no surface is whole, for part of its light would come
    from beyond; what it hides would shine through.  So the image goes on, as its edge.
    """
    if view.surface_count == 1:
        return 0
    return -(-reach_px // TILE_SIZE_PX) * TILE_SIZE_PX


def extended(view: RgbdView, border_px: int) -> RgbdView:
    """Repeat the edge of a view's images all around."""
    if border_px == 0:
        return view
    left, right, up, down = view.tangents
    across = (right - left) / view.width_px * border_px
    along = (up - down) / view.height_px * border_px
    sides = ((border_px, border_px), (border_px, border_px), (0, 0))
    images = {
        name: np.pad(image, sides[: image.ndim], mode="edge")
        for name in IMAGES
        if (image := getattr(view, name)) is not None
    }
    tangents = (left - across, right + across, up + along, down - along)
    return replace(view, **images, tangents=tangents)


def radial_stretch(view: RgbdView) -> NDArray[np.float64]:
    """Distance from the eye per unit of planar depth, (height, width)."""
    left, right, up, down = view.tangents
    x = left + (right - left) * (np.arange(view.width_px) + 0.5) / view.width_px
    y = up + (down - up) * (np.arange(view.height_px) + 0.5) / view.height_px
    return np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)


def object_dpt(view: RgbdView, depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """Object distance in dioptres (height, width) of valid depths."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / depth_m.astype(np.float64)
    return inverse / radial_stretch(view) if view.depth_kind == "planar" else inverse
