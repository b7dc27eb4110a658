"""Detection of a data set's layout, and its frames.

pairs       folders of color and of depth, or one folder with both
tum         TUM RGB-D: rgb/, depth/ and their lists
nyu         NYU depth v2: extracted pairs, or raw dumps
middlebury  im0.png, disp0.pfm and calib.txt, of one scene or many
video       a color video, with a video or a folder of depth
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from clients.batch import layout_middlebury, layout_nyu, layout_pairs, layout_tum
from clients.batch.layout_video import VIDEO_SUFFIXES, video_frames
from clients.batch.source import (
    FieldOfView,
    Optics,
    Pinhole,
    Scaled,
    SourceFrame,
)
from filter_service.camera import read_intrinsics


@dataclass(frozen=True)
class LayoutOptions:
    """Options of the command line that complement or override the data set.

    Attributes
    ----------
    depth : Path, optional
        Folder or video of depth, if it is not beside the color.
    optics : Optics, optional
        Overrides the layout's camera.
    depth_scale_m : float, optional
        Meters per unit of the depth files; overrides the layout's scale.
    """

    depth: Path | None = None
    optics: Optics | None = None
    depth_scale_m: float | None = None


Listing = Callable[[Path], list[SourceFrame]]

DETECTED: dict[str, tuple[Callable[[Path], bool], Listing]] = {
    "tum": (layout_tum.is_tum, layout_tum.tum_frames),
    "nyu": (layout_nyu.is_nyu, layout_nyu.nyu_frames),
    "middlebury": (
        layout_middlebury.is_middlebury,
        layout_middlebury.middlebury_frames,
    ),
}
LAYOUTS = ("auto", *DETECTED, "pairs", "video")


def list_frames(
    source: Path, layout: str, told: LayoutOptions
) -> tuple[str, list[SourceFrame]]:
    """Return the layout of a data set and its frames, in the order of their names.

    Raises
    ------
    ValueError
        No such folder or file, no frames in it, or no known camera.
    """
    if not source.exists():
        raise ValueError(f"'{source}': no such file; allowed: a folder or a video")
    layout = _layout_of(source, layout)
    if layout in DETECTED:
        if told.depth is not None:
            raise ValueError(f"--depth: the layout {layout} has its own depth")
        frames = DETECTED[layout][1](source)
    elif layout == "video":
        frames = video_frames(source, told.depth, _optics(told), _scaled(told))
    else:
        frames = layout_pairs.pair_frames(
            source, told.depth, _optics(told), _scaled(told)
        )
    if not frames:
        raise ValueError(f"'{source}': no frames of the layout {layout}")
    _check_names(frames)
    return layout, [_with_options(frame, told) for frame in frames]


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
        allowed = "video" if is_video else "auto, or one of a folder"
        raise ValueError(f"--layout '{layout}' of '{source}'; allowed: {allowed}")
    if layout != "auto":
        return layout
    if is_video:
        return "video"
    return next(
        (name for name, (is_so, _) in DETECTED.items() if is_so(source)), "pairs"
    )


def _optics(told: LayoutOptions) -> Optics:
    if told.optics is None:
        raise ValueError(
            "--fov-deg: not given, and the data has no calibration; allowed: the "
            "vertical field of view in deg, or --intrinsics FX,FY,CX,CY in px"
        )
    return told.optics


def _scaled(told: LayoutOptions) -> Scaled:
    return Scaled(told.depth_scale_m)


def _with_options(frame: SourceFrame, told: LayoutOptions) -> SourceFrame:
    """Return a frame with the overrides of the command line."""
    if told.optics is not None:
        frame = replace(frame, optics=told.optics)
    if told.depth_scale_m is not None:
        if not isinstance(frame.depth_form, Scaled):
            kind = type(frame.depth_form).__name__
            raise ValueError(f"--depth-scale: this depth is of the kind {kind}")
        frame = replace(frame, depth_form=Scaled(told.depth_scale_m))
    return frame


def _check_names(frames: Sequence[SourceFrame]) -> None:
    seen: dict[str, Path] = {}
    for frame in frames:
        if frame.name in seen:
            raise ValueError(
                f"'{frame.color}' and '{seen[frame.name]}' would both be called "
                f"'{frame.name}'"
            )
        seen[frame.name] = frame.color


def optics_of(fov_deg: float | None, intrinsics: str | None) -> Optics | None:
    """Return the camera given on the command line, or None.

    Raises
    ------
    ValueError
        Both are given, or the numbers are not those of a camera; names the option.
    """
    if fov_deg is not None and intrinsics is not None:
        raise ValueError("--fov-deg and --intrinsics: allowed is one of them")
    if fov_deg is not None:
        if not 1.0 <= fov_deg <= 150.0:
            raise ValueError(f"--fov-deg {fov_deg:g}: allowed is 1 to 150")
        return FieldOfView(fov_deg)
    if intrinsics is None:
        return None
    return Pinhole(*read_intrinsics(intrinsics))
