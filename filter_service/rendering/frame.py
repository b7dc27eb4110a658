"""Preparation of a view: missing depth, borders, object distances."""

from collections.abc import Callable
from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Tangents
from filter_service.constants import MAX_REACH_PX, TILE_SIZE_PX
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.image_cells import ImageCells
from filter_service.rgbd_view import MIN_DEPTH_M, RgbdView
from filter_service.settings import MAX_VERGENCE_DPT

BORDER_MARGIN_PX = 2

IMAGES = ("color", "depth_m", "hidden_color", "hidden_depth_m")


def fill_missing_depth(
    depth_m: NDArray[np.float32],
) -> tuple[NDArray[np.float32], int]:
    """Fill missing pixels with the depth of the nearest valid pixel, and count them.

    Depth is missing if it is NaN or less than `MIN_DEPTH_M`.
    Nearest means by Euclidean distance in the image; if no pixel is valid, all are at
    infinity.
    """
    missing = ~(depth_m >= MIN_DEPTH_M)
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


def border_px_of(view: RgbdView, layers: FrameLayers, image: ImageCells) -> int:
    """Return the width of the border around a view with a hidden layer, in whole tiles.

    Near the edge of the image, part of a surface's light comes from outside the image.
    Without that light, hidden surfaces would become visible there.  The border
    therefore repeats the edge of the image.
    """
    if view.surface_count == 1:
        return 0
    reach_px = reach_px_of(view, layers, image) + BORDER_MARGIN_PX
    return -(-reach_px // TILE_SIZE_PX) * TILE_SIZE_PX


def reach_px_of(view: RgbdView, layers: FrameLayers, image: ImageCells) -> int:
    """Return an upper bound on the kernel reach in a view, px, from its depth range.

    The bound is computed from ray tracing plus diffraction within the box to which
    kernels are cropped.  It does not depend on which PSFs have been computed.
    """
    depths_m = [m[m >= MIN_DEPTH_M] for m in view.surface_depths_m]
    far_m = max((float(m.max(initial=0.0)) for m in depths_m), default=0.0)
    near_m = min((float(m.min(initial=np.inf)) for m in depths_m), default=np.inf)
    stretch_ratio = radial_stretch(view).max() if view.depth_kind == "planar" else 1.0
    low_dpt = 1.0 / (far_m * stretch_ratio) if far_m > 0.0 else 0.0
    high_dpt = 1.0 / near_m
    reach_px = layers.reach_px(low_dpt, high_dpt, max_px=MAX_REACH_PX)
    return ceil(image.maps.largest_stretch_ratio * reach_px)


def map_images(
    view: RgbdView,
    change: Callable[[NDArray[Any]], NDArray[Any]],
    tangents: Tangents,
) -> RgbdView:
    """Return a view with a function applied to each image, and with new tangents."""
    images: dict[str, Any] = {
        name: change(image)
        for name in IMAGES
        if (image := getattr(view, name)) is not None
    }
    return replace(view, **images, tangents=tangents)


def drop_empty_layer(view: RgbdView) -> RgbdView:
    """Return a view without its hidden layer if no pixel of the layer has depth."""
    if view.hidden_depth_m is None or np.any(view.hidden_depth_m > 0.0):
        return view
    return replace(view, hidden_color=None, hidden_depth_m=None)


def extended(view: RgbdView, border_px: int) -> RgbdView:
    """Return a view with a border on all sides that repeats its edge."""
    if border_px == 0:
        return view
    left, right, up, down = view.tangents
    across = (right - left) / view.width_px * border_px
    along = (up - down) / view.height_px * border_px
    sides = ((border_px, border_px), (border_px, border_px), (0, 0))
    return map_images(
        view,
        lambda image: np.pad(image, sides[: image.ndim], mode="edge"),
        (left - across, right + across, up + along, down - along),
    )


def radial_stretch(view: RgbdView) -> NDArray[np.float64]:
    """Return radial over planar depth of each pixel, (height, width)."""
    return stretch_at(
        view, np.arange(view.width_px), np.arange(view.height_px)[:, None]
    )


def stretch_at(
    view: RgbdView, x_px: NDArray[np.int64], y_px: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return radial over planar depth (...) at pixels."""
    left, right, up, down = view.tangents
    x = left + (right - left) * (x_px + 0.5) / view.width_px
    y = up + (down - up) * (y_px + 0.5) / view.height_px
    found: NDArray[np.float64] = np.sqrt(1.0 + x**2 + y**2)
    return found


def object_dpt(view: RgbdView, depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the object distance in diopters (height, width) of valid depths."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / depth_m.astype(np.float64)
    return inverse / radial_stretch(view) if view.depth_kind == "planar" else inverse


def object_range_dpt(view: RgbdView) -> tuple[float, float]:
    """Return the farthest and nearest object distance of a view, as (low, high) dpt.

    Missing depth is filled first, see `fill_missing_depth`.  The range includes the
    hidden layer where it has depth.  Both values are clamped to `MAX_VERGENCE_DPT`.
    """
    filled_m, _ = fill_missing_depth(view.depth_m)
    distance_dpt = object_dpt(view, filled_m)
    if view.hidden_depth_m is not None:
        has_depth = view.hidden_depth_m > 0.0
        hidden_m = np.where(has_depth, view.hidden_depth_m, filled_m)
        distance_dpt = np.stack([distance_dpt, object_dpt(view, hidden_m)])
    low_dpt, high_dpt = float(distance_dpt.min()), float(distance_dpt.max())
    return min(low_dpt, MAX_VERGENCE_DPT), min(high_dpt, MAX_VERGENCE_DPT)
