"""Detection of the layout of a data set, and listing of its frames.

pairs       folders of color and depth, or one folder with both
tum         TUM RGB-D: rgb/, depth/ and their lists
nyu         NYU depth v2: extracted pairs, or raw dumps
middlebury  im0.png, disp0.pfm and calib.txt, of one scene or many
video       a color video, with depth as a 16-bit gray video or a folder of images
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from clients.batch.datasets import (
    color_frames,
    images_in,
    is_nyu,
    is_tum,
    middlebury_frames,
    middlebury_scenes,
    nyu_frames,
    pair_frames,
    tum_frames,
)
from clients.batch.source import (
    Constant,
    FieldOfView,
    Optics,
    Pinhole,
    Scaled,
    SourceFrame,
)
from filter_service.camera import read_intrinsics
from filter_service.image_files import COLOR_SUFFIXES, DEPTH_SUFFIXES

VIDEO_SUFFIXES = (
    *(".mkv", ".mp4", ".mov", ".avi", ".webm"),
    *(".m4v", ".mpg", ".mpeg", ".ts"),
)


MAX_EXAMINED_FILES = 1000
"""Files whose kinds an error names."""


Listing = Callable[[Path], list[SourceFrame]]

DETECTED: dict[str, tuple[Callable[[Path], object], Listing]] = {
    "tum": (is_tum, tum_frames),
    "nyu": (is_nyu, nyu_frames),
    "middlebury": (
        middlebury_scenes,
        middlebury_frames,
    ),
}
LAYOUTS = ("auto", *DETECTED, "pairs", "video")


def list_frames(
    source: Path,
    layout: str,
    depth: Path | None = None,
    optics: Optics | None = None,
    depth_scale_m: float | None = None,
    constant: Constant | None = None,
) -> tuple[str, list[SourceFrame]]:
    """Return the layout of a data set, and its frames in the order of their names.

    Parameters
    ----------
    source : Path
        Folder or video.
    layout : str
        One of `LAYOUTS`.
    depth : Path, optional
        Folder or video of depth, if it is not in the folder of color.
    optics : Optics, optional
        Overrides the layout's camera.
    depth_scale_m : float, optional
        Meters per unit of the depth files; overrides the layout's scale.
    constant : Constant, optional
        Depth of all pixels; replaces depth files.

    Raises
    ------
    ValueError
        If the folder or file does not exist, or has no frames or no known camera.
    """
    if not source.exists():
        raise ValueError(f"'{source}': no such file; allowed: a folder or a video")
    if constant is not None and (depth or depth_scale_m) is not None:
        name = "--depth" if depth is not None else "--depth-scale"
        raise ValueError(f"--distance-m and {name} are given; allowed: one of them")
    layout = _layout_of(source, layout)
    if layout in DETECTED:
        if depth is not None:
            raise ValueError(f"--depth: the layout {layout} has its own depth")
        frames = DETECTED[layout][1](source)
    elif optics is None:
        raise ValueError(
            "--fov-deg is not given, and the data set has no calibration; allowed: the "
            "vertical field of view in deg, or --intrinsics FX,FY,CX,CY in px"
        )
    elif layout == "video":
        frames = _video_frames(source, depth, optics, constant or Scaled(depth_scale_m))
    elif constant is not None:
        frames = color_frames(source, optics, constant)
    else:
        frames = pair_frames(source, depth, optics, Scaled(depth_scale_m))
    if not frames:
        raise ValueError(_nothing_found(source, layout, depth))
    _check_names(frames)
    if constant is not None:
        frames = [replace(one, depth=None, depth_form=constant) for one in frames]
    return layout, [_with_options(frame, optics, depth_scale_m) for frame in frames]


def _nothing_found(source: Path, layout: str, depth: Path | None) -> str:
    """Return an error with the kinds of files that there are."""
    if depth is not None and not any(depth.iterdir()):
        return f"--depth '{depth}': no files"
    paths = islice(source.rglob("*"), MAX_EXAMINED_FILES)
    kinds = {path.suffix or path.name for path in paths if not path.is_dir()}
    found = ", ".join(sorted(kinds)[:8]) or "none"
    allowed = (
        f"images ({', '.join(COLOR_SUFFIXES)}) in color/ and as many of depth "
        f"({', '.join(DEPTH_SUFFIXES)}) in depth/, names that end in _depth, or "
        "--distance-m"
    )
    problem = f"no frames of the layout {layout}; files: {found}"
    return f"'{source}': {problem}; allowed: {allowed}"


def _layout_of(source: Path, layout: str) -> str:
    if layout not in LAYOUTS:
        raise ValueError(f"--layout '{layout}'; allowed: {', '.join(LAYOUTS)}")
    is_video = source.is_file()
    if is_video and source.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(
            f"'{source}': '{source.suffix}' is not a video; allowed: a folder, or "
            f"{', '.join(VIDEO_SUFFIXES)}"
        )
    if is_video != (layout == "video") and layout != "auto":
        allowed = "video" if is_video else "auto, or the layout of a folder"
        raise ValueError(f"--layout '{layout}' for '{source}'; allowed: {allowed}")
    if layout != "auto":
        return layout
    if is_video:
        return "video"
    return next(
        (name for name, (is_so, _) in DETECTED.items() if is_so(source)), "pairs"
    )


def _video_frames(
    source: Path, depth: Path | None, optics: Optics, depth_form: Scaled | Constant
) -> list[SourceFrame]:
    """Return the frames of a video, named by their numbers."""
    from clients.batch.video_reading import VideoReader

    if depth is None and not isinstance(depth_form, Constant):
        raise ValueError(
            f"--depth is not given; allowed for '{source}': a 16-bit gray video, a "
            "folder of depth images, or --distance-m"
        )
    with VideoReader(source) as reader:
        count, times_s = reader.count, reader.variable_times_s
    depths: list[tuple[Path | None, int | None]]
    if depth is None:
        depths = [(None, None)] * count
    elif depth.is_dir():
        files = images_in(depth, DEPTH_SUFFIXES)
        depths = [(path, None) for path in files]
    elif depth.is_file():
        with VideoReader(depth) as reader:
            depths = [(depth, k) for k in range(reader.count)]
    else:
        raise ValueError(f"--depth '{depth}': no such file or folder")
    if len(depths) != count:
        raise ValueError(
            f"--depth '{depth}': {len(depths)} frames; allowed: {count}, as in "
            f"'{source}'"
        )
    return [
        SourceFrame(
            f"{k:06d}",
            source,
            path,
            optics,
            depth_form,
            k,
            depth_index,
            time_s=None if times_s is None else times_s[k],
        )
        for k, (path, depth_index) in enumerate(depths)
    ]


def _with_options(
    frame: SourceFrame, optics: Optics | None, depth_scale_m: float | None
) -> SourceFrame:
    """Apply the options of the command line to a frame."""
    if optics is not None:
        frame = replace(frame, optics=optics)
    if depth_scale_m is not None:
        if not isinstance(frame.depth_form, Scaled):
            kind = type(frame.depth_form).__name__
            raise ValueError(f"--depth-scale: not allowed for depth of the kind {kind}")
        frame = replace(frame, depth_form=Scaled(depth_scale_m))
    return frame


def _check_names(frames: Sequence[SourceFrame]) -> None:
    seen: dict[str, Path] = {}
    for frame in frames:
        if frame.name in seen:
            raise ValueError(
                f"'{frame.color}' and '{seen[frame.name]}' have the same name "
                f"'{frame.name}'"
            )
        seen[frame.name] = frame.color


def optics_of(fov_deg: float | None, intrinsics: str | None) -> Optics | None:
    """Return the camera that the command line specifies, or None.

    Raises
    ------
    ValueError
        If both are given or the numbers are invalid.  The message names the option.
    """
    if fov_deg is not None and intrinsics is not None:
        raise ValueError("--fov-deg and --intrinsics are given; allowed: one of them")
    if fov_deg is not None:
        if not 1.0 <= fov_deg <= 150.0:
            raise ValueError(f"--fov-deg is {fov_deg:g}; allowed: 1 to 150")
        return FieldOfView(fov_deg)
    if intrinsics is None:
        return None
    return Pinhole(*read_intrinsics(intrinsics))
