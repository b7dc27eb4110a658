"""Videos in segments, each written by one worker and then joined."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

MAX_DENOMINATOR = 1001
"""Of a frame rate, so that NTSC's, 30000/1001, is exact."""

BIT_EXACT = {"fflags": "+bitexact"}
"""No version names and no random numbers in the file."""


@dataclass(frozen=True)
class VideoKind:
    """Encoding of a video; uses one thread, so that its bytes are always the same."""

    codec: str
    pixels: str
    suffix: str
    options: tuple[tuple[str, str], ...]
    even_sides: bool


VIDEO_KINDS = {
    "ffv1": VideoKind(
        "ffv1", "bgr0", ".mkv", (("g", "1"), ("slices", "4"), ("slicecrc", "1")), False
    ),
    "h264": VideoKind(
        "libx264",
        "yuv420p",
        ".mp4",
        (("crf", "18"), ("preset", "fast"), ("bf", "0"), ("threads", "1")),
        True,
    ),
}
"""FFV1 is lossless; H.264 is smaller and plays anywhere."""


def write_segment(
    path: Path,
    frames: Iterable[tuple[int, NDArray[np.uint8]]],
    *,
    kind: VideoKind,
    rate_hz: float,
) -> None:
    """Write frames as a separate Matroska file.

    Parameters
    ----------
    frames : pairs of (number in the segment, sRGB image)
        A missing number extends the previous frame.

    Raises
    ------
    ValueError
        The kind of video does not support the size.
    """
    rate = Fraction(rate_hz).limit_denominator(MAX_DENOMINATOR)
    with av.open(str(path), "w", format="matroska", options=BIT_EXACT) as container:
        stream = None
        for number, image in frames:
            if stream is None:
                stream = _add_stream(container, image.shape, kind, rate)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode(None))


def _add_stream(
    container: av.container.OutputContainer,
    shape: Sequence[int],
    kind: VideoKind,
    rate: Fraction,
) -> av.VideoStream:
    height_px, width_px = shape[:2]
    check_sides(width_px, height_px, kind)
    stream = container.add_stream(kind.codec, rate=rate, options=dict(kind.options))
    stream.width, stream.height, stream.pix_fmt = width_px, height_px, kind.pixels
    stream.codec_context.time_base = 1 / rate
    stream.codec_context.thread_count = 1
    return stream


def check_sides(width_px: int, height_px: int, kind: VideoKind) -> None:
    """Reject a size that a kind of video does not support.

    Raises
    ------
    ValueError
    """
    if kind.even_sides and (width_px % 2 or height_px % 2):
        raise ValueError(
            f"{width_px}x{height_px} px; allowed with h264: even sides, or --format "
            "ffv1"
        )


def join_segments(
    path: Path, segments: Sequence[tuple[int, Path]], *, kind: VideoKind, rate_hz: float
) -> None:
    """Join segments, packet by packet.

    Parameters
    ----------
    segments : pairs of (number of the first frame, file)
        In order; a segment without frames is skipped.
    """
    rate = Fraction(rate_hz).limit_denominator(MAX_DENOMINATOR)
    container_format = {".mkv": "matroska", ".mp4": "mp4"}[kind.suffix]
    with av.open(
        str(path), "w", format=container_format, options=BIT_EXACT
    ) as container:
        stream = None
        for first, segment in segments:
            with av.open(str(segment)) as source:
                if not source.streams.video:
                    continue
                own = source.streams.video[0]
                if stream is None:
                    stream = container.add_stream_from_template(own)
                    stream.time_base = 1 / rate
                for packet in source.demux(own):
                    if packet.pts is None:
                        continue
                    number = first + round(packet.pts * packet.time_base * rate)
                    packet.pts = packet.dts = number
                    packet.duration = 1
                    packet.time_base, packet.stream = 1 / rate, stream
                    container.mux(packet)
