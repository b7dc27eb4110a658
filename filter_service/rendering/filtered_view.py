"""A filtered view and how it was made, whatever engine did it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class FilteredView:
    """A filtered view and how it was made.

    Attributes
    ----------
    color : (height, width, 3)
        float32 or float16 linear light, or uint8 sRGB.
    stage_times_ms : dict
        By stage; their sum is the time spent in the engine.
    missing_depth_count, clamped_depth_count, bad_color_count : int
        Pixels whose depth was filled in, lay outside the prepared distances, or whose
        colour was not finite (taken as black); the last two with those of a hidden
        layer that hold something.
    pupil_diameter_mm, focus_dpt : float
        As used.
    gaze_deg : (h, v)
        As used.
    fragment_count, merged_count, entry_count : int
        Fragments, pixels merged into some, and entries of the bins' lists; rows that
        two strips of a very large frame share count twice, and with a hidden layer the
        repeated border counts.
    overflow_count : int
        Entries that could not be kept, for want of room; their light is missing.
    kernel_count, kernel_texel_count : int
        Kernels in use, and texels of all their levels.
    """

    color: NDArray
    stage_times_ms: dict[str, float]
    missing_depth_count: int
    clamped_depth_count: int
    bad_color_count: int
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float]
    fragment_count: int
    merged_count: int
    entry_count: int
    kernel_count: int
    kernel_texel_count: int
    layer_count: int
    notes: list[str]
    overflow_count: int = 0


SAMPLED_EVERY = 16
"""Rows and columns looked at to tell the unit of depth: 25 us of a frame."""

METERS_BELOW = 100.0
"""Scenes with nothing nearer are rare; depth in centimeters or millimeters is not."""


def input_notes(
    depth_m: NDArray[np.float32], missing_depth_count: int, bad_color_count: int
) -> list[str]:
    """Say what was assumed of a view's depth and color.

    The texts do not change from frame to frame: counts are told apart.
    """
    notes = []
    if missing_depth_count == depth_m.size:
        notes.append("no pixel has depth; infinity is assumed")
    sampled_m = depth_m[::SAMPLED_EVERY, ::SAMPLED_EVERY]
    known_m = sampled_m[(sampled_m > 0.0) & (sampled_m < np.inf)]
    if known_m.size and known_m.min() >= METERS_BELOW:
        notes.append(f"all depth is beyond {METERS_BELOW:g} m: is it in meters?")
    if bad_color_count:
        notes.append(f"{bad_color_count} pixels with non-finite color taken as black")
    return notes
