"""Video output: H.264 in MP4 if PyAV has the encoder, otherwise an animated GIF."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from filter_service.atomic_files import replace_atomically

_GIF_WIDTH_PX = 1200


def write_video(
    stem: Path,
    frames: Callable[[], Iterable[NDArray[np.uint8]]],
    frames_per_second: int,
) -> Path:
    """Write frames to stem.mp4, or to stem.gif without PyAV or a working encoder.

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
    try:
        from clients.batch import video_writing
    except ModuleNotFoundError:  # PyAV is in the extras
        return _write_gif(stem, frames(), frames_per_second)
    target, segment = stem.with_suffix(".mp4"), stem.with_suffix(".mkv")
    kind, rate_hz = video_writing.VIDEO_KINDS["h264"], frames_per_second
    try:
        video_writing.write_segment(
            segment, enumerate(frames()), kind=kind, rate_hz=rate_hz
        )
        replace_atomically(
            target,
            lambda part: video_writing.join_segments(
                part, [(0, segment)], kind=kind, rate_hz=rate_hz
            ),
        )
        return target
    except (OSError, ValueError, video_writing.EncodingFailed):
        # libx264 is missing or fails
        return _write_gif(stem, frames(), frames_per_second)
    finally:
        segment.unlink(missing_ok=True)


def _write_gif(
    stem: Path, frames: Iterable[NDArray[np.uint8]], frames_per_second: int
) -> Path:
    target = stem.with_suffix(".gif")
    images = []
    for frame in frames:
        image = Image.fromarray(frame)
        image.thumbnail((_GIF_WIDTH_PX, _GIF_WIDTH_PX))
        images.append(image.quantize(128))
    replace_atomically(
        target,
        lambda part: images[0].save(
            part,
            save_all=True,
            append_images=images[1:],
            duration=round(1000 / frames_per_second),
            loop=0,
        ),
    )
    return target
