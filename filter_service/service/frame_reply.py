"""Filtering of a frame whose images are in shared memory or textures, and its reply."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.planned_frame import Filtered, plan_views
from filter_service.filtering.stream_eyes import Preparing
from filter_service.messages import (
    LINEAR16,
    SRGB8,
    Dropped,
    EyeName,
    Frame,
    ImageFormat,
    Result,
    ResultView,
    SharedPlaces,
    ViewHeader,
    ViewTextures,
)
from filter_service.rgbd_view import RgbdView
from filter_service.shared_memory import Slot
from filter_service.stage_times import StageTimes
from filter_service.texture_view import GlTexture, TextureView
from filter_service.wire.images import (
    OUTPUT_OF_FORMAT,
    ViewImages,
    packed,
    unpacked_images,
)

MS_PER_S = 1e3

PSF_BUDGET_S = 1.0
"""Time limit of a frame for computing PSFs, beyond which it is dropped.  The next frame
reuses the computed PSFs.  A first frame of 1280x720 takes 0.3 to 0.7 s of two cores."""

FilterOf = Callable[[EyeName], EyeFilter]
"""Returns the filter of an eye."""


def filter_in_slots(
    filter_of: FilterOf,
    frame: Frame,
    slots: tuple[Slot, Slot],
    places: SharedPlaces,
    sizes_bytes: Sequence[int],
) -> tuple[Result | Dropped, list[int]]:
    """Filter a frame; return the reply and the size of each output image in bytes.

    The caller sets ``total_ms``, because it knows when the frame arrived.

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
    reply : Result or Dropped
        Without images, which are in the second slot.
    sizes_bytes : list of int
        Empty if there is no result.

    Raises
    ------
    ValueError
        If images extend beyond their slot.
    FilterError
        If a compressed image cannot be unpacked, or the frame cannot be filtered.
    """
    slot, result_slot = slots
    times = StageTimes()
    is_packed = frame.compression != "none"
    begin_s = time.monotonic()
    images = images_in(frame, slot, places.starts, sizes_bytes)
    if is_packed:
        times.add("unpack_ms", MS_PER_S * (time.monotonic() - begin_s))
    out = None if is_packed else output_arrays(result_slot, frame, places)
    views = [view.view(own) for view, own in zip(frame.views, images, strict=True)]
    seen = _filtered(filter_of, frame, views, out, times)
    if isinstance(seen, Preparing):
        return Dropped(frame.frame_id, seen.reason), []
    with times.wall("copy_out_ms"):
        if is_packed:
            colors = [packed(color) for color in seen.colors]
        else:
            colors = [np.ascontiguousarray(color) for color in seen.colors]
        if out is None or any(a is not b for a, b in zip(colors, out, strict=True)):
            result_slot.put(colors, places.result_starts)
    result = _result(frame, seen, [frame.output] * len(views), frame.compression)
    return result, [color.nbytes for color in colors]


def filter_in_textures(
    filter_of: FilterOf, frame: Frame, textures: Mapping[int, GlTexture]
) -> Result | Dropped:
    """Filter a frame, wait for the GPU and return the reply.

    Parameters
    ----------
    filter_of : callable
        Returns the filter of an eye.
    frame : Frame
    textures : mapping
        Imported textures by their number.

    Raises
    ------
    FilterError
        If a texture is not imported, or the frame cannot be filtered.
    """
    times = StageTimes()
    views = [
        texture_view(view, used, textures)
        for view, used in zip(frame.views, frame.textures, strict=True)
    ]
    targets = [textures[used.result] for used in frame.textures]
    seen = _filtered(filter_of, frame, views, targets, times)
    if isinstance(seen, Preparing):
        return Dropped(frame.frame_id, seen.reason)
    formats = [LINEAR16 if t.format == "rgba16f" else SRGB8 for t in targets]
    return _result(frame, seen, formats)


def _filtered(
    filter_of: FilterOf,
    frame: Frame,
    views: Sequence[RgbdView | TextureView],
    out: Sequence[NDArray[Any] | GlTexture | None] | None,
    times: StageTimes,
) -> Filtered | Preparing:
    """Filter the views of a frame, timed as a whole."""
    started_s, before_ms = time.monotonic(), sum(times.ms.values())
    planned = plan_views(
        filter_of, views, [view.state for view in frame.views], **vars(frame.state)
    )
    if isinstance(planned, Preparing):
        return planned
    seen = planned.render(
        output=OUTPUT_OF_FORMAT[frame.output],
        options=frame.options,
        out=out,
        until_s=started_s + PSF_BUDGET_S,
        times=times,
    )
    total_ms = MS_PER_S * (time.monotonic() - started_s)
    times.add("filter_other_ms", total_ms - sum(times.ms.values()) + before_ms)
    return seen


@cache
def _result_names() -> frozenset[str]:
    return frozenset(field.name for field in fields(Result))


def _result(
    frame: Frame,
    seen: Filtered,
    formats: Sequence[ImageFormat],
    compression: Any = "none",
) -> Result:
    names = _result_names()
    counts: dict[str, Any] = {n: c for n, c in seen.counts.items() if n in names}
    return Result(
        frame_id=frame.frame_id,
        profile_id=seen.profile_id,
        generation=seen.generation,
        views=tuple(
            ResultView(
                header.width_px,
                header.height_px,
                color,
                header.eye,
                profile_id=found.profile_id,
                generation=found.generation,
                is_complete=True,
                **vars(found.state),
                pose=header.pose,
            )
            for header, found, color in zip(
                frame.views, seen.views, formats, strict=True
            )
        ),
        **vars(seen.state),
        total_ms=0.0,
        stage_times_ms=seen.stage_times_ms,
        notes=seen.notes,
        compression=compression,
        display_time_ns=frame.display_time_ns,
        **counts,
    )


def output_arrays(slot: Slot, frame: Frame, places: SharedPlaces) -> list[NDArray[Any]]:
    """Return the output arrays of a frame in a slot, (height, width, 3) each."""
    dtype = np.dtype(frame.output.dtype)
    return [
        slot.array(start, (view.height_px, view.width_px, 3), dtype)
        for start, view in zip(places.result_starts, frame.views, strict=True)
    ]


def images_in(
    frame: Frame, slot: Slot, starts: Sequence[int], sizes_bytes: Sequence[int]
) -> tuple[ViewImages, ...]:
    """Return the images of a frame's views in a slot; see `filter_in_slots`."""
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
    if frame.compression != "none":
        return unpacked_images(frame.views, found)
    return tuple(found)


def texture_view(
    header: ViewHeader, used: ViewTextures, textures: Mapping[int, GlTexture]
) -> TextureView:
    """Return a view in textures.

    Raises
    ------
    BadMessage
        If a texture is not imported, or the formats do not suit.
    """
    missing = [number for number in used.numbers if number not in textures]
    if missing:
        raise BadMessage(
            f"texture {missing[0]} is not shared",
            field="textures",
            allowed="textures that the service has imported",
        )
    return TextureView(
        textures[used.color],
        textures[used.depth],
        header.width_px,
        header.height_px,
        header.tangents,
        used.projection,
        is_top_first=used.is_top_first,
        white_ratio=used.white_ratio,
    )
