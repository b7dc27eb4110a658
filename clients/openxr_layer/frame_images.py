"""Images of a frame in the layer's shared memory, as the filter takes and gives them.

Rows begin at the bottom, as in OpenGL, or at the top, as in Vulkan; the other way round
in views whose upper edge is below the lower one.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clients.headset.runtime import EYES, Eye, EyeView
from clients.headset.stereo_gaze import RgbdPicture
from clients.openxr_layer import wire
from clients.openxr_layer.quads import Quad, draw_quads, light_of
from filter_service.shared_memory import Slot

_HALF_OF_BYTE = (np.arange(256) / 255.0).astype(np.float16)
_HALVES = np.nan_to_num(
    np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32)
)
_BYTE_OF_HALF = np.rint(255.0 * _HALVES.clip(0.0, 1.0)).astype(np.uint8)
_HALF_OF_TEN_BITS = (np.arange(1024) / 1023.0).astype(np.float16)
_TEN_BITS_OF_HALF = np.rint(1023.0 * _HALVES.clip(0.0, 1.0)).astype(np.uint32)
_OPAQUE_TWO_BITS = np.uint32(3 << 30)
_DTYPES: dict[int, np.dtype[Any]] = {
    wire.SRGB8: np.dtype(np.uint8),
    wire.LINEAR8: np.dtype(np.uint8),
    wire.LINEAR16F: np.dtype(np.float16),
    wire.LINEAR10: np.dtype(np.uint32),
}


def _shape(image: wire.Image, color_format: int) -> tuple[int, ...]:
    """Return the shape of a color image: rows, columns and channels, unless packed."""
    shape = image.height_px, image.width_px
    return shape if color_format == wire.LINEAR10 else (*shape, 4)


def check_frame(frame: wire.Frame) -> None:
    """Check the numbers of a frame, before memory is touched.

    Raises
    ------
    ValueError
    """
    if frame.color_format not in _DTYPES:
        raise ValueError(f"color format {frame.color_format}")
    for view in frame.views:
        _check_size(view.color)
        if max(view.depth.width_px, view.depth.height_px) > wire.MAX_SIDE_PX:
            raise ValueError("a depth image is too large")
        if not all(map(math.isfinite, view.pose)):
            raise ValueError("a pose is not finite")
        if not all(-1.5 < angle < 1.5 for angle in view.fov_rad):  # also NaN
            raise ValueError(f"a field of view of {list(view.fov_rad)} rad")
    for quad in frame.quads:
        if max(quad.color.width_px, quad.color.height_px) == 0:
            continue
        if quad.color_format not in _DTYPES:
            raise ValueError(f"color format {quad.color_format} of a quad")
        _check_size(quad.color)
        if quad.color.width_px * quad.color.height_px > wire.MAX_QUAD_PIXELS:
            raise ValueError("an image of a quad is too large")
        if not all(map(math.isfinite, (*quad.pose, *quad.size_m))):
            raise ValueError("a pose or a size of a quad is not finite")
        if not min(quad.size_m) > 0.0:
            raise ValueError(f"a quad of {list(quad.size_m)} m")


def _check_size(image: wire.Image) -> None:
    sides_px = image.width_px, image.height_px
    if not 1 <= min(sides_px) <= max(sides_px) <= wire.MAX_SIDE_PX:
        raise ValueError(f"an image of {sides_px[0]}x{sides_px[1]} px")


class FrameImages:
    """Images of a frame.

    Parameters
    ----------
    memory : Slot
        Shared memory.
    frame : Frame
        A frame that was checked.
    engine : str
        Name of the program's engine.

    Raises
    ------
    ValueError
        If an image extends beyond the memory.
    """

    def __init__(self, memory: Slot, frame: wire.Frame, engine: str = "") -> None:
        self._frame, self._engine = frame, engine
        dtype = _DTYPES[frame.color_format]
        self._colors = [
            memory.array(
                view.color.start, _shape(view.color, frame.color_format), dtype
            )
            for view in frame.views
        ]
        self._quads = [
            Quad(quad.pose, tuple(quad.size_m), self._light(memory, quad), eyes)
            for quad in frame.quads
            if quad.color.width_px
            and (eyes := tuple(e for i, e in enumerate(EYES) if quad.eyes >> i & 1))
        ]
        self._depths = [
            memory.array(
                view.depth.start,
                (view.depth.height_px, view.depth.width_px),
                np.dtype(np.float32),
            )
            if view.depth.width_px and view.depth.height_px
            else None
            for view in frame.views
        ]

    def picture(self, index: int, eye: Eye, flat_m: float) -> tuple[RgbdPicture, str]:
        """Return the picture of a view, and the problem with its depth, if any.

        Parameters
        ----------
        index : int
        eye : "left" or "right"
        flat_m : float
            Planar depth without usable depth.
        """
        given = self._frame.views[index]
        raw = self._colors[index][self._rows(index)]
        is_packed = self._frame.color_format == wire.LINEAR10
        color = np.empty((*raw.shape[:2], 3), np.float16 if is_packed else raw.dtype)
        for channel, place in enumerate(self._channels):
            if is_packed:
                color[..., channel] = _HALF_OF_TEN_BITS[raw >> 10 * place & 1023]
            else:
                color[..., channel] = raw[..., place]
        if self._frame.color_format == wire.LINEAR8:
            color = _HALF_OF_BYTE[color]
        depth_m, note = self._depth_m(index)
        if depth_m is None:
            depth_m = np.full(color.shape[:2], flat_m, np.float32)
            away = "infinitely far" if math.isinf(flat_m) else f"{flat_m:g} m away"
            note += f"; everything is {away}"
        left, right, *edges = given.tangents
        view = EyeView(eye, given.pose, (left, right, max(edges), min(edges)))
        picture = RgbdPicture(view, color, depth_m)
        draw_quads(picture, self._quads)
        return picture, note

    @property
    def has_quads(self) -> bool:
        """Whether quads are drawn into the pictures."""
        return bool(self._quads)

    @staticmethod
    def _light(memory: Slot, quad: wire.QuadLayer) -> NDArray[np.float32]:
        raw = memory.array(
            quad.color.start,
            _shape(quad.color, quad.color_format),
            _DTYPES[quad.color_format],
        )
        return light_of(raw, quad.color_format, quad.flags)

    def _rows(self, index: int) -> slice:
        _, _, up, down = self._frame.views[index].fov_rad
        is_upright = up > down
        is_top_first = bool(self._frame.flags & wire.TOP_FIRST)
        return slice(None, None, 1 if is_top_first == is_upright else -1)

    @property
    def _channels(self) -> tuple[int, int, int]:
        """Return where red, green and blue are in a pixel.

        Images are copied one channel after the other: NumPy's copy of all three, three
        values at a time, takes four to six times as long.
        """
        return (2, 1, 0) if self._frame.flags & wire.IS_BGR else (0, 1, 2)

    def _depth_m(self, index: int) -> tuple[NDArray[np.float32] | None, str]:
        values, given = self._depths[index], self._frame.views[index]
        if values is None:
            return None, "there is none"
        stated = DepthRange(given.min_depth, given.max_depth, given.near_m, given.far_m)
        meant, note = corrected_range(stated, self._engine)
        values = np.ascontiguousarray(values[self._rows(index)])
        size_px = given.color.width_px, given.color.height_px
        depth_m, other_note = planar_depth(values, meant, size_px)
        return depth_m, other_note or note

    def put(
        self,
        index: int,
        color: NDArray[np.uint8] | NDArray[np.float16],
        plain_ratio: float = 0.0,
    ) -> None:
        """Write the filtered color of a view in place of its color.

        Parameters
        ----------
        index : int
        color : (h, w, 3) uint8 or float16
        plain_ratio : float
            Fraction of the width, from the left, that stays unfiltered.
        """
        to = self._colors[index]
        begin = round(plain_ratio * to.shape[1])
        if self._frame.color_format == wire.LINEAR8:
            color = _BYTE_OF_HALF[color.view(np.uint16)]
        part = to[self._rows(index), begin:]
        if self._frame.color_format == wire.LINEAR10:
            self._pack(part, color[:, begin:])
            return
        for channel, place in enumerate(self._channels):
            part[..., place] = color[:, begin:, channel]
        # Runtimes ignore the alpha of a layer that is not blended; screenshots do not.
        if not self._frame.flags & wire.IS_BLENDED:
            to[..., 3] = 255 if to.dtype == np.uint8 else 1.0

    def _pack(self, to: NDArray[np.uint32], color: NDArray[Any]) -> None:
        """Write halves as 10 bits per channel."""
        is_blended = bool(self._frame.flags & wire.IS_BLENDED)
        packed = to & _OPAQUE_TWO_BITS if is_blended else _OPAQUE_TWO_BITS
        for channel, place in enumerate(self._channels):
            levels = _TEN_BITS_OF_HALF[color[..., channel].view(np.uint16)]
            packed = packed | levels << np.uint32(10 * place)
        to[...] = packed


# Depth that a program submits, which is often wrong

Depth = NDArray[np.float32]

CHECK_STRIDE = 8
MAX_INVALID_RATIO = 0.2
"""Largest fraction of values that are not in the range of the depth buffer."""

NEAR_RATIO = 2.0
"""The planes are swapped if at least half the pixels are closer than this many times
the near plane, which no program draws."""

FAR_RATIO = 4.0
FAR_PLANE_RATIO = 0.99
NOISE_RATIO = 0.5
"""Median difference of neighbors to median deviation: 1 in noise, 0.001 in a room."""


class DepthRange(NamedTuple):
    """Values of `XrCompositionLayerDepthInfoKHR`.

    Attributes
    ----------
    min_depth, max_depth : float
        Values in the buffer at `near_m` and `far_m`.
    near_m, far_m : float
        Planar depths; near is farther than far in reversed buffers, and one of them may
        be infinite.
    """

    min_depth: float
    max_depth: float
    near_m: float
    far_m: float

    def problem(self) -> str:
        """Return the problem with the values; empty if they are valid."""
        low, high, near_m, far_m = self
        if not 0.0 <= low < high <= 1.0:
            return f"the range of the buffer is {low:g} to {high:g}"
        if not (near_m > 0.0 and far_m > 0.0):  # also NaN
            return f"its planes are at {near_m:g} and {far_m:g} m"
        if near_m == far_m:
            return f"both its planes are at {near_m:g} m"
        return ""


QT_NEAR_M = 1.0


def corrected_range(given: DepthRange, engine: str) -> tuple[DepthRange, str]:
    """Return the range that an engine means, and a note if that differs.

    Qt Quick 3D (6.8 to 6.12) states its planes in centimeters, and renders with a
    projection for depths from 0 to 1 in OpenGL's range from -1 to 1, so that its values
    are between 0.5 and 1.
    """
    planes_m = given.near_m, given.far_m
    if engine != "Qt" or not min(planes_m) >= QT_NEAR_M:
        return given, ""
    found = DepthRange(0.5, 1.0, 0.01 * given.near_m, 0.01 * given.far_m)
    return found, "its planes are in centimeters, as always in Qt Quick 3D; corrected"


def planar_depth(
    values: Depth, given: DepthRange, size_px: tuple[int, int]
) -> tuple[Depth | None, str]:
    """Return planar depth in m for the pixels of an image, and a note.

    Parameters
    ----------
    values : (h, w) float32
        Depth buffer, 0 to 1.
    given : DepthRange
    size_px : (int, int)
        Width and height of the image, which may differ from the buffer's.

    Returns
    -------
    depth_m : (height, width) float32, or None if the buffer contains no depth
    note : str
        What was found to be wrong; empty if nothing was.
    """
    problem = given.problem()
    if problem:
        return None, problem
    sample = values[::CHECK_STRIDE, ::CHECK_STRIDE]
    is_valid = (sample >= given.min_depth) & (sample <= given.max_depth)
    if np.mean(is_valid) < 1.0 - MAX_INVALID_RATIO:
        return None, "most of its values are out of range"
    note = ""
    if _is_swapped(sample[is_valid], given):
        given = given._replace(near_m=given.far_m, far_m=given.near_m)
        note = "its near and far planes are swapped; corrected"
    if _is_cleared(sample[is_valid], given):
        return None, f"all its values are {sample[is_valid][0]:g}"
    if _is_noise(values[::CHECK_STRIDE], given):
        return None, "the values of neighboring pixels are unrelated"
    height_px, width_px = values.shape
    if (width_px, height_px) != size_px:
        values = values[_nearest(height_px, size_px[1])][
            :, _nearest(width_px, size_px[0])
        ]
    return _planar(values, given), note


def _planar(values: Depth, given: DepthRange) -> Depth:
    """Return planar depth, m; 0 where there is none."""
    # The inverse of planar depth is linear in the values; a plane may be infinite.
    low, high, near_m, far_m = given
    slope = (1.0 / far_m - 1.0 / near_m) / (high - low)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = np.float32(1.0) / (
            values * np.float32(slope) + np.float32(1.0 / near_m - slope * low)
        )
    # Rounding at an infinite plane may give a small negative inverse.
    far = np.float32(max(near_m, far_m))
    np.copyto(depth_m, far, where=~(depth_m > 0.0))
    return np.where(_has_depth(values, given), depth_m, np.float32(0.0))


def _has_depth(values: Depth, given: DepthRange) -> NDArray[np.bool_]:
    """Return which pixels have depth.

    Nothing is drawn exactly at the near plane: such values are of pixels without depth,
    as those that were not a number and were clamped.
    """
    low, high, near_m, far_m = given
    if near_m < far_m:
        return (values > low) & (values <= high)
    return (values >= low) & (values < high)


def _is_swapped(values: Depth, given: DepthRange) -> bool:
    """Whether the image is only plausible with swapped planes."""
    near_m = min(given.near_m, given.far_m)
    other = given._replace(near_m=given.far_m, far_m=given.near_m)
    # Where nothing was drawn, swapped planes have their near plane.
    own = float(np.median(np.maximum(_planar(values, given), near_m)))
    swapped = float(np.median(np.maximum(_planar(values, other), near_m)))
    return own < NEAR_RATIO * near_m and (
        swapped > FAR_RATIO * near_m or math.isinf(swapped)
    )


def _is_cleared(values: Depth, given: DepthRange) -> bool:
    """Whether nothing was drawn; a wall across the view has one value as well."""
    if np.ptp(values) > 0.0:
        return False
    near_m, far_m = sorted((given.near_m, given.far_m))
    depth_m = float(_planar(values[:1], given)[0])
    return not NEAR_RATIO * near_m < depth_m < FAR_PLANE_RATIO * far_m


def _is_noise(values: Depth, given: DepthRange) -> bool:
    """Whether neighbors in a row differ as much as pixels do on the whole."""
    rows = np.where(_has_depth(values, given), values, np.float32(np.nan))
    own = rows[np.isfinite(rows)]
    spread = np.median(np.abs(own - np.median(own)))
    steps = np.abs(np.diff(rows, axis=1))
    step = np.median(steps[np.isfinite(steps)]) if np.isfinite(steps).any() else 0.0
    return bool(step > NOISE_RATIO * spread > 0.0)


def _nearest(given_px: int, wanted_px: int) -> NDArray[np.intp]:
    """Return the index of the nearest pixel for each wanted one."""
    return ((np.arange(wanted_px) + 0.5) * (given_px / wanted_px)).astype(np.intp)
