"""Validation of the positions of a frame's images in shared memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from filter_service.errors import BadMessage
from filter_service.messages import Frame, ViewHeader, ViewTextures
from filter_service.service.session import Session
from filter_service.shared_memory import Slot
from filter_service.texture_view import COLOR_FORMATS, DEPTH_FORMATS
from filter_service.wire.compression import largest_block_bytes


def check_positions(session: Session, frame: Frame) -> None:
    """Check that a frame's images are in free slots or textures of its session.

    Raises
    ------
    BadMessage
        If a slot or texture is unknown or in use, images overlap or exceed a slot, or
        a texture has another size than its view.
    """
    for view, used in zip(frame.views, frame.textures, strict=False):
        _check_textures(session, view, used)
    positions = frame.memory
    if positions is None:
        return
    for name, number in (
        ("slot", positions.slot),
        ("result_slot", positions.result_slot),
    ):
        if number not in session.shared or number in session.slots_in_use:
            raise BadMessage(
                f"it is {number}",
                field=f"memory.{name}",
                allowed="a slot of this session that no other frame uses",
            )
    if positions.slot == positions.result_slot:
        raise BadMessage(
            f"it is {positions.slot}, too",
            field="memory.result_slot",
            allowed="another than memory.slot",
        )
    sizes = [
        int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        for view in frame.views
        for _, shape, dtype in view.images
    ]
    _check_bounds(session.shared[positions.slot], positions.starts, sizes, "starts")
    slot, sizes = session.shared[positions.result_slot], result_sizes(frame)
    _check_bounds(slot, positions.result_starts, sizes, "result_starts")


def _check_textures(session: Session, view: ViewHeader, used: ViewTextures) -> None:
    """Check that textures of a view exist, are free and have its size."""
    names = ("color", "depth", "result")
    for name, number in zip(names, used.numbers, strict=True):
        texture = session.textures.get(number)
        is_free = number not in session.textures_in_use
        if texture is None or not texture.is_imported or not is_free:
            raise BadMessage(
                f"it is {number}",
                field=f"textures.{name}",
                allowed="a texture of this session that no other frame uses",
            )
        found = texture.request.width_px, texture.request.height_px
        if found != (view.width_px, view.height_px):
            raise BadMessage(
                f"texture {number} has {found[0]} x {found[1]} px",
                field=f"textures.{name}",
                allowed=f"{view.width_px} x {view.height_px} px, the size of the view",
            )
        formats = DEPTH_FORMATS if name == "depth" else COLOR_FORMATS
        if texture.request.format not in formats:
            raise BadMessage(
                f"texture {number} has the format {texture.request.format}",
                field=f"textures.{name}",
                allowed=", ".join(formats),
            )


def result_sizes(frame: Frame) -> list[int]:
    """Return the maximum size of each view's output image in bytes."""
    bytes_per_pixel = frame.output.bytes_per_pixel
    sizes = [view.camera.pixel_count * bytes_per_pixel for view in frame.views]
    if frame.compression == "none":
        return sizes
    return [largest_block_bytes(size) for size in sizes]


def _check_bounds(
    slot: Slot, starts: Sequence[int], sizes: Sequence[int], name: str
) -> None:
    """Check that images neither exceed a slot nor overlap."""
    end = 0
    for start, size in sorted(zip(starts, sizes, strict=True)):
        if start < end or start + size > slot.size_bytes:
            raise BadMessage(
                f"{size} bytes from {start}",
                field=f"memory.{name}",
                allowed=f"images beside each other within {slot.size_bytes} bytes",
            )
        end = start + size
