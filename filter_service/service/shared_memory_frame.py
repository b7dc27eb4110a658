"""Filtering of a frame whose input and output images are in shared memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.filtering.eye_filter import EyeFilter
from filter_service.messages import EyeName, Frame, Reply, Result, SharedPlaces
from filter_service.service.frame_reply import frame_reply
from filter_service.shared_memory import Slot
from filter_service.wire.images import ViewImages, packed

MS_PER_S = 1e3


def filter_in_slots(
    filter_of: Callable[[EyeName], EyeFilter],
    frame: Frame,
    slots: tuple[Slot, Slot],
    places: SharedPlaces,
    sizes_bytes: Sequence[int],
) -> tuple[Reply, list[int]]:
    """Filter a frame; return the reply and the size of each output image in bytes.

    Parameters
    ----------
    filter_of : callable
        Returns the filter of an eye.
    frame : Frame
        Frame without its images.
    slots : (Slot, Slot)
        Slots of the input and output images.
    places : SharedPlaces
        Positions in these slots.
    sizes_bytes : sequence of int
        Sizes of the input images if they are compressed.

    Returns
    -------
    reply : Result, Dropped or ErrorReply
        Without images, which are in the second slot.
    sizes_bytes : list of int
        Empty if there is no result.

    Raises
    ------
    ValueError
        If images extend beyond their slot.
    BadMessage
        If a compressed image cannot be unpacked.
    """
    slot, result_slot = slots
    begin_s = time.monotonic()
    frame = with_images(frame, slot, places.starts, sizes_bytes)
    unpack_ms = MS_PER_S * (time.monotonic() - begin_s)
    is_packed = frame.compression != "none"
    out = None if is_packed else output_arrays(result_slot, frame, places)
    reply = frame_reply(filter_of, frame, out)
    if not isinstance(reply, Result):
        return reply, []
    begin_s = time.monotonic()
    if is_packed:
        colors = [packed(color) for color in reply.colors]
    else:
        colors = [np.ascontiguousarray(color) for color in reply.colors]
    if out is None or any(a is not b for a, b in zip(colors, out, strict=True)):
        result_slot.put(colors, places.result_starts)
    stages_ms = dict(reply.stage_times_ms)
    stages_ms["copy_out_ms"] = MS_PER_S * (time.monotonic() - begin_s)
    if is_packed:
        stages_ms["unpack_ms"] = unpack_ms
    reply = replace(
        reply, colors=(), stage_times_ms=stages_ms, compression=frame.compression
    )
    return reply, [color.nbytes for color in colors]


def output_arrays(slot: Slot, frame: Frame, places: SharedPlaces) -> list[NDArray[Any]]:
    """Return the output arrays of a frame in a slot, (height, width, 3) each."""
    dtype = np.dtype(frame.output.dtype)
    return [
        slot.array(start, (view.height_px, view.width_px, 3), dtype)
        for start, view in zip(places.result_starts, frame.views, strict=True)
    ]


def with_images(
    frame: Frame, slot: Slot, starts: Sequence[int], sizes_bytes: Sequence[int]
) -> Frame:
    """Return a frame with its images from a slot; see `filter_in_slots`."""
    positions = iter(zip(starts, sizes_bytes or starts, strict=True))
    found = []
    for view in frame.views:
        arrays = []
        for _, shape, dtype in view.images:
            start, size_bytes = next(positions)
            if frame.compression != "none":
                shape, dtype = (size_bytes,), "uint8"
            array = slot.array(start, shape, np.dtype(dtype))
            array.flags.writeable = False
            arrays.append(array)
        found.append(ViewImages(*arrays))
    return replace(frame, images=tuple(found)).unpacked()
