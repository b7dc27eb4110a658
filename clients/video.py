"""Video output: H.264 in MP4 if the encoder works, otherwise an animated GIF."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from clients.batch.video_writing import (
    VIDEO_KINDS,
    EncodingFailed,
    join_segments,
    write_segment,
)
from filter_service.atomic_files import replace_atomically

_GIF_WIDTH_PX = 1200


def write_video(
    stem: Path,
    frames: Callable[[], Iterable[NDArray[np.uint8]]],
    frames_per_second: int,
) -> Path:
    """Write frames to stem.mp4, or to stem.gif if the encoder fails.

    Parameters
    ----------
    stem : Path
        Path without its suffix.
    frames : callable
        Function that returns the frames (h, w, 3), uint8 sRGB, from the start at each
        call.  Width and height must be even.
    frames_per_second : int
        Frame rate.

    Returns
    -------
    Path
        The file written.
    """
    target, segment = stem.with_suffix(".mp4"), stem.with_suffix(".mkv")
    kind, rate_hz = VIDEO_KINDS["h264"], frames_per_second
    try:
        write_segment(segment, enumerate(frames()), kind=kind, rate_hz=rate_hz)
        replace_atomically(
            target,
            lambda part: join_segments(
                part, [(0, segment)], kind=kind, rate_hz=rate_hz
            ),
        )
    except (OSError, ValueError, EncodingFailed):  # libx264 is missing or fails
        target = stem.with_suffix(".gif")
        replace_atomically(
            target, lambda part: _write_gif(part, frames(), frames_per_second)
        )
    segment.unlink(missing_ok=True)
    return target


def _write_gif(
    target: Path, frames: Iterable[NDArray[np.uint8]], frames_per_second: int
) -> None:
    images = []
    for frame in frames:
        image = Image.fromarray(frame)
        image.thumbnail((_GIF_WIDTH_PX, _GIF_WIDTH_PX))
        images.append(image.quantize(128))
    images[0].save(
        target,
        save_all=True,
        append_images=images[1:],
        duration=round(1000 / frames_per_second),
        loop=0,
    )
