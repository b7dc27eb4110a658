"""Result of a filtered view, for all engines."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class FrameCounts:
    """Counts that users receive with a frame.

    A new counter needs a line here, with the default 0, and a value from each engine.
    A field of the same name in `Result` is filled with it and sent.

    Attributes
    ----------
    missing_depth_count, clamped_depth_count, bad_color_count : int
        Pixels whose depth was filled in, whose depth was outside the prepared
        distances, and whose color was not finite (taken as black); the last two
        include the pixels of a hidden layer that are not empty.
    overflow_count : int
        Entries dropped because their list was full; their light is missing.
    """

    missing_depth_count: int
    clamped_depth_count: int
    bad_color_count: int
    overflow_count: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """Return the counts by name."""
        return summed_counts([self])


def summed_counts(counts: Sequence[FrameCounts]) -> dict[str, int]:
    """Return the sums of counts by name."""
    names = [count.name for count in fields(FrameCounts)]
    return {name: sum(int(getattr(c, name)) for c in counts) for name in names}


@dataclass(frozen=True, kw_only=True)
class FilteredView(FrameCounts):
    """A filtered view with the parameters and statistics of its rendering.

    Attributes
    ----------
    color : (height, width, 3)
        float32 or float16 linear light, or uint8 sRGB.
    stage_times_ms : dict
        Time by stage; their sum is the time spent in the engine.
    pupil_diameter_mm, focus_dpt : float
        As used.
    gaze_deg : (h, v)
        As used.
    fragment_count, merged_count, entry_count : int
        Fragments, pixels merged into fragments, and entries of the bins' lists; rows
        shared by two strips of a very large frame count twice, and with a hidden layer
        the repeated border counts.
    kernel_count, kernel_texel_count : int
        Kernels in use, and texels of all their levels.
    """

    color: NDArray[Any]
    stage_times_ms: dict[str, float]
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


SAMPLED_EVERY = 16
"""Stride in rows and columns for the check of the depth unit: 25 us of a frame."""

METERS_BELOW = 100.0
"""Scenes with nothing nearer are rare; depth in centimeters or millimeters is not."""


def input_notes(
    depth_m: NDArray[np.float32], missing_depth_count: int, bad_color_count: int
) -> list[str]:
    """Return notes on what was assumed about a view's depth and color.

    The texts do not change from frame to frame: counts are reported separately.
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
