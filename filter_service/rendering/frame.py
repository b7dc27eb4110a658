"""Preparation of a view: missing depth, borders, object distances, limits of merging.

Pixels may merge more in the periphery, as far as nobody detects it.  Detection sets the
limit, not resolution: gratings beyond the peripheral resolution
limit remain visible, as aliases.  At 30 degrees, contrast sensitivity is about 10 at
3.2 c/deg and falls to 1 near 20 c/deg (OSA 1988), which is beyond what headsets show.
Spatial frequencies therefore allow nothing, but contrast does.  From the fovea to 30
degrees, sensitivity falls by

- 0.031 decades per degree at 1 c/deg and 18 Hz, 0.037 at 1 Hz (Virsu et al. 1982),
- 0.035 and 0.045 at 0.5 and 1 c/deg, static (Virsu & Rovamo 1979),
- 0.043 at 3.2 c/deg (OSA 1988, relative to a foveal sensitivity of 200).

Merging preserves local means, so its errors are at 1 c/deg and above; they flicker when
the gaze moves.  The limits grow at the smallest of these rates, beyond a margin of 5
degrees: 2 for the eye tracker, 1 for pursuit at 20 deg/s and a latency of 50 ms, and 2
for the fovea.  After a saccade, a latency of 50 to 70 ms is tolerated (Albert et al.
2017).  The largest gain is the largest `render_tolerance`.

References
----------
"Aliasing and contrast sensitivity in peripheral vision", OSA Annual Meeting 1988, TUH3.
Albert, Patney, Luebke & Kim 2017, ACM Trans. Appl. Percept. 14(4), 25.
Virsu & Rovamo 1979, Exp. Brain Res., doi:10.1007/BF00236818.
Virsu, Rovamo, Laurinen & Nasanen 1982, Vision Res., doi:10.1016/0042-6989(82)90087-6.
Values of both as digitized for castleCSF (github.com/gfxdisp/castleCSF).
"""

from collections.abc import Callable
from dataclasses import replace
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from filter_service.camera import Tangents
from filter_service.constants import (
    DETECTION_MARGIN_DEG,
    DETECTION_MAX_OCTAVES,
    DETECTION_OCTAVES_PER_DEG,
    MAX_REACH_PX,
    MERGE_CONTRAST_POWER,
    MERGE_MIN_SPREAD_PX,
    TILE_SIZE_PX,
)
from filter_service.planning.grid import unit_direction
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.image_cells import ImageCells
from filter_service.rgbd_view import MIN_DEPTH_M, RgbdView
from filter_service.settings import MAX_VERGENCE_DPT, Mode, RenderOptions

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
    if depth_m.size and depth_m.min() >= MIN_DEPTH_M:  # not if any depth is NaN
        return depth_m, 0
    missing = ~(depth_m >= MIN_DEPTH_M)
    count = int(np.count_nonzero(missing))
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
    low_dpt, high_dpt = distance_bounds_dpt(view)
    reach_px = layers.reach_px(low_dpt, high_dpt, max_px=MAX_REACH_PX)
    return ceil(image.maps.largest_stretch_ratio * reach_px)


def distance_bounds_dpt(view: RgbdView) -> tuple[float, float]:
    """Return bounds of the object distances of a view, as (low, high) dpt.

    This takes a tenth of the time of `object_range_dpt`: planar depth counts as if it
    were in the middle of the image or in its corner.
    """
    depths_m = []
    for depth_m in view.surface_depths_m:
        is_known = depth_m.min(initial=np.inf) >= MIN_DEPTH_M  # False with NaN
        depths_m.append(depth_m if is_known else depth_m[depth_m >= MIN_DEPTH_M])
    far_m = max(float(m.max(initial=0.0)) for m in depths_m)
    near_m = min(float(m.min(initial=np.inf)) for m in depths_m)
    stretch_ratio = 1.0
    if view.depth_kind == "planar":
        x_px = np.array([0, view.width_px - 1])
        y_px = np.array([0, view.height_px - 1])
        stretch_ratio = float(stretch_at(view, x_px, y_px[:, None]).max())
    low_dpt = 1.0 / (far_m * stretch_ratio) if far_m > 0.0 else 0.0
    return low_dpt, 1.0 / near_m


def blur_notes(
    view: RgbdView, layers: FrameLayers, image: ImageCells
) -> tuple[str, ...]:
    """Return a note if the blur of objects in a view exceeds the largest kernel."""
    if layers.limits is None:
        return ()
    return layers.limit_notes(image.read_nodes, *distance_bounds_dpt(view))


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


WHITE_STEP_PX = 8
"""Stride in pixels at which the white level is sampled.  Each sample is the median of
three adjacent pixels, so that a single bright pixel is never one."""

PEAK_QUANTILES = 0.98, 0.998
LIT_QUANTILES, ALL_QUANTILES = (0.8, 0.9), (0.99, 0.996)
LIT_RATIO, WHITE_RATIO = 1e-6, 2.0
"""The white level of a linear image is the mean of its brightest samples, but at most
`WHITE_RATIO` times lower quantiles, of the lit samples and of all, so that a small
light source does not set it, even alone in the dark.  A mean over a range of quantiles
changes less than one quantile if a sample changes."""


