"""Exact random access to video frames, whatever was read before.

A frame is found by its time.  The reader lists the times of all packets without
decoding them, then seeks to the key frame that precedes a frame and decodes from there.
Frames are returned upright and in sRGB, with colors as their tags say.

FFmpeg applies the matrix of 8-bit videos.  The matrix of deeper ones is applied here,
because FFmpeg makes 65280 of white, as are transfer characteristics and primaries.
Videos without tags are BT.709 from 720 lines on and BT.601 below, as players assume.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.sidedata.sidedata import Type
from numpy.typing import NDArray

from estimator.bounded_files import InvalidFile, reason_of
from filter_service.camera import PIXEL_ASPECT_LIMITS, PixelGrid
from filter_service.color_encoding import (
    SRGB,
    UNSPECIFIED,
    Encoding,
    encoding_of_codes,
)
from filter_service.image_files import ImageFile, named_note
from filter_service.pictures import shown, upright

HD_HEIGHT_PX = 720

BT2020 = 9
BT709_WEIGHTS, BT601_WEIGHTS = (0.2126, 0.0722), (0.299, 0.114)
MATRICES = {
    0: ("RGB", (0.0, 0.0)),
    1: ("BT.709", BT709_WEIGHTS),
    UNSPECIFIED: ("unspecified", BT601_WEIGHTS),
    4: ("FCC", (0.30, 0.11)),
    5: ("BT.601", BT601_WEIGHTS),
    6: ("BT.601", BT601_WEIGHTS),
    7: ("SMPTE 240M", (0.212, 0.087)),
    BT2020: ("BT.2020", (0.2627, 0.0593)),
}
"""Matrices by their codes of H.273, with the weights of red and blue in luma."""

FULL_RANGE = 2
ROWS = 64
"""Rows converted at a time, so that copies in floats stay small."""

ORIENTATIONS = {
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}
"""Orientations of EXIF by the signs of a display matrix."""

GRAY = ("gray16le", "gray16be")
MAX_VIDEO_PIXELS = 1 << 25
"""Pixels of a frame, as in 8K. A decoder keeps up to 17 frames, and the reader one more
in sRGB."""

MAX_VIDEO_FRAMES = 1_000_000
"""Nine hours at 30 Hz; the time of a frame takes 40 bytes of memory."""

MAX_PACKETS_AHEAD = 10_000
"""Packets decoded without a frame; key frames are some hundred packets apart."""

FORMATS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpeg,mpegts,mpegvideo"
"""Allowed formats, whatever the file name. Playlists are excluded, because they
reference other files."""

OPTIONS = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}


def color_of(
    frame: av.VideoFrame, context: av.VideoCodecContext
) -> tuple[NDArray[Any], list[str]]:
    """Return the colors of a frame as stored, not upright, and notes.

    Parameters
    ----------
    frame : VideoFrame
    context : VideoCodecContext
        Decoder, which knows the tags of the video.

    Returns
    -------
    color : (height, width, 3)
        uint8 sRGB; float32 linear sRGB if the video has more than 8 bits or is HDR.
    notes : list of str

    Raises
    ------
    ValueError
        If the video has a color matrix that is not supported.
    """
    notes: list[str] = []
    if frame.colorspace not in MATRICES:
        names = ", ".join(sorted({name for name, _ in MATRICES.values()}))
        raise ValueError(f"color matrix {frame.colorspace}; allowed: {names}")
    parts = frame.format.components
    has_alpha = any(part.is_alpha for part in parts)
    if max(part.bits for part in parts) > 8:
        pixels = _deep_pixels(frame, has_alpha=has_alpha)
    else:
        how: dict[str, Any] = {"format": "rgba" if has_alpha else "rgb24", "threads": 1}
        if frame.colorspace == UNSPECIFIED and frame.height >= HD_HEIGHT_PX:
            how["src_colorspace"] = "ITU709"
        pixels = frame.to_ndarray(**how)
    alpha = np.ascontiguousarray(pixels[..., 3]) if has_alpha else None
    encoding = _encoding(frame.colorspace, context, notes)
    if frame.interlaced_frame:
        notes.append("it is interlaced; both fields are filtered as one picture")
    codes = np.ascontiguousarray(pixels[..., :3])
    return shown(codes, alpha, encoding, notes), notes


def _deep_pixels(frame: av.VideoFrame, *, has_alpha: bool) -> NDArray[np.uint16]:
    """Return RGB or RGBA of 16 bits of a frame of more than 8."""
    if frame.format.is_rgb:
        layout = "rgba64le" if has_alpha else "rgb48le"
        return np.asarray(frame.to_ndarray(format=layout, threads=1))
    layout = f"yuv{'a' * has_alpha}444p16le"
    planes = frame.reformat(format=layout, threads=1).planes
    shape = (frame.height, frame.width, 3 + has_alpha)
    pixels = np.empty(shape, np.uint16)
    stored = [
        np.frombuffer(plane, np.uint16).reshape(frame.height, -1)[:, : frame.width]
        for plane in planes
    ]
    weights = MATRICES[frame.colorspace][1]
    if frame.colorspace == UNSPECIFIED and frame.height >= HD_HEIGHT_PX:
        weights = BT709_WEIGHTS
    is_full = frame.color_range == FULL_RANGE
    zeros = (0 if is_full else 16 << 8, 32768, 32768)
    spans = (65535,) * 3 if is_full else (219 << 8, 224 << 8, 224 << 8)
    red, blue = weights
    for top in range(0, frame.height, ROWS):
        rows = slice(top, top + ROWS)
        y, u, v = (
            (plane[rows].astype(np.float32) - np.float32(zero)) / np.float32(span)
            for plane, zero, span in zip(stored[:3], zeros, spans, strict=True)
        )
        r, b = y + 2.0 * (1.0 - red) * v, y + 2.0 * (1.0 - blue) * u
        g = (y - red * r - blue * b) / (1.0 - red - blue)
        rgb = np.clip(np.stack([r, g, b], axis=-1), 0.0, 1.0)
        pixels[rows, :, :3] = 65535.0 * rgb + 0.5
    if has_alpha:
        pixels[..., 3] = stored[3]
    return pixels


def _encoding(matrix: int, context: av.VideoCodecContext, notes: list[str]) -> Encoding:
    primaries, transfer = int(context.color_primaries), int(context.color_trc)
    if matrix == BT2020 and primaries == UNSPECIFIED:
        primaries = BT2020
    if primaries == BT2020 and transfer == UNSPECIFIED:
        notes.append(
            "its colors are BT.2020, and it does not say whether they are HLG or PQ; "
            "neither is assumed"
        )
    try:
        return _encoding_of(primaries, transfer)
    except ValueError as error:
        notes.append(f"{error}; sRGB is assumed")
        return SRGB


@cache
def _encoding_of(primaries: int, transfer: int) -> Encoding:
    found = encoding_of_codes(primaries, transfer)
    return SRGB if found.is_srgb() else found


def orientation_of(frame: av.VideoFrame) -> int:
    """Return the orientation of a frame as in EXIF, 1 to 8.

    Raises
    ------
    ValueError
        If the video is to be rotated by another angle than multiples of 90 degrees.
    """
    side_data = frame.side_data.get(Type.DISPLAYMATRIX)
    if side_data is None:
        return 1
    values = np.frombuffer(bytes(side_data), np.int32, 9)
    signs = tuple(int(np.sign(value)) for value in values[[0, 1, 3, 4]])
    if signs not in ORIENTATIONS:
        raise ValueError("a rotation by less than 90 degrees; allowed: multiples of 90")
    return ORIENTATIONS[signs]


def pixel_aspect_ratio_of(stream: av.VideoStream) -> float:
    """Return the width of a stored pixel relative to its height.

    Raises
    ------
    ValueError
        If it is impossible.
    """
    found = stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio
    ratio = float(found or 1.0)
    low, high = PIXEL_ASPECT_LIMITS
    if not low <= ratio <= high:
        raise ValueError(
            f"a sample aspect ratio of {ratio:g}; allowed: {low:g} to {high:g}"
        )
    return ratio


def frames_per_second(path: Path) -> float:
    """Return the mean frame rate of a video.

    Raises
    ------
    InvalidFile
        If it cannot be read.
    """
    with VideoReader(path) as reader:
        return reader.rate_hz


class VideoReader:
    """Reader of a video, which decodes each frame once if frames are read in order.

    Raises
    ------
    InvalidFile
        If the file cannot be read, or has no frames, too many or too large ones.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._named("cannot be read"):
            self._container = av.open(
                str(path), options=OPTIONS, metadata_errors="replace"
            )
        try:
            self._stream = self._opened_stream()
            self._times = self._packet_times()
        except BaseException:
            self.close()
            raise
        self._decoded: Iterator[av.VideoFrame] = iter(())
        self._next = -1  # index of the next frame to decode

    def __enter__(self) -> VideoReader:
        """Return the reader."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    @property
    def count(self) -> int:
        """Return the number of frames."""
        return len(self._times)

    @property
    def variable_times_s(self) -> list[Fraction] | None:
        """Return the time of each frame, s, from 0 on; None if the rate is constant."""
        tick_s = self._stream.time_base or Fraction(1, 1)
        times_s = [(time - self._times[0]) * tick_s for time in self._times]
        rate_hz = self.rate_hz
        is_constant = all(
            abs(float(time_s) - k / rate_hz) <= 1.01 * tick_s
            for k, time_s in enumerate(times_s)
        )
        return None if is_constant else times_s

    @property
    def rate_hz(self) -> float:
        """Return the mean frame rate, or 30 if the file does not contain it."""
        try:
            return float(self._stream.average_rate or 30)
        except (ZeroDivisionError, OverflowError):
            return 30.0

    def color(self, index: int) -> ImageFile:
        """Return a frame, upright.

        Returns
        -------
        ImageFile
            Pixels (height, width, 3): uint8 sRGB; float32 linear sRGB if the video has
            more than 8 bits or is HDR.

        Raises
        ------
        InvalidFile
            If the frame cannot be read.
        """
        frame = self._frame(index)
        self._check_size(frame)
        with self._named("pixels cannot be read"):
            pixels, notes = color_of(frame, self._stream.codec_context)
            orientation = orientation_of(frame)
            ratio = pixel_aspect_ratio_of(self._stream)
        if ratio != 1.0:
            ratio = 1.0 / ratio if orientation >= 5 else ratio
            notes.append(f"pixels are {ratio:.4g} times as wide as high")
        pixels = upright(pixels, orientation)
        height_px, width_px = pixels.shape[:2]
        grid = PixelGrid(width_px, height_px, pixel_aspect_ratio=ratio)
        named = tuple(named_note(self._path, note) for note in notes)
        return ImageFile(pixels, grid, named)

    def integers(self, index: int) -> NDArray[np.uint16]:
        """Return a frame of 16-bit gray as stored, upright, (height, width).

        Raises
        ------
        InvalidFile
            If the frame cannot be read, or has other pixels.
        """
        frame = self._frame(index)
        if frame.format.name not in GRAY:
            raise InvalidFile(
                self._path,
                f"pixels are {frame.format.name}",
                "lossless 16-bit gray, as from `ffmpeg -pix_fmt gray16le -c:v ffv1`",
            )
        self._check_size(frame)
        with self._named("pixels cannot be read"):
            stored = frame.to_ndarray().astype(np.uint16)
            return upright(stored, orientation_of(frame))

    @contextmanager
    def _named(self, what: str) -> Iterator[None]:
        """Raise exceptions of PyAV, which have many types, as InvalidFile."""
        try:
            yield
        except InvalidFile:
            raise
        except Exception as error:
            found = f"{what} ({reason_of(error)})"
            raise InvalidFile(self._path, found, "an intact video") from None

    def _opened_stream(self) -> av.VideoStream:
        if not self._container.streams.video:
            raise InvalidFile(self._path, "has no frames", "a video")
        stream = self._container.streams.video[0]
        context = stream.codec_context
        if context is None:
            raise InvalidFile(self._path, "has an unknown codec", "a known codec")
        # One thread, because the other cores process other frames.
        context.thread_count = 1
        # Later frames may have another size; the decoder rejects those that are too
        # large.
        context.options = {"max_pixels": str(MAX_VIDEO_PIXELS)}
        if context.width * context.height > MAX_VIDEO_PIXELS:
            found = f"frames of {context.width}x{context.height} px"
            raise InvalidFile(self._path, found, f"at most {MAX_VIDEO_PIXELS:,} pixels")
        return stream

    def _packet_times(self) -> list[int]:
        known: list[int] = []
        with self._named("cannot be read"):
            for packet in self._container.demux(self._stream):
                if packet.pts is not None:
                    known.append(packet.pts)
                if len(known) > MAX_VIDEO_FRAMES:
                    found = f"more than {MAX_VIDEO_FRAMES:,} frames"
                    raise InvalidFile(
                        self._path, found, f"at most {MAX_VIDEO_FRAMES:,}"
                    )
        if not known or len(set(known)) < len(known):
            found = "frames have no times or share them"
            raise InvalidFile(self._path, found, "a time for each frame")
        known.sort()
        return known

    def _frame(self, index: int) -> av.VideoFrame:
        if not 0 <= index < self.count:
            found = f"frame {index} of {self.count}"
            raise InvalidFile(self._path, found, f"0 to {self.count - 1}")
        wanted, is_next = self._times[index], index == self._next
        self._next = -1  # until it is decoded
        with self._named(f"frame {index} cannot be read"):
            if not is_next:
                self._container.seek(wanted, stream=self._stream)
                self._decoded = self._decoded_frames()
            for frame in self._decoded:
                if frame.pts == wanted:
                    self._next = index + 1
                    return frame
                if frame.pts is not None and frame.pts > wanted:
                    break  # frames arrive in the order of their times
        raise InvalidFile(
            self._path, f"frame {index} cannot be read", "an intact video"
        )

    def _decoded_frames(self) -> Iterator[av.VideoFrame]:
        """Yield the frames from here on; raise after too many packets without any."""
        n_without = 0
        for packet in self._container.demux(self._stream):
            for frame in packet.decode():
                n_without = 0
                yield frame
            n_without += 1
            if n_without > MAX_PACKETS_AHEAD:
                found = f"{n_without:,} packets without a frame"
                raise InvalidFile(self._path, found, "an intact video")

    def _check_size(self, frame: av.VideoFrame) -> None:
        if frame.width * frame.height > MAX_VIDEO_PIXELS:
            found = f"a frame of {frame.width}x{frame.height} px"
            raise InvalidFile(self._path, found, f"at most {MAX_VIDEO_PIXELS:,} pixels")
