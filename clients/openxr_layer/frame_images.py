"""Images of a frame in the layer's shared memory, as the filter takes and gives them.

Rows begin at the bottom, except in views whose upper edge is below the lower one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.headset.runtime import Eye, EyeView
from clients.headset.stereo_gaze import RgbdPicture
from clients.openxr_layer import wire
from clients.openxr_layer.submitted_depth import (
    DepthRange,
    corrected_range,
    planar_depth,
)
from filter_service.shared_memory import Slot

_HALF_OF_BYTE = (np.arange(256) / 255.0).astype(np.float16)
_HALVES = np.nan_to_num(
    np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32)
)
_BYTE_OF_HALF = np.rint(255.0 * _HALVES.clip(0.0, 1.0)).astype(np.uint8)
_DTYPES: dict[int, np.dtype[Any]] = {
    wire.SRGB8: np.dtype(np.uint8),
    wire.LINEAR8: np.dtype(np.uint8),
    wire.LINEAR16F: np.dtype(np.float16),
}
OPAQUE: dict[np.dtype[Any], float] = {
    np.dtype(np.uint8): 255,
    np.dtype(np.float16): 1.0,
}


def check_frame(frame: wire.Frame) -> None:
    """Check the numbers of a frame, before memory is touched.

    Raises
    ------
    ValueError
    """
    if frame.color_format not in _DTYPES:
        raise ValueError(f"color format {frame.color_format}")
    for view in frame.views:
        sides_px = view.color.width_px, view.color.height_px
        if not all(1 <= side_px <= wire.MAX_SIDE_PX for side_px in sides_px):
            raise ValueError(f"an image of {sides_px[0]}x{sides_px[1]} px")
        if max(view.depth.width_px, view.depth.height_px) > wire.MAX_SIDE_PX:
            raise ValueError("a depth image is too large")
        if not all(map(math.isfinite, view.pose)):
            raise ValueError("a pose is not finite")
        if not all(-1.5 < angle < 1.5 for angle in view.fov_rad):  # also NaN
            raise ValueError(f"a field of view of {list(view.fov_rad)} rad")


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
                view.color.start,
                (view.color.height_px, view.color.width_px, 4),
                dtype,
            )
            for view in frame.views
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
        """Return the picture of a view, and what is wrong with its depth.

        Parameters
        ----------
        index : int
        eye : "left" or "right"
        flat_m : float
            Planar depth without usable depth.
        """
        given = self._frame.views[index]
        raw = self._colors[index][self._rows(index)]
        color = np.empty((*raw.shape[:2], 3), raw.dtype)
        _copy_channels(color, raw)
        if self._frame.color_format == wire.LINEAR8:
            color = _HALF_OF_BYTE[color]
        depth_m, note = self._depth_m(index)
        if depth_m is None:
            depth_m = np.full(color.shape[:2], flat_m, np.float32)
            away = "infinitely far" if math.isinf(flat_m) else f"{flat_m:g} m away"
            note = f"{note}; everything is {away}"
        left, right, up, down = given.tangents
        view = EyeView(eye, given.pose, (left, right, max(up, down), min(up, down)))
        return RgbdPicture(view, color, depth_m), note

    def _rows(self, index: int) -> slice:
        _, _, up, down = self._frame.views[index].fov_rad
        return slice(None, None, -1 if up > down else 1)

    def _depth_m(self, index: int) -> tuple[NDArray[np.float32] | None, str]:
        values, given = self._depths[index], self._frame.views[index]
        if values is None:
            return None, "there is none"
        stated = DepthRange(given.min_depth, given.max_depth, given.near_m, given.far_m)
        meant, note = corrected_range(stated, self._engine)
        depth_m, other_note = planar_depth(
            np.ascontiguousarray(values[self._rows(index)]),
            meant,
            (given.color.width_px, given.color.height_px),
        )
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
        rows = self._rows(index)
        begin = round(plain_ratio * to.shape[1])
        if self._frame.color_format == wire.LINEAR8:
            color = _BYTE_OF_HALF[color.view(np.uint16)]
        _copy_channels(to[rows, begin:], color[:, begin:])
        # Runtimes ignore the alpha of a layer that is not blended; screenshots do not.
        if not self._frame.flags & wire.IS_BLENDED:
            to[..., 3] = 255 if to.dtype == np.uint8 else 1.0


def _copy_channels(to: NDArray[Any], color: NDArray[Any]) -> None:
    """Copy red, green and blue between images, one after the other.

    NumPy's copy of all three, three values at a time, takes four to six times as long.
    """
    for channel in range(3):
        to[..., channel] = color[..., channel]
