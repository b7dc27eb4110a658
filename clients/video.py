"""Video output: H.264 in MP4 if the encoder works, otherwise an animated GIF."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image

_GIF_WIDTH_PX = 1200


def write_video(
    stem: Path,
    frames: Callable[[], Iterable[NDArray[np.uint8]]],
    frames_per_second: int,
) -> Path:
    """Write frames to stem.mp4, or to stem.gif if the encoder fails.

    Parameters
    ----------
    stem : path without its suffix
    frames : function that returns the frames (h, w, 3) uint8 from the start at each
        call; width and height must be even.

    Returns
    -------
    Path of the written file.
    """
    target = stem.with_suffix(".mp4")
    try:
        _write_mp4(target, frames(), frames_per_second)
    except (OSError, RuntimeError):
        # No ffmpeg on this machine, or it crashed and broke the pipe.
        target.unlink(missing_ok=True)
        return _write_gif(stem.with_suffix(".gif"), frames(), frames_per_second)
    return target


def _write_mp4(
    target: Path, frames: Iterable[NDArray[np.uint8]], frames_per_second: int
) -> None:
    """Pipe raw frames through ffmpeg's H.264 encoder."""
    frames = iter(frames)
    first = next(frames)
    height, width = first.shape[:2]
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        *("-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"),
        *("-s", f"{width}x{height}", "-r", str(frames_per_second), "-i", "-"),
        *("-c:v", "libx264", "-preset", "fast", "-crf", "18", "-pix_fmt", "yuv420p"),
        *("-movflags", "+faststart", str(target)),
    ]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as encoder:
        assert encoder.stdin is not None
        for frame in chain([first], frames):
            encoder.stdin.write(np.ascontiguousarray(frame).data)
    if encoder.returncode != 0:
        raise RuntimeError(f"ffmpeg ended with code {encoder.returncode}")


def _write_gif(
    target: Path, frames: Iterable[NDArray[np.uint8]], frames_per_second: int
) -> Path:
    pictures = []
    for frame in frames:
        picture = Image.fromarray(frame)
        picture.thumbnail((_GIF_WIDTH_PX, _GIF_WIDTH_PX))
        pictures.append(picture.quantize(128))
    pictures[0].save(
        target,
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 / frames_per_second),
        loop=0,
    )
    return target
