"""Packing of frames for the wire, into shared memory, buffers or compressed blocks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.connection import SendBuffer, SendBufferPool
from clients.link import Outgoing, ServiceLink
from clients.shared_memory import ClientSlot
from filter_service import RgbdView
from filter_service.messages import (
    Camera,
    Compression,
    Frame,
    SharedPlaces,
    ViewImages,
    Welcome,
    encode,
    encoded_depth,
)
from filter_service.settings import DepthKind
from filter_service.shared_memory import aligned_starts

LEND_WAIT_S = 0.1


class FramePacker:
    """Packs frames into messages.

    Parameters
    ----------
    link : ServiceLink
        Connection whose shared memory is used if available.
    compression : "none" or "lz4"
        Compression of frames that are not in shared memory.
    timeout_s : float
        Timeout of a wait for a buffer.
    """

    def __init__(
        self, link: ServiceLink, compression: Compression, timeout_s: float
    ) -> None:
        self._link = link
        self._compression: Compression = compression
        self._pool = SendBufferPool(timeout_s)

    def packed(self, frame: Frame, items: Sequence[RgbdView]) -> Outgoing:
        """Copy images to shared memory or send buffers; return the message.

        Frames in shared textures have no images to copy.
        """
        now_s = time.monotonic()
        if frame.textures:
            return Outgoing(frame.frame_id, encode(frame), [], now_s, frame)
        per_view = [
            _as_sent(item, header.depth.encoding)
            for item, header in zip(items, frame.views, strict=True)
        ]
        images = [image for sent in per_view for image in sent]
        found = self._in_shared_memory(frame, images)
        if found is not None:
            frame, slots = found
            return Outgoing(frame.frame_id, encode(frame), [], now_s, frame, slots)
        if self._compression != "none":
            images_of = tuple(ViewImages(*sent) for sent in per_view)
            frame = replace(frame, images=images_of).packed(self._compression)
            return Outgoing(frame.frame_id, encode(frame), [], now_s, frame)
        buffers: list[SendBuffer] = []
        kept: list[ViewImages] = []
        for sent in per_view:
            copies = [self._pool.copy_in(image) for image in sent]
            buffers += [buffer for buffer, _ in copies]
            kept.append(ViewImages(*(copy for _, copy in copies)))
        frame = replace(frame, images=tuple(kept))
        return Outgoing(frame.frame_id, encode(frame), buffers, now_s, frame)

    def _in_shared_memory(
        self, frame: Frame, images: Sequence[NDArray[Any]]
    ) -> tuple[Frame, list[ClientSlot]] | None:
        """Copy images to shared memory; return the frame and its slots, or None."""
        memory = self._link.memory
        if not memory.is_offered:
            return None
        starts, n_in = aligned_starts([image.nbytes for image in images])
        result_starts, n_out = aligned_starts(
            [v.camera.pixel_count * frame.output.bytes_per_pixel for v in frame.views]
        )
        slot = memory.holding(images)
        if slot is not None:
            slot.n_users += 1
        else:
            slot = memory.take(n_in)
        result_slot = memory.take(n_out)
        if slot is None or result_slot is None:
            for taken in (slot, result_slot):
                if taken is not None:
                    taken.release()
            return None
        slot.slot.put(images, starts)
        places = SharedPlaces(
            slot.slot.number,
            tuple(starts),
            result_slot.slot.number,
            tuple(result_starts),
        )
        return frame.changed(frame, memory=places), [slot, result_slot]

    def lend_view(
        self,
        camera: Camera,
        *,
        dtype: str = "uint8",
        depth_kind: DepthKind = "planar",
    ) -> RgbdView:
        """Return an empty view to render into; see `FilterClient.lend_view`."""
        shape = (camera.height_px, camera.width_px)
        shapes = ((*shape, 3), np.dtype(dtype)), (shape, np.dtype(np.float32))
        starts, size_bytes = aligned_starts(
            [int(np.prod(shape)) * kind.itemsize for shape, kind in shapes]
        )
        memory = self._link.memory
        held = memory.take(size_bytes)
        if held is None and memory.is_offered:
            self._link.pump(LEND_WAIT_S)
            held = memory.take(size_bytes)
        if held is None:
            arrays = [np.zeros(shape, kind) for shape, kind in shapes]
        else:
            arrays = [
                memory.array(held, start, shape, kind)
                for start, (shape, kind) in zip(starts, shapes, strict=True)
            ]
            held.release()
        color, depth_m = arrays
        return RgbdView(color, depth_m, camera.tangents, depth_kind)


def _as_sent(view: RgbdView, depth_encoding: str) -> list[NDArray[Any]]:
    """Return the images of a view, with depth encoded for the wire."""
    if depth_encoding == "float32":
        return list(view.images)
    return [
        encoded_depth(image, depth_encoding) if image.ndim == 2 else image
        for image in view.images
    ]


def check_limits(views: Sequence[RgbdView], welcome: Welcome) -> None:
    """Check views against the limits of the service.

    The service would close the connection on receiving other views.

    Raises
    ------
    ValueError
        If there are too many views, or one is too large.
    """
    limits = welcome.limits
    if not 1 <= len(views) <= limits.max_views:
        raise ValueError(f"{len(views)} views; allowed: 1 to {limits.max_views}")
    for view in views:
        camera = view.camera
        if (
            camera.width_px > limits.max_width_px
            or camera.height_px > limits.max_height_px
            or view.color.nbytes > limits.max_part_bytes
        ):
            raise ValueError(
                f"a view has {camera.width_px} x {camera.height_px} px and "
                f"{view.color.nbytes} bytes; allowed: {limits.max_width_px} x "
                f"{limits.max_height_px} px and {limits.max_part_bytes} bytes"
            )
