"""Video segments, which workers write and `join_segments` joins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

EncodingFailed = av.FFmpegError
"""Base class of the errors of the encoder and the file formats."""

BT709, LIMITED = 1, 1
"""Codes of H.273 and of FFmpeg."""

MAX_RATIO = 1000
"""Largest denominator of the shape of a pixel."""

MAX_DENOMINATOR = 1001
"""Largest denominator of a frame rate; NTSC (30000/1001) is exact."""

VARIABLE_TICK_S = Fraction(1, 90_000)
"""Unit of the times of a video whose frame rate varies, as in MPEG."""

BIT_EXACT = {"fflags": "+bitexact"}
"""Options that keep version names and random numbers out of files."""


@dataclass(frozen=True)
class VideoKind:
    """Encoding of a video, with one thread so that its bytes are reproducible."""

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
    pixel_aspect_ratio: Callable[[], float] = lambda: 1.0,
) -> None:
    """Write frames to a Matroska file.

    Parameters
    ----------
    path : Path
        File to write.
    frames : iterable of (int, (h, w, 3) uint8)
        Number in the segment and sRGB image of each frame.  If a number is missing, the
        previous frame is shown longer.
    kind : VideoKind
        Encoding.
    rate_hz : float
        Frame rate.
    pixel_aspect_ratio : callable
        Returns the width of a pixel relative to its height; called once the first frame
        is there.

    Raises
    ------
    ValueError
        If the encoding does not support the image size.
    """
    rate = Fraction(rate_hz).limit_denominator(MAX_DENOMINATOR)
    with av.open(str(path), "w", format="matroska", options=BIT_EXACT) as container:
        stream = None
        for number, image in frames:
            if stream is None:
                stream = _add_stream(container, image.shape, kind, rate)
                ratio = Fraction(pixel_aspect_ratio()).limit_denominator(MAX_RATIO)
                stream.codec_context.sample_aspect_ratio = ratio
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
            if kind.pixels.startswith("yuv"):
                frame = frame.reformat(
                    format=kind.pixels, dst_colorspace="ITU709", threads=1
                )
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
    if kind.even_sides and (width_px % 2 or height_px % 2):
        raise ValueError(
            f"{width_px}x{height_px} px; allowed: even width and height, or "
            "--format ffv1"
        )
    stream = container.add_stream(kind.codec, rate=rate, options=dict(kind.options))
    stream.width, stream.height, stream.pix_fmt = width_px, height_px, kind.pixels
    stream.codec_context.time_base = 1 / rate
    stream.codec_context.thread_count = 1
    if kind.pixels.startswith("yuv"):
        # Without tags, players guess the matrix from the size of the picture.
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = BT709
        context.color_range = LIMITED
    return stream


def join_segments(
    path: Path,
    segments: Sequence[tuple[int, Path]],
    *,
    kind: VideoKind,
    rate_hz: float,
    times_s: Sequence[Fraction] | None = None,
) -> None:
    """Join segments to a video without decoding them.

    Parameters
    ----------
    path : Path
        File to write.
    segments : sequence of (int, Path)
        Number of the first frame and file of each segment, in order.  A segment without
        frames is skipped.
    kind : VideoKind
        Encoding of the segments.
    rate_hz : float
        Frame rate of the segments.
    times_s : sequence of Fraction, optional
        Time of each frame of the video, if its frame rate varies.
    """
    rate = Fraction(rate_hz).limit_denominator(MAX_DENOMINATOR)
    tick_s = 1 / rate if times_s is None else VARIABLE_TICK_S
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
                    stream.time_base = tick_s
                for packet in source.demux(own):
                    if packet.pts is None:
                        continue
                    number = first + round(packet.pts * packet.time_base * rate)
                    packet.pts = packet.dts = _ticks(times_s, number)
                    packet.duration = _ticks(times_s, number + 1) - packet.pts
                    packet.time_base, packet.stream = tick_s, stream
                    container.mux(packet)


def _ticks(times_s: Sequence[Fraction] | None, number: int) -> int:
    """Return the time of a frame; after the last one, it is shown as long as before."""
    if times_s is None:
        return number
    if number < len(times_s):
        return round(times_s[number] / VARIABLE_TICK_S)
    last_s, before_s = times_s[-1], times_s[-2] if len(times_s) > 1 else 0
    return round((2 * last_s - before_s) / VARIABLE_TICK_S)
