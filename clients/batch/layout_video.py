"""A color video, with depth as a 16-bit gray video or a folder of images."""

from __future__ import annotations

from pathlib import Path

from clients.batch.layout_pairs import images_in
from clients.batch.source import Optics, Scaled, SourceFrame
from filter_service.image_files import DEPTH_SUFFIXES

VIDEO_SUFFIXES = (
    ".mkv",
    ".mp4",
    ".mov",
    ".avi",
    ".webm",
    ".m4v",
    ".mpg",
    ".mpeg",
    ".ts",
)


def video_frames(
    source: Path, depth: Path | None, optics: Optics, scaled: Scaled
) -> list[SourceFrame]:
    """Return the frames of a video, named by their numbers.

    Raises
    ------
    ValueError
        No depth, or not one for each frame; or a video that cannot be read.
    """
    from clients.batch.video_reading import frame_count

    if depth is None:
        raise ValueError(
            f"--depth: not given; allowed with '{source}': a video of 16-bit gray, or "
            "a folder of depth images"
        )
    count = frame_count(source)
    depths: list[tuple[Path, int | None]]
    if depth.is_dir():
        files = images_in(depth, DEPTH_SUFFIXES)
        depths = [(path, None) for path in files]
    elif depth.is_file():
        depths = [(depth, k) for k in range(frame_count(depth))]
    else:
        raise ValueError(f"--depth '{depth}': no such file or folder")
    if len(depths) != count:
        raise ValueError(
            f"--depth '{depth}': {len(depths)} frames; allowed: as many as '{source}' "
            f"has, {count}"
        )
    return [
        SourceFrame(f"{k:06d}", source, path, optics, scaled, k, depth_index)
        for k, (path, depth_index) in enumerate(depths)
    ]
