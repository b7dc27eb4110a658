"""Frames of videos by their numbers, exactly, whatever was read before.

A frame is found by its time: the times of all packets are listed first, without
decoding; then the decoder goes to the key frame before it and on from there.
"""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

GREY = ("gray16le", "gray16be")


def frame_count(path: Path) -> int:
    """Return how many frames a video has.

    Raises
    ------
    ValueError
        It cannot be read, or has no pictures.
    """
    with VideoReader(path) as reader:
        return reader.count


def frames_per_second(path: Path) -> float:
    """Return the mean rate of a video.

    Raises
    ------
    ValueError
        It cannot be read.
    """
    with VideoReader(path) as reader:
        return reader.rate_hz


class VideoReader:
    """One video; frames in order cost no more than to decode them.

    Raises
    ------
    ValueError
        It cannot be read, or has no pictures.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._container = av.open(str(path))
        except (av.FFmpegError, OSError) as error:
            raise ValueError(f"'{path}': cannot be read ({error})") from None
        if not self._container.streams.video:
            raise ValueError(f"'{path}': no pictures in it")
        self._stream = self._container.streams.video[0]
        # One thread: the machine's cores have frames of their own.
        self._stream.codec_context.thread_count = 1
        self._times = self._packet_times()
        self._decoded = iter(())
        self._next = -1  # number of the frame that is decoded next

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
        """Return how many frames there are."""
        return len(self._times)

    @property
    def rate_hz(self) -> float:
        """Return the mean rate, or 30 where the file does not tell."""
        return float(self._stream.average_rate or 30)

    def color(self, index: int) -> NDArray[np.uint8]:
        """Return a frame in sRGB, (height, width, 3).

        Raises
        ------
        ValueError
        """
        return self._frame(index).to_ndarray(format="rgb24")

    def integers(self, index: int) -> NDArray[np.uint16]:
        """Return a frame of 16-bit grey as it is stored, (height, width).

        Raises
        ------
        ValueError
            The video is of another kind.
        """
        frame = self._frame(index)
        if frame.format.name not in GREY:
            raise ValueError(
                f"'{self._path}': pixels are {frame.format.name}; allowed for depth: "
                "16-bit grey without loss, as `ffmpeg -pix_fmt gray16le -c:v ffv1`"
            )
        return frame.to_ndarray().astype(np.uint16)

    def _packet_times(self) -> list[int]:
        times = [packet.pts for packet in self._container.demux(self._stream)]
        known = sorted(time for time in times if time is not None)
        if not known or len(set(known)) < len(known):
            raise ValueError(f"'{self._path}': its frames have no times of their own")
        return known

    def _frame(self, index: int) -> av.VideoFrame:
        if not 0 <= index < self.count:
            raise ValueError(f"'{self._path}': frame {index} of {self.count}")
        try:
            if index != self._next:
                self._container.seek(self._times[index], stream=self._stream)
                self._decoded = self._container.decode(self._stream)
            self._next = index + 1
            for frame in self._decoded:
                if frame.pts == self._times[index]:
                    return frame
        except av.FFmpegError as error:
            self._next = -1
            raise ValueError(
                f"'{self._path}': frame {index} cannot be read ({error})"
            ) from None
        self._next = -1
        raise ValueError(f"'{self._path}': frame {index} cannot be read")