def white_level(color: NDArray[Any]) -> float:
    """Return the white level of an image; it is 1 for 8-bit images.

    The unit of linear light is arbitrary, so the merging threshold must scale with it.
    """
    if color.dtype == np.uint8:
        return 1.0
    rows, columns = (np.arange(0, size, WHITE_STEP_PX) for size in color.shape[:2])
    below, right = (
        np.minimum(at + 1, size - 1)
        for at, size in zip((rows, columns), color.shape[:2], strict=True)
    )
    one, two, three = (
        color[np.ix_(*at)].astype(np.float32)
        for at in ((rows, columns), (rows, right), (below, columns))
    )
    light = np.abs(
        np.maximum(np.minimum(one, two), np.minimum(np.maximum(one, two), three))
    )
    light = np.sort(light[np.isfinite(light)])
    most = _mean_between(light, ALL_QUANTILES)
    lit = light[np.searchsorted(light, LIT_RATIO * most, side="right") :]
    return min(
        _mean_between(lit, PEAK_QUANTILES),
        WHITE_RATIO * _mean_between(lit, LIT_QUANTILES),
        WHITE_RATIO * most,
    )


def _mean_between(
    ascending: NDArray[np.float32], quantiles: tuple[float, float]
) -> float:
    """Return the mean of the values between two quantiles; 0 if there is none."""
    if ascending.size == 0:
        return 0.0
    first, last = (int(share * ascending.size) for share in quantiles)
    return float(ascending[first : max(last, first + 1)].mean(dtype=np.float64))


GazeDirection = tuple[float, float, float]
"""Unit vector (right, up, forward); zero if merging follows no gaze."""

NO_GAZE: GazeDirection = (0.0, 0.0, 0.0)


def merge_gaze(
    options: RenderOptions, gaze_deg: tuple[float, float] | None
) -> GazeDirection:
    """Return the gaze that the merging of a frame follows.

    Parameters
    ----------
    gaze_deg : (h, v) or None
        Gaze of the frame as requested.  It is not clamped to the prepared range,
        because merging has to follow where the viewer looks.
    """
    if gaze_deg is None or not follows_gaze(options):
        return NO_GAZE
    right, up, backward = unit_direction(*gaze_deg).tolist()
    return right, up, -backward


MODE_TOLERANCE_RATIO: dict[Mode, float] = {
    "on-axis": 0.25,
    "quality": 0.25,
    "dynamic": 1.0,
}
"""Error of merging relative to that of the mode "dynamic", 55 dB.

Courtyard, 640x360, 5 mm: on the axis a quarter raises the PSNR from 55 to 66 dB
(myopia, astigmatism, cataract) and the time of a frame by a fifth; with PSFs that
follow the field, whose interpolation limits the PSNR, it adds 2 dB.
"""


class Merging(NamedTuple):
    """How a frame merges pixels and distances, which follows from its options.

    Attributes
    ----------
    tolerance : float
        Rendering error relative to the default; 0 merges no pixels.
    gaze : GazeDirection
    paper_rule : bool
        Whether light of several distances is combined as in the paper.
    bright_pixels : bool
        Whether coverage does not amplify pixels that are much brighter than what
        surrounds them.
    """

    tolerance: float
    gaze: GazeDirection
    paper_rule: bool
    bright_pixels: bool

    @classmethod
    def of(
        cls, options: RenderOptions, gaze_deg: tuple[float, float] | None, mode: Mode
    ) -> "Merging":
        """Return the values for a frame with a gaze, see `merge_gaze`.

        Parameters
        ----------
        mode : Mode
            Mode of the frame's PSFs.
        """
        tolerance = MODE_TOLERANCE_RATIO[mode] * options.render_tolerance
        return cls(
            tolerance if options.merge else 0.0,
            merge_gaze(options, gaze_deg),
            options.accumulation == "paper",
            options.bright_pixels,
        )


def follows_gaze(options: RenderOptions) -> bool:
    """Return whether the merging of frames with a gaze follows it.

    With the paper's sum, it does not: weights are opacities there, and merging sharp
    pixels would change the sum.
    """
    is_merged = options.merge and options.accumulation == "coverage"
    return options.peripheral_merging and is_merged


def merge_spread_px(options: RenderOptions) -> float:
    """Return the smallest spread of kernels that merged squares may use."""
    most = 2.0**DETECTION_MAX_OCTAVES if follows_gaze(options) else 1.0
    return float(smallest_spread_px(most))


def detection_gain(eccentricity_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the gain of the limits at an angle from the gaze."""
    beyond_deg = np.maximum(np.subtract(eccentricity_deg, DETECTION_MARGIN_DEG), 0.0)
    octaves = DETECTION_OCTAVES_PER_DEG * beyond_deg
    return np.asarray(2.0 ** np.minimum(octaves, DETECTION_MAX_OCTAVES))


def smallest_spread_px(gain: ArrayLike) -> NDArray[np.float64]:
    """Return the smallest spread of kernels that merge at a gain.

    The allowed difference of color is the same at a spread that is smaller by
    gain**(1 / MERGE_CONTRAST_POWER).
    """
    ratio = np.asarray(gain) ** (1.0 / MERGE_CONTRAST_POWER)
    return np.asarray(MERGE_MIN_SPREAD_PX / ratio)
