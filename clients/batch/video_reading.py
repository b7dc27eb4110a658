"""Exact random access to video frames, whatever was read before.

A frame is found by its time.  The reader lists the times of all packets without
decoding them, then seeks to the key frame that precedes a frame and decodes from there.
Frames are returned upright and in sRGB (`clients.batch.video_color`).
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from clients.batch.video_color import (
    color_of,
    orientation_of,
    pixel_aspect_ratio_of,
)
from estimator.bounded_files import InvalidFile, reason_of
from filter_service.camera import PixelGrid
from filter_service.image_files import ImageFile, named_note
from filter_service.pictures import upright

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
        try:
            self._container = av.open(
                str(path), options=OPTIONS, metadata_errors="replace"
            )
        except Exception as error:  # PyAV raises many types of exceptions
            raise self._unreadable("cannot be read", error) from None
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
        try:
            pixels, notes = color_of(frame, self._stream.codec_context)
            orientation = orientation_of(frame)
            ratio = pixel_aspect_ratio_of(self._stream)
        except Exception as error:  # PyAV raises many types of exceptions
            raise self._unreadable("pixels cannot be read", error) from None
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
        try:
            stored = frame.to_ndarray().astype(np.uint16)
            return upright(stored, orientation_of(frame))
        except Exception as error:  # PyAV raises many types of exceptions
            raise self._unreadable("pixels cannot be read", error) from None

    def _unreadable(self, what: str, error: Exception) -> InvalidFile:
        found = f"{what} ({reason_of(error)})"
        return InvalidFile(self._path, found, "an intact video")

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
        try:
            for packet in self._container.demux(self._stream):
                if packet.pts is not None:
                    known.append(packet.pts)
                if len(known) > MAX_VIDEO_FRAMES:
                    found = f"more than {MAX_VIDEO_FRAMES:,} frames"
                    raise InvalidFile(
                        self._path, found, f"at most {MAX_VIDEO_FRAMES:,}"
                    )
        except InvalidFile:
            raise
        except Exception as error:  # PyAV raises many types of exceptions
            raise self._unreadable("cannot be read", error) from None
        if not known or len(set(known)) < len(known):
            found = "frames have no times or share them"
            raise InvalidFile(self._path, found, "a time for each frame")
        known.sort()
        return known

    def _frame(self, index: int) -> av.VideoFrame:
        if not 0 <= index < self.count:
            found = f"frame {index} of {self.count}"
            raise InvalidFile(self._path, found, f"0 to {self.count - 1}")
        wanted = self._times[index]
        try:
            if index != self._next:
                self._container.seek(wanted, stream=self._stream)
                self._decoded = self._decoded_frames()
            self._next = index + 1
            for frame in self._decoded:
                if frame.pts == wanted:
                    return frame
                if frame.pts is not None and frame.pts > wanted:
                    break  # frames arrive in the order of their times
        except Exception as error:  # PyAV raises many types of exceptions
            self._next = -1
            if isinstance(error, InvalidFile):
                raise
            raise self._unreadable(f"frame {index} cannot be read", error) from None
        self._next = -1
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
