"""One view of an RGB-D frame: checked, with missing depth filled and counted.

A view may have a second, hidden layer: what the camera would see if what it sees were
away.  Blurred edges let light of it pass.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from filter_service.errors import BadMessage

MAX_SIDE_PX = 16384
DEPTH_KINDS = ("planar", "radial")
IMAGES = ("color", "depth_m", "hidden_color", "hidden_depth_m")


@dataclass(frozen=True)
class View:
    """Colour, depth and camera of one view.

    Attributes
    ----------
    color : (height, width, 3)
        uint8 sRGB; or float32 or float16 linear light, above 1 and below 0 too.
    depth_m : (height, width), float32
        +inf is infinity; 0, negative and NaN are missing.
    tangents : (left, right, up, down)
    depth_kind : "planar" or "radial"
        View-space z, or distance from the eye.
    hidden_color : (height, width, 3), optional
        Of what is behind, of the same type as `color`.
    hidden_depth_m : (height, width), float32, optional
        0, negative and NaN: nothing is hidden here, and nothing is filled in.
    """

    color: NDArray
    depth_m: NDArray[np.float32]
    tangents: tuple[float, float, float, float]
    depth_kind: str = "planar"
    hidden_color: NDArray | None = None
    hidden_depth_m: NDArray[np.float32] | None = None

    @property
    def surface_count(self) -> int:
        """1, or 2 with a hidden layer."""
        return 1 if self.hidden_depth_m is None else 2

    @property
    def surface_colors(self) -> tuple[NDArray, ...]:
        """Colour of each surface."""
        return (self.color, self.hidden_color)[: self.surface_count]

    @property
    def surface_depths_m(self) -> tuple[NDArray[np.float32], ...]:
        """Depth of each surface."""
        return (self.depth_m, self.hidden_depth_m)[: self.surface_count]

    @property
    def width_px(self) -> int:
        """Columns."""
        return self.color.shape[1]

    @property
    def height_px(self) -> int:
        """Rows."""
        return self.color.shape[0]


def check_view(view: View) -> None:
    """Refuse a view whose arrays cannot be filtered.

    Raises
    ------
    BadMessage
        Names the field, the bad value and what is allowed.
    """
    color, depth_m = view.color, view.depth_m
    if color.ndim != 3 or color.shape[2] != 3 or 0 in color.shape:
        raise BadMessage(
            f"shape {color.shape}", field="color", allowed="(height, width, 3)"
        )
    if max(color.shape) > MAX_SIDE_PX:
        raise BadMessage(
            f"shape {color.shape}", field="color", allowed=f"sides up to {MAX_SIDE_PX}"
        )
    if color.dtype not in (np.uint8, np.float32, np.float16):
        raise BadMessage(
            f"dtype {color.dtype}",
            field="color",
            allowed="uint8 sRGB, float32 or float16 linear",
        )
    if depth_m.shape != color.shape[:2] or depth_m.dtype != np.float32:
        raise BadMessage(
            f"{depth_m.dtype} of shape {depth_m.shape}",
            field="depth",
            allowed=f"float32 of shape {color.shape[:2]}",
        )
    if view.depth_kind not in DEPTH_KINDS:
        raise BadMessage(
            f"{view.depth_kind!r}", field="depth.kind", allowed=", ".join(DEPTH_KINDS)
        )
    _check_hidden(view)


def _check_hidden(view: View) -> None:
    """Refuse a hidden layer that is not of the kind of what is seen."""
    if view.hidden_color is None and view.hidden_depth_m is None:
        return
    for field, image, seen in (
        ("hidden_color", view.hidden_color, view.color),
        ("hidden_depth", view.hidden_depth_m, view.depth_m),
    ):
        wanted = f"{seen.dtype} of shape {seen.shape}"
        found = "missing" if image is None else f"{image.dtype} of shape {image.shape}"
        if found != wanted:
            raise BadMessage(found, field=field, allowed=wanted)


def fill_missing_depth(
    depth_m: NDArray[np.float32],
) -> tuple[NDArray[np.float32], int]:
    """Give missing pixels the depth of the nearest valid pixel, and count them.

    Nearest by Euclidean distance in the image; if no pixel is valid, all are at
    infinity.
    """
    missing = ~(depth_m > 0.0)
    count = int(np.count_nonzero(missing))
    if count == 0:
        return depth_m, 0
    if count == depth_m.size:
        return np.full_like(depth_m, np.inf), count
    rows, columns = distance_transform_edt(
        missing, return_distances=False, return_indices=True
    )
    return depth_m[rows, columns], count


def extended(view: View, border_px: int) -> View:
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


def finite_color(color: NDArray) -> tuple[NDArray, int]:
    """Replace non-finite colour values by zero, and count their pixels.

    Negative ones stay: filtering is linear, and colours outside of the client's
    primaries have them.
    """
    if color.dtype == np.uint8:
        return color, 0
    finite = np.isfinite(color)
    if finite.all():
        return color, 0
    count = int(np.count_nonzero(~finite.all(axis=2)))
    return np.where(finite, color, color.dtype.type(0.0)), count


def with_clean_hidden(view: View) -> tuple[View, int]:
    """Set hidden depth to 0 where nothing is hidden, and count non-finite colours.

    A hidden layer that holds nothing at all is left out.
    """
    holds = view.hidden_depth_m > 0.0
    if not holds.any():
        return replace(view, hidden_color=None, hidden_depth_m=None), 0
    color, _ = finite_color(view.hidden_color)
    depth_m = np.where(holds, view.hidden_depth_m, np.float32(0.0))
    bad = np.zeros(holds.shape, bool)
    if color is not view.hidden_color:
        bad = holds & ~np.isfinite(view.hidden_color).all(axis=2)
    clean = replace(view, hidden_color=color, hidden_depth_m=depth_m)
    return clean, int(np.count_nonzero(bad))


def radial_stretch(view: View) -> NDArray[np.float64]:
    """Distance from the eye per unit of planar depth, (height, width)."""
    left, right, up, down = view.tangents
    x = left + (right - left) * (np.arange(view.width_px) + 0.5) / view.width_px
    y = up + (down - up) * (np.arange(view.height_px) + 0.5) / view.height_px
    return np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)


def object_dpt(view: View, depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """Object distance in dioptres (height, width) of valid depths."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / depth_m.astype(np.float64)
    return inverse / radial_stretch(view) if view.depth_kind == "planar" else inverse
